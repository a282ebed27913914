"""The preprocessing that a network expects, as settings that can be stored with the model."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, Self, get_args

import torch
from torch import Tensor

from semfov.errors import check, check_shape, lookup
from semfov.io.schema import Array, Flag, Number

_ChannelOrder = Literal["rgb", "bgr"]

_KINDS = {
    "scale": Number(above=0),
    "mean": Array(Number(), 3),
    "std": Array(Number(above=0), 3),
    "stretch": Flag(),
    "corner": Flag(),
    "fill": Number(0, 1),
}


@dataclass(frozen=True)
class Preprocessing:
    """Conversion of a canvas, RGB in [0, 1], to the input of a network: `(canvas · scale - mean) / std`.

    Attributes:
        channels: order of the channels of the input.
        scale: value of white.
        mean: subtracted from each channel, in the order of the input.
        std: divides each channel.
        stretch: whether images are stretched to the canvas instead of letterboxed.
        corner: whether letterboxed images are in the upper left corner of the canvas instead of its middle.
        fill: value of the canvas's padding.
    """

    channels: _ChannelOrder = "rgb"
    scale: float = 1.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    stretch: bool = False
    corner: bool = False
    fill: float = 114 / 255

    def __post_init__(self) -> None:
        lookup(str(self.channels), get_args(_ChannelOrder), "channel order")
        for name, kind in _KINDS.items():
            kind.check(f"preprocessing.{name}", getattr(self, name), {})
        for name in ("mean", "std"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))

    def __call__(self, canvas: Tensor) -> Tensor:
        """Convert a canvas `(B, 3, H, W)` to the input of the network, a new tensor of the same shape."""
        check_shape(canvas, "canvas", None, 3, None, None)
        planes = []  # (B, H, W) each
        # Plane by plane, as each stays in the cache between the operations.
        for plane, mean, std in zip(self._in_channel_order(canvas), self.mean, self.std, strict=True):
            scaled = plane * (self.scale / std)
            planes.append(scaled - mean / std if mean else scaled)
        return torch.stack(planes, 1)

    def of_bytes(self, canvas: Tensor) -> Tensor:
        """Convert a canvas of bytes `(B, 3, H, W)` to the input: `self(canvas / 255)`, in one pass over memory."""
        check_bytes(canvas)
        image = torch.empty(canvas.shape, device=canvas.device)
        sources = self._in_channel_order(canvas)
        for plane, source, mean, std in zip(image.unbind(1), sources, self.mean, self.std, strict=True):
            plane.copy_(source)
            factor = self.scale / 255 / std
            if factor != 1:
                plane.mul_(factor)
            if mean:
                plane.sub_(mean / std)
        return image

    def _in_channel_order(self, canvas: Tensor) -> tuple[Tensor, ...]:
        """List the planes `(B, H, W)` of a canvas in the order of the network's channels."""
        planes = canvas.unbind(1)
        return planes[::-1] if self.channels == "bgr" else planes

    def merged(self, settings: Mapping[str, Any]) -> Self:
        """Replace some settings.

        Args:
            settings: the new settings by name.

        Returns:
            A copy with them.

        Raises:
            InputError: a name or a value is unknown.
        """
        for name in settings:
            lookup(name, [field.name for field in fields(self)], "preprocessing setting")
        return replace(self, **settings)

    def settings(self) -> dict[str, object]:
        """List all settings as JSON values."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}


def check_bytes(canvas: Tensor) -> None:
    """Check a canvas of bytes.

    Args:
        canvas: `(B, 3, H, W)`, bytes.

    Raises:
        InputError: it has another shape or dtype.
    """
    is_rgb_bytes = canvas.ndim == 4 and canvas.shape[1] == 3 and canvas.dtype == torch.uint8
    check(is_rgb_bytes, "canvas", "bytes of shape (B, 3, H, W)", f"{canvas.dtype} of shape {tuple(canvas.shape)}")
