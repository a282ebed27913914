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
from semfov.data.rasters import open_by_windows
from semfov.data.tone import White, black_and_white, check_white
from semfov.data.windowed import BY_WINDOWS, ChosenBands, LargePicture
from semfov.errors import DataError, check, lookup

_Box = tuple[int, int, int, int]


class _ArrayPicture(LargePicture):
    """A picture in an array `(H, W, 3)`, which may be a `numpy.memmap`: only the pixels of windows are read."""

    def __init__(self, array: NDArray[np.uint8]) -> None:
        fits = array.dtype == np.uint8 and (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3))
        check(fits and array.size > 0, "array", "bytes of shape (H, W, 3) or (H, W)", f"{array.dtype} {array.shape}")
        self._array = array
        self.size = array.shape[1], array.shape[0]

    def pixels(self, box: _Box) -> NDArray[np.uint8]:
        x1, y1, x2, y2 = box
        window = self._array[y1:y2, x1:x2]
        return np.repeat(window[..., None], 3, -1) if window.ndim == 2 else window


def open_large(
    source: LargePicture | ImageLike, *, color: Color = "rgb", white: White | None = None, bands: ChosenBands = None
) -> LargePicture:
    """Open a picture of any common type (`semfov.as_image`) for reading by windows; `white` scales numbers to bytes."""
    # TIFFs are read by tifffile, by rasterio if they have overviews or tifffile leaves them, else as other photographs.
    check_white(white)
    if bands is not None:
        numbers = [*bands] if isinstance(bands, tuple | list) else [bands]
        fits = len(numbers) in (1, 3) and all(type(each) is int and each >= 1 for each in numbers)
        check(fits, "bands", "the number of a band, or three for red, green and blue, from 1", bands)
    if isinstance(source, LargePicture):
        check(white is None and bands is None, "white", "None for a picture that is open; give it to open_large", white)
        return source
    kind = Path(source).suffix.lower() if isinstance(source, str | PathLike) else ""
    expected = "None but for TIFFs and rasters (choose the channels of an array yourself, array[..., [3, 2, 1]])"
    check(bands is None or kind in BY_WINDOWS, "bands", expected, bands)
    rows = isinstance(source, np.ndarray) and (source.ndim == 2 or (source.shape[2:] == (3,) and source.shape[0] != 3))
    of_bytes = isinstance(source, Tensor | np.ndarray) and source.dtype in (torch.uint8, np.dtype(np.uint8))
    if isinstance(source, np.ndarray) and white is None and of_bytes and source.size and rows:
        swap = lookup(color, get_args(Color), "order of channels") == "bgr" and source.ndim == 3
        return _ArrayPicture(source[..., ::-1] if swap else source)
    if not isinstance(source, str | PathLike):
        if white is None and of_bytes:
            # Bytes are not converted to floats in between, which would take four times the memory.
            pixels = as_pixels(source, argument="picture", color=color)
            check(len(pixels) == 1, "picture", "one picture", f"a batch of {len(pixels)}; give them one by one")
            return _ArrayPicture(to_bytes(pixels[0]))
        return _ArrayPicture(to_bytes(as_image(source, argument="picture", color=color, white=white).detach()))
    check_local(source, "picture")
    if kind in BY_WINDOWS:
        picture = open_by_windows(source, white=white, bands=bands)
    else:
        picture = PhotographPicture(source, white)
    if white is not None or bands is not None:
        values = white if white is None or isinstance(white, str) else black_and_white(white, np.zeros(0))
        picture.shown = {"white": values, "bands": bands}
    return picture


def picture_size(source: LargePicture | ImageLike) -> tuple[int, int]:
    """Size of a picture of any common type, without decoding a file; → `(width, height)`."""
    from PIL import Image as Pillow

    if isinstance(source, LargePicture):
        return source.size
    if isinstance(source, str | PathLike):
        path = Path(source)
        if path.suffix.lower() in BY_WINDOWS:
            with suppress(DataError):
                return open_large(path).size
        with opening(path, "opened"), open_pillow(path) as image:
            return upright_size(image)
    if isinstance(source, Pillow.Image):
        return upright_size(source)
    height, width = as_pixels(source, argument="picture").shape[-2:]
    return width, height
