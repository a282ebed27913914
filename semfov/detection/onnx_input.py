"""The input of an ONNX model for images: the order of its dimensions, and floats or bytes.

In a layout, B are images, C the three channels, H rows and W columns; in the rest of the package images are `BCHW`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.detection.onnx_cells import Canvas
from semfov.detection.onnx_program import Numbers, Port

_USUAL = "BCHW"
_LAYOUTS = (_USUAL, "BHWC")  # PyTorch's exports, and those of TensorFlow; the first one counts where both fit
_CHANNELS = 3

FLOATS = {
    "tensor(float)": torch.float32,
    "tensor(float16)": torch.float16,
    "tensor(double)": torch.float64,
}
"""Types of floats in onnxruntime's words."""

_BYTES = "tensor(uint8)"

Sizes = tuple[int | None, ...]
"""A shape, with None for sizes that are open."""


def layout_of(sizes: Sequence[int | None]) -> str | None:
    """Find the order of the dimensions of an input: the dimension of size 3 has the channels.

    Args:
        sizes: the shape of the input, with None or 0 for open sizes.

    Returns:
        The layout; None where the input takes no images in colour.

    >>> layout_of([1, 3, 640, 640]), layout_of([None, 320, 320, 3]), layout_of([1, 4])
    ('BCHW', 'BHWC', None)
    """
    layouts = [layout for layout in _LAYOUTS if len(layout) == len(sizes)]
    stated = [layout for layout in layouts if sizes[layout.index("C")] == _CHANNELS]
    possible = [layout for layout in layouts if not sizes[layout.index("C")]]
    return next(iter(stated + possible), None)


def sizes_of_image(layout: str, canvas: Canvas) -> tuple[int, ...]:
    """List the sizes of an input for one image.

    Args:
        layout: the order of its dimensions.
        canvas: `(width, height)` in pixels.

    Returns:
        The sizes in that order.
    """
    width, height = canvas
    by_letter = {"B": 1, "C": _CHANNELS, "H": height, "W": width}
    return tuple(by_letter[letter] for letter in layout)


class ImageInput(NamedTuple):
    """An input for images.

    Attributes:
        name: its name.
        layout: the order of its dimensions.
        shape: its shape in the order `BCHW`.
        dtype: of floats, also of those that are rounded to bytes.
        takes_bytes: whether it takes bytes, 0 for black and 255 for white.
    """

    name: str
    layout: str
    shape: Sizes
    dtype: torch.dtype
    takes_bytes: bool

    @classmethod
    def of(cls, port: Port) -> ImageInput | None:
        """Make the description of an input from onnxruntime's.

        Args:
            port: its name, shape and type.

        Returns:
            The description; None for an input that takes no images.
        """
        sizes = open_sizes(port["shape"])
        layout = layout_of(sizes)
        takes_bytes = port["type"] == _BYTES
        if layout is None or not (takes_bytes or port["type"] in FLOATS):
            return None
        shape = tuple(sizes[layout.index(letter)] for letter in _USUAL)
        dtype = torch.float32 if takes_bytes else FLOATS[port["type"]]
        return cls(port["name"], layout, shape, dtype, takes_bytes)

    def arranged(self, images: Tensor) -> Numbers:
        """Convert images to the order of dimensions and the type of the input.

        Args:
            images: `(B, 3, H, W)` on the CPU, in `dtype`; where it takes bytes, from 0 to 255.

        Returns:
            The array that the model takes.
        """
        if self.takes_bytes:
            images = images.round().clamp(0, 255).to(torch.uint8)
        order = [_USUAL.index(letter) for letter in self.layout]
        return images.permute(order).contiguous().numpy()


def open_sizes(shape: Sequence[int | str | None]) -> Sizes:
    """Take the sizes of a shape that are numbers.

    Args:
        shape: a shape of onnxruntime, which has names for sizes that are open.

    Returns:
        The sizes, with None for open ones.
    """
    return tuple(size if isinstance(size, int) and size > 0 else None for size in shape)
