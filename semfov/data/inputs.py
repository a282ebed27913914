"""Conversion of pictures and points of common types into the tensors that the library works on."""

from collections.abc import Sequence
from io import IOBase
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, Union, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.images import from_pillow
from semfov.data.reading import read_image
from semfov.data.tone import Values, White, between, black_and_white, check_white
from semfov.errors import InputError, check, check_pixels, lookup, values_known

if TYPE_CHECKING:
    from PIL.Image import Image

ImageLike: TypeAlias = Union[Tensor, NDArray[Any], str, PathLike[str], "Image"]
"""A picture: the path of its file, a Pillow image, an array or a tensor; see `as_image`."""

Color = Literal["rgb", "bgr"]  # order of the channels of arrays and tensors; OpenCV reads BGR

PointLike: TypeAlias = Tensor | NDArray[Any] | Sequence[Any]
"""One point `(x, y)` or several: a tensor, an array, a tuple or a list."""

_WHITE = {torch.uint8: 255, torch.uint16: 65535}
"""The whole number that is white, by dtype."""

_DTYPES = {
    **{name: np.dtype(name) for name in ("u1", "u2", "f2", "f4", "f8")},
    "f16": np.dtype(np.float64),  # which torch has not
}
"""Dtypes of tensors by the kind and bytes of the numbers of arrays."""

STREAMS = ("rtsp", "rtsps", "rtmp", "srt", "udp", "tcp")  # kinds of addresses of cameras and streams
_PRECISE = (torch.float32, torch.float64)  # precise enough for positions

FRAME = 1 / 25  # seconds between two frames where nothing tells them

_SMALLEST_SIDE = 16  # of pictures whose channels are last; smaller ones may be maps of features
_SHAPES = "a picture of shape (3, H, W), (H, W, 3) or (H, W)"


def as_image(
    image: ImageLike,
    *,
    like: Tensor | None = None,
    argument: str = "image",
    color: Color = "rgb",
    white: White | None = None,
) -> Tensor:
    """Convert a picture of any common type to RGB in [0, 1].

    - A path: a file that Pillow reads (`semfov.read_image`).
    - A Pillow image of any mode: it is turned upright, and transparent pixels are blended with white.
    - A NumPy array or a tensor of shape `(3, H, W)` or `(H, W, 3)`, or grey of shape `(H, W)`, `(1, H, W)` or
      `(H, W, 1)`, or a batch of one such picture. Floats must lie in [0, 1]; bytes and 16-bit numbers are divided by
      their largest value. Channels are RGB, or with `color="bgr"` as OpenCV reads them. In shape `(3, H, 3)` the
      channels are first.

    Gradients flow through tensors.

    Args:
        image: the picture.
        like: a tensor with the dtype and device of the result; None keeps the dtype of floats, converts other numbers
            to float32, and leaves the picture on its device.
        argument: name of the argument, for the message.
        color: order of the channels of arrays and tensors. Files and Pillow images know their own.
        white: the value of white (0 is black), the values `(black, white)`, or `auto` for percentiles, for numbers of
            any type (`semfov.read_image`); None: as said above.

    Returns:
        `(3, H, W)`, RGB.

    Raises:
        InputError: it is not a picture, there are several, or its values are not in [0, 1]; the message tells the
            remedy.
        DataError: the file cannot be read.

    >>> as_image(np.zeros((48, 64, 3), np.uint8)).shape
    torch.Size([3, 48, 64])
    """
    images = as_images(image, like=like, argument=argument, color=color, white=white)
    check(len(images) == 1, argument, "one picture", f"a batch of {len(images)}; give them one by one")
    return images[0]


def as_images(
    images: ImageLike,
    *,
    like: Tensor | None = None,
    argument: str = "image",
    color: Color = "rgb",
    white: White | None = None,
) -> Tensor:
    """Convert a picture, or a batch of pictures, to RGB in [0, 1].

    Args:
        images: the picture, or `(B, 3, H, W)` or `(B, H, W, 3)`; see `as_image`, also for the other arguments.
        like: a tensor with the dtype and device of the result.
        argument: name of the argument, for the message.
        color: order of the channels.
        white: the values that are black and white.

    Returns:
        `(B, 3, H, W)`.

    Raises:
        InputError: as for `as_image`.
        DataError: the file cannot be read.
    """
    pixels = as_pixels(images, argument=argument, color=color, white=white)
    device = pixels.device
    dtype = pixels.dtype if pixels.is_floating_point() else torch.float32
    if like is not None:
        device = like.device
        dtype = like.dtype
    if pixels.is_floating_point():
        pixels = pixels.to(device, dtype)
        check_pixels(pixels, argument)
        return pixels
    got = f"a tensor of {pixels.dtype}; convert it to bytes, image.to(torch.uint8), or to floats in [0, 1]"
    check(pixels.dtype in _WHITE, argument, "bytes, 16-bit numbers or floats", got)
    return _scaled(pixels, _WHITE[pixels.dtype], device, dtype)


def _scaled(pixels: Tensor, white: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Divide whole numbers by that of white, on a device and in a dtype."""
    if dtype == torch.float32 and device.type == "cpu" and values_known(pixels):
        # Other than torch, NumPy converts and divides in one pass over memory.
        numbers = pixels.cpu().numpy()
        return torch.from_numpy(np.divide(numbers, white, dtype=np.float32))
    return pixels.to(device, dtype).div_(white)


def as_pixels(
    images: ImageLike, *, argument: str = "image", color: Color = "rgb", white: White | None = None
) -> Tensor:
    """Convert a picture or a batch to RGB without a change of its numbers.

    Args:
        images: as for `as_images`, also the other arguments.
        argument: name of the argument, for the message.
        color: order of the channels.
        white: the values that are black and white; with these, the result is in [0, 1].

    Returns:
        `(B, 3, H, W)`.
    """
    check_white(white)
    is_array = isinstance(images, np.ndarray)
    pixels = _pixels_of(images, argument, white)
    pixels = _channels_first(pixels, argument, choose=not is_array)
    is_bgr = lookup(color, get_args(Color), "order of channels") == "bgr"
    # Files and Pillow images are RGB already.
    has_order = is_array or isinstance(images, Tensor)
    return pixels.flip(1) if is_bgr and has_order else pixels


def as_batch(images: ImageLike) -> Tensor:
    """Convert images to `(B, C, H, W)`; batches of floats stay as they are, with any number of channels and range."""
    if isinstance(images, Tensor) and images.ndim == 4 and images.is_floating_point():
        # A graph with dynamic sizes would be bound to them.
        if values_known(images):
            _, rows, columns, last = images.shape
            are_last = last in (3, 4) and min(rows, columns) >= _SMALLEST_SIDE
            got = f"{tuple(images.shape)}, with channels last; take images.permute(0, 3, 1, 2)"
            check(not are_last, "image", "(batch, channels, height, width)", got)
        return images
    return as_images(images)


def _pixels_of(image: ImageLike, argument: str, white: White | None) -> Tensor:
    """Convert a picture to a tensor; arrays and tensors keep their layout, without `white` also their dtype."""
    if white is not None and isinstance(image, Tensor | np.ndarray):
        return _between_limits(image, argument, white)
    if isinstance(image, Tensor):
        check(image.layout == torch.strided, argument, "a dense tensor", "a sparse one; use image.to_dense()")
        return image
    if isinstance(image, np.ndarray):
        return _native(image, argument)
    if isinstance(image, str | PathLike):
        check_local(image, argument)
        return read_image(image, white=white)
    from PIL.Image import Image

    if isinstance(image, Image):
        return from_pillow(image, argument, white)
    expected = "a path, a Pillow image, a NumPy array or a tensor"
    raise InputError(f"{argument}: expected {expected}, got {_other_kind(image)}")


def _between_limits(image: Tensor | Values, argument: str, white: White) -> Tensor:
    """Convert an array or a tensor of numbers to [0, 1] by the values that are black and white."""
    values = np.asarray(image.detach().cpu() if isinstance(image, Tensor) else image)
    are_numbers = values.dtype.kind in "buif" and values.size > 0
    check(are_numbers, argument, "numbers", f"{values.dtype} {values.shape}")
    limits = black_and_white(white, values)
    return torch.from_numpy(between(values, limits))


def _native(array: Values, argument: str) -> Tensor:
    """Convert an array to a tensor, in a dtype that torch has and in the byte order of the machine."""
    name = f"{array.dtype.kind}{array.dtype.itemsize}"
    is_signed = array.dtype.kind == "i"
    remedy = "; convert it to bytes, array.astype('uint8'), or give white=" if is_signed else ""
    check(name in _DTYPES, argument, "bytes, 16-bit numbers or floats", f"an array of {array.dtype}{remedy}")
    return torch.from_numpy(np.array(array, dtype=_DTYPES[name], order="C"))


def _other_kind(image: object) -> str:
    """Say what is given in place of a picture, and the remedy."""
    kind = type(image).__name__
    if image is None:
        return "None (OpenCV returns None for a file that it cannot read); check the path"
    if isinstance(image, bytes | bytearray | memoryview):
        return f"{kind} of a file; open them with PIL.Image.open(io.BytesIO(…))"
    if isinstance(image, IOBase):
        return f"an open file, {kind}; give its path, or open it with PIL.Image.open"
    if isinstance(image, Sequence):
        return f"a {kind}; give pictures one by one, or all of them to semfov.run"
    return kind


def check_local(path: str | PathLike[str], argument: str) -> None:
    """Raise `InputError` for an address, which is no file on this machine."""
    kind, separator, _ = str(path).partition("://")
    remedy = "it is a stream; use live, or semfov.data.sources.open_stream" if kind in STREAMS else "download it first"
    check(not separator, argument, "a file on this machine", f"an address, {kind}://…; {remedy}")


def _channels_first(pixels: Tensor, argument: str, *, choose: bool) -> Tensor:
    """Move the channels to the front.

    Args:
        pixels: one picture or several, grey or RGB, in one of the usual orders.
        argument: name of the argument, for the message.
        choose: take `(3, H, 3)`, which may be both, as channels first.

    Returns:
        `(B, 3, H, W)`; grey pictures have three equal channels.
    """
    shape = tuple(pixels.shape)
    check(2 <= len(shape) <= 4, argument, _SHAPES, f"shape {shape}")
    check(pixels.numel() > 0, argument, "at least one pixel", f"shape {shape}")
    if len(shape) == 2:
        return pixels.expand(1, 3, *shape)
    batch = pixels if len(shape) == 4 else pixels[None]
    ends = batch.shape[1], batch.shape[-1]
    if 3 not in ends and 1 not in ends:
        remedy = "; drop the fourth channel, or give the Pillow image" if 4 in ends else ""
        raise InputError(f"{argument}: expected {_SHAPES}, with 3 channels or 1, got shape {shape}{remedy}")
    channels = 3 if 3 in ends else 1
    got = f"shape {shape}, which is ambiguous; give a tensor (3, H, W)"
    check(choose or ends != (channels, channels), argument, _SHAPES, got)
    channels_first = batch if ends[0] == channels else batch.movedim(-1, 1)
    return channels_first.expand(-1, 3, -1, -1)


def as_points(points: PointLike, argument: str = "gaze") -> Tensor:
    """Convert points to a tensor.

    Args:
        points: one or several; tensors stay as they are, other numbers become float64.
        argument: name of the argument, for the message.

    Returns:
        `(..., 2)`.

    Raises:
        InputError: they are no such pairs.
    """
    if isinstance(points, Tensor):
        return points
    try:
        array = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(f"{argument}: expected numbers (x, y), or several such pairs, got {points!r:.80}") from None
    check(array.shape[-1:] == (2,), argument, "(x, y), or several such pairs", points)
    # A copy, as the caller may go on writing to the array.
    return torch.from_numpy(array.copy())


def as_positions(values: Tensor, like: Tensor | torch.dtype | None = None) -> Tensor:
    """Convert positions to a precision of at least float32.

    Args:
        values: of any shape.
        like: a tensor with the device and the precision of the result, or a precision; None for their own.

    Returns:
        The positions.
    """
    dtype = values.dtype
    device = values.device
    if like is None and dtype in _PRECISE:
        return values
    if isinstance(like, Tensor):
        dtype = like.dtype
        device = like.device
    elif like is not None:
        dtype = like
    # Half precision is off by pixels from 2,048 on, and whole numbers cut the fractions of what is added to them.
    return values.to(device, torch.promote_types(dtype, torch.float32))
