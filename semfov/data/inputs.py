"""Pictures and points as people have them, made into the tensors that the library works on."""

from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeAlias, Union

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.images import from_pillow, read_image
from semfov.errors import InputError, check, check_pixels

if TYPE_CHECKING:
    from PIL.Image import Image

ImageLike: TypeAlias = Union[Tensor, NDArray[Any], str, PathLike[str], "Image"]
"""A picture: its file, an image of Pillow's, an array or a tensor; see `as_image`."""

PointLike: TypeAlias = Tensor | NDArray[Any] | Sequence[Any]
"""One point `(x, y)` or several: a tensor, an array, a tuple or a list."""

_WHITE = {torch.uint8: 255, torch.uint16: 65535}
_SHAPES = "a picture of shape (3, H, W), (H, W, 3) or (H, W)"


def as_image(image: ImageLike, *, like: Tensor | None = None, argument: str = "image") -> Tensor:
    """One picture of any common kind as RGB in [0, 1].

    - A path: a file that Pillow reads (`semfov.read_image`).
    - An image of Pillow's, in any mode: it is turned upright, transparent pixels are laid on white.
    - A NumPy array or a tensor: `(3, H, W)`, `(H, W, 3)`, grey `(H, W)`, `(1, H, W)` or `(H, W, 1)`, or a batch of one
      of them. Floats are in [0, 1], bytes and 16-bit numbers go up to their largest. Channels are RGB: what OpenCV
      reads is BGR, `array[..., ::-1]` turns it round. A tensor of shape `(3, H, 3)` has its channels first.

    Gradients flow through tensors.

    Args:
        image: the picture.
        like: a tensor whose dtype and device the result takes; None keeps those of floats, and makes the rest float32.
        argument: what messages call the picture.

    Returns:
        `(3, H, W)`.

    Raises:
        InputError: it is no picture, several, or has other values than [0, 1]; the message says what to do.
        DataError: the file cannot be read.

    >>> as_image(np.zeros((48, 64, 3), np.uint8)).shape
    torch.Size([3, 48, 64])
    """
    images = as_images(image, like=like, argument=argument)
    check(len(images) == 1, argument, "one picture", f"a batch of {len(images)}; give them one by one")
    return images[0]


def as_images(images: ImageLike, *, like: Tensor | None = None, argument: str = "image") -> Tensor:
    """One picture or a batch of them, `(B, 3, H, W)`; see `as_image`.

    >>> as_images(torch.rand(2, 3, 8, 9)).shape
    torch.Size([2, 3, 8, 9])
    """
    pixels = channels_first(pixels_of(images, argument), argument, choose=isinstance(images, Tensor))
    pixels = _in_unit(pixels, like, argument)
    check_pixels(pixels, argument)
    return pixels


def is_batch(image: object) -> bool:
    """Whether this is a batch of pictures, not a single one."""
    return isinstance(image, Tensor | np.ndarray) and image.ndim > 3


def pixels_of(image: ImageLike, argument: str = "image") -> Tensor:
    """Pixels of a picture, in the layout and of the dtype that it has."""
    if isinstance(image, Tensor):
        return image
    if isinstance(image, np.ndarray):
        return _from_numpy(image, argument)
    if isinstance(image, str | PathLike):
        check("://" not in str(image), argument, "a file on this machine", f"{str(image)!r}; download it first")
        return read_image(image)
    from PIL.Image import Image

    if isinstance(image, Image):
        return from_pillow(image, argument)
    expected = "a path, an image of Pillow's, a NumPy array or a tensor"
    got = type(image).__name__
    if image is None:
        got = "None, which is what OpenCV gives for a file that it cannot read"
    elif isinstance(image, Sequence):
        got = f"a {got}; give pictures one by one"
    raise InputError(f"{argument}: expected {expected}, got {got}")


def channels_first(pixels: Tensor, argument: str = "image", *, choose: bool = True) -> Tensor:
    """Pixels `(B, 3, H, W)` from those of one picture or several in any layout that `as_image` knows.

    Args:
        pixels: of any dtype.
        argument: what messages call them.
        choose: take a picture that has three rows and three columns of channels to have its channels first.
    """
    shape = tuple(pixels.shape)
    check(2 <= len(shape) <= 4, argument, _SHAPES, f"shape {shape}")
    check(pixels.numel() > 0, argument, "at least one pixel", f"shape {shape}")
    if len(shape) == 2:
        return pixels.expand(1, 3, *shape)
    batch = pixels if len(shape) == 4 else pixels[None]
    for channels in (3, 1):
        first, last = batch.shape[1] == channels, batch.shape[-1] == channels
        if first and last and not choose:
            raise InputError(
                f"{argument}: expected {_SHAPES}, got shape {shape}, which may be either; give a tensor (3, H, W)"
            )
        if first or last:
            batch = batch if first else batch.movedim(-1, 1)
            return batch.expand(-1, 3, -1, -1)
    remedy = "; of four channels drop the last, or give the image of Pillow's" if 4 in (shape[-1], shape[-3]) else ""
    raise InputError(f"{argument}: expected {_SHAPES}, with 3 channels or 1, got shape {shape}{remedy}")


def as_points(points: PointLike, argument: str = "gaze") -> Tensor:
    """Points `(x, y)` in pixels as a tensor `(..., 2)`: tensors as they are, numbers in double precision.

    >>> as_points((320, 240))
    tensor([320., 240.], dtype=torch.float64)
    """
    if isinstance(points, Tensor):
        return points
    try:
        array = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{argument}: expected numbers (x, y), or several such pairs, got {points!r}") from None
    check(array.shape[-1:] == (2,), argument, "(x, y), or several such pairs", points)
    return torch.from_numpy(array.copy())


def _from_numpy(array: NDArray[Any], argument: str) -> Tensor:
    """An array as a tensor, whatever its order in memory."""
    kinds = {"u1", "u2", "f2", "f4", "f8", "f16"}
    name = f"{array.dtype.kind}{array.dtype.itemsize}"
    check(name in kinds, argument, "bytes, 16-bit numbers or floats", f"an array of {array.dtype}{_integers(array)}")
    native = np.float64 if name == "f16" else np.dtype(name)
    return torch.from_numpy(np.array(array, dtype=native, order="C"))


def _integers(array: NDArray[Any]) -> str:
    return "; make it uint8, array.astype('uint8')" if array.dtype.kind == "i" else ""


def _in_unit(pixels: Tensor, like: Tensor | None, argument: str) -> Tensor:
    """Pixels as floats, bytes and 16-bit numbers divided by their largest; dtype and device as `like`."""
    dtype = like.dtype if like is not None else pixels.dtype if pixels.is_floating_point() else torch.float32
    if pixels.is_floating_point():
        return pixels.to(pixels.device if like is None else like.device, dtype)
    got = f"a tensor of {pixels.dtype}; make bytes of it, image.to(torch.uint8), or floats in [0, 1]"
    check(pixels.dtype in _WHITE, argument, "bytes, 16-bit numbers or floats", got)
    return pixels.to(pixels.device if like is None else like.device, dtype) / _WHITE[pixels.dtype]
