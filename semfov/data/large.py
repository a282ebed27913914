"""Large pictures that are read window by window: arrays, memory maps, TIFFs, rasters, and files decoded when needed."""

from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.images import PhotographPicture, open_pillow, opening, to_bytes, upright_size
from semfov.data.inputs import Color, ImageLike, as_image, as_pixels, check_local
from semfov.data.tone import White, check_white, stated_limits
from semfov.data.windowed import Box, ChosenBands, LargePicture, check_bands, check_no_bands, has_windows
from semfov.errors import DataError, check, lookup


class ArrayPicture(LargePicture):
    """A picture in an array `(H, W, 3)`, or `(H, W)` in grey, which may be a `numpy.memmap`.

    Only the pixels of windows are read.
    """

    def __init__(self, array: NDArray[np.uint8]) -> None:
        is_picture = array.ndim >= 2 and array.shape[2:] in ((), (3,))
        are_bytes = array.dtype == np.uint8 and array.size > 0
        got = f"{array.dtype} {array.shape}"
        check(is_picture and are_bytes, "array", "bytes of shape (H, W, 3) or (H, W)", got)
        self._array = array
        self.size = array.shape[1], array.shape[0]

    def pixels(self, box: Box) -> NDArray[np.uint8]:
        x1, y1, x2, y2 = box
        window = self._array[y1:y2, x1:x2]
        return np.repeat(window[..., None], 3, -1) if window.ndim == 2 else window

    def copied(self) -> "ArrayPicture":
        """Copy the picture, so that it stays as it is whatever is written to the array.

        Returns:
            The copy, whose pixels lie in memory in their order.
        """
        return ArrayPicture(np.array(self._array, order="C"))


def open_large(
    source: LargePicture | ImageLike, *, color: Color = "rgb", white: White | None = None, bands: ChosenBands = None
) -> LargePicture:
    """Open a picture of any common type (`semfov.as_image`) for reading by windows.

    Args:
        source: the picture; one that is open is given back.
        color: order of the channels of arrays and tensors.
        white: as for `semfov.read_image`.
        bands: the number of a band of a TIFF or a raster, or three for red, green and blue, from 1; None for those that
            the file names.

    Returns:
        The open picture.

    Raises:
        InputError: it is no picture, or an argument is not for such a picture.
        DataError: the file cannot be read.
    """
    check_white(white)
    check_bands(bands)
    if isinstance(source, LargePicture):
        check(white is None and bands is None, "white", "None for a picture that is open; give it to open_large", white)
        return source
    if isinstance(source, str | PathLike):
        return _open_file(source, white, bands)
    check_no_bands(bands)
    return ArrayPicture(_bytes_of(source, color, white))


def _open_file(path: str | PathLike[str], white: White | None, bands: ChosenBands) -> LargePicture:
    """Open a file by the readers of its kind, and note how its values are shown."""
    check_local(path, "picture")
    if has_windows(path):
        from semfov.data.rasters import open_by_windows

        picture: LargePicture = open_by_windows(path, white=white, bands=bands)
    else:
        check_no_bands(bands)
        picture = PhotographPicture(path, white)
    if white is not None or bands is not None:
        # With which a record can open the file again; percentiles stay a word.
        limits = white if isinstance(white, str | None) else stated_limits(white)
        picture.shown = {"white": limits, "bands": bands}
    return picture


def _bytes_of(source: ImageLike, color: Color, white: White | None) -> NDArray[np.uint8]:
    """Convert a picture in memory to bytes, `(H, W, 3)` or `(H, W)`; an array of them is not copied."""
    is_copied = white is not None or not _is_of_bytes(source)
    if is_copied:
        return to_bytes(as_image(source, argument="picture", color=color, white=white).detach())
    if isinstance(source, np.ndarray) and _has_channels_last(source):
        is_bgr = lookup(color, get_args(Color), "order of channels") == "bgr"
        has_colours = source.ndim == 3
        return source[..., ::-1] if is_bgr and has_colours else source
    # Bytes are not converted to floats in between, which would take four times the memory.
    pixels = as_pixels(source, argument="picture", color=color)
    check(len(pixels) == 1, "picture", "one picture", f"a batch of {len(pixels)}; give them one by one")
    return to_bytes(pixels[0])


def _is_of_bytes(source: ImageLike) -> bool:
    """Tell whether a picture is an array or a tensor of bytes."""
    return isinstance(source, Tensor | np.ndarray) and source.dtype in (torch.uint8, np.dtype(np.uint8))


def _has_channels_last(array: NDArray[np.uint8]) -> bool:
    """Tell whether an array is grey, or has its three channels last beyond doubt."""
    if not array.size:
        return False
    return array.ndim == 2 or (array.shape[2:] == (3,) and array.shape[0] != 3)


def picture_size(source: LargePicture | ImageLike) -> tuple[int, int]:
    """Tell the size of a picture of any common type, without decoding a file.

    Args:
        source: the picture, as for `open_large`.

    Returns:
        `(width, height)`.

    Raises:
        DataError: the file cannot be read.
    """
    from PIL import Image as Pillow

    if isinstance(source, LargePicture):
        return source.size
    if isinstance(source, str | PathLike):
        return _size_of_file(Path(source))
    if isinstance(source, Pillow.Image):
        return upright_size(source)
    height, width = as_pixels(source, argument="picture").shape[-2:]
    return width, height


def _size_of_file(path: Path) -> tuple[int, int]:
    """Read `(width, height)` of a picture from its head, by the reader of its kind."""
    if has_windows(path):
        # A white, whichever, lets floats in. A file of another kind than its name says is Pillow's.
        with suppress(DataError):
            return open_large(path, white=1.0).size
    with opening(path, "opened"), open_pillow(path) as image:
        return upright_size(image)
