"""Large pictures that are read window by window: arrays, memory maps, TIFFs, rasters, and files decoded when needed."""

from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.images import (
    check_proportion,
    open_pillow,
    opening,
    orientation,
    over_white,
    read_image,
    turned,
)
from semfov.data.inputs import Color, ImageLike, as_image, channels_first, check_local, in_rgb, pixels_of
from semfov.data.raster import RasterPicture
from semfov.data.reduction import PixelBox
from semfov.data.tiff import TiffPicture, is_converted
from semfov.data.tone import White, black_and_white, check_white
from semfov.data.windowed import BY_WINDOWS, RASTERS, TILED, ChosenBands, LargePicture
from semfov.errors import DataError, check, check_pixels, lookup

if TYPE_CHECKING:
    from PIL.Image import Image

_ROWS = 64  # of a decoded picture that are converted at once: more leave the cache of the processor
_PLAIN = ("RGB", "RGBA", "L", "LA", "P", "1", "CMYK", "YCbCr")  # modes of up to 8 bits
_WIDTH, _HEIGHT = 256, 257  # tags of a TIFF


class _ArrayPicture(LargePicture):
    """A picture in an array, which may be a `numpy.memmap`; only the pixels of the windows are read; array `(H, W, 3)`.

    Shapes: array `(H, W, 3)`.
    """

    def __init__(self, array: NDArray[np.uint8]) -> None:
        fits = array.dtype == np.uint8 and (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3))
        check(fits and array.size > 0, "array", "bytes of shape (H, W, 3) or (H, W)", f"{array.dtype} {array.shape}")
        self._array = array
        self.size = array.shape[1], array.shape[0]

    def pixels(self, box: PixelBox) -> NDArray[np.uint8]:
        x1, y1, x2, y2 = box
        window = self._array[y1:y2, x1:x2]
        return np.repeat(window[..., None], 3, -1) if window.ndim == 2 else window


class _MemoryPicture(_ArrayPicture):
    """A picture of any common type (`semfov.as_image`), kept in memory as bytes."""

    def __init__(self, image: ImageLike, *, color: Color = "rgb", white: White | None = None) -> None:
        if (
            white is None
            and isinstance(image, Tensor | np.ndarray)
            and image.dtype in (torch.uint8, np.dtype(np.uint8))
        ):
            # Bytes are not converted to floats in between, which would take four times the memory.
            pixels = channels_first(pixels_of(image, "picture"), "picture", choose=isinstance(image, Tensor))
            check(len(pixels) == 1, "picture", "one picture", f"a batch of {len(pixels)}; give them one by one")
            super().__init__(to_bytes(in_rgb(pixels, image, color)[0]))
        else:
            super().__init__(to_bytes(as_image(image, argument="picture", color=color, white=white).detach()))


def to_bytes(image: Tensor) -> NDArray[np.uint8]:
    """Bytes `(H, W, 3)` of an image `(3, H, W)`, which is RGB in [0, 1] or bytes."""
    if image.dtype != torch.uint8:
        check_pixels(image, "image")
        image = image.clamp(0, 1).mul(255).round()
    pixels: NDArray[np.uint8] = image.permute(1, 2, 0).to("cpu", torch.uint8).contiguous().numpy()
    return pixels


class _PhotographPicture(LargePicture):
    """A picture in a file that Pillow reads."""

    path: Path

    def __init__(self, path: str | PathLike[str], white: White | None = None) -> None:
        self.path, self._white = Path(path), white
        self._array: NDArray[np.uint8] | None = None
        with opening(self.path, "opened"), open_pillow(self.path) as image:
            check_proportion(image, self.path)
            self.size = _upright_size(image)

    def pixels(self, box: PixelBox) -> NDArray[np.uint8]:
        x1, y1, x2, y2 = box
        if self._array is None:
            with opening(self.path, "decoded"), open_pillow(self.path) as image:
                if image.mode in _PLAIN and self._white is None:
                    stored = orientation(image)
                    image.load()
                    self._array = _rgb(turned(image, stored, orientation(image), upright=True))
                else:
                    self._array = to_bytes(read_image(self.path, white=self._white))
        return self._array[y1:y2, x1:x2]


def _rgb(image: "Image") -> NDArray[np.uint8]:
    """Bytes `(H, W, 3)` of a Pillow image of 8 bits, converted a few rows at a time."""
    width, height = image.size
    array = np.empty((height, width, 3), np.uint8)
    for top in range(0, height, _ROWS):
        rows = image.crop((0, top, width, min(top + _ROWS, height)))
        array[top : top + _ROWS] = np.asarray(over_white(rows).convert("RGB"))
    return array


def open_large(
    source: LargePicture | ImageLike, *, color: Color = "rgb", white: White | None = None, bands: ChosenBands = None
) -> LargePicture:
    """Open a picture of any common type (`semfov.as_image`) for reading window by window.

    Files `.tif` and `.tiff` are read tile by tile if `tifffile` is installed, and by rasterio if that is installed and
    they have overviews or are of a kind that `tifffile` leaves; else as other photographs. Rasters `.vrt` and `.jp2`
    need rasterio. Arrays of bytes `(H, W, 3)` and `(H, W)` are not copied, so only the windows of a
    `numpy.memmap` are read.

    With `white`, numbers of any type are scaled to bytes: a thermal picture, reflectances, 12 bits in 16.
    """
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
    if (
        isinstance(source, np.ndarray)
        and source.dtype == np.uint8
        and white is None
        and source.size
        and (source.ndim == 2 or (source.ndim == 3 and source.shape[2] == 3 and source.shape[0] != 3))
    ):
        swap = lookup(color, get_args(Color), "order of channels") == "bgr" and source.ndim == 3
        return _ArrayPicture(source[..., ::-1] if swap else source)
    if not isinstance(source, str | PathLike):
        return _MemoryPicture(source, color=color, white=white)
    check_local(source, "picture")
    opened = _raster if kind in RASTERS else _tiff if kind in TILED else _photograph
    picture = opened(source, white, bands)
    if white is not None or bands is not None:
        values = white if white is None or isinstance(white, str) else black_and_white(white, np.zeros(0))
        picture.shown = {"white": values, "bands": bands}
    return picture


def _photograph(path: str | PathLike[str], white: White | None, bands: ChosenBands) -> LargePicture:
    """A photograph that is decoded as a whole, and has no bands to choose from."""
    return _PhotographPicture(path, white)


def _raster(path: str | PathLike[str], white: White | None, bands: ChosenBands) -> LargePicture:
    """A raster read by windows; JPEG 2000 by Pillow where rasterio is not there."""
    try:
        return RasterPicture(path, white=white, bands=bands)
    except DataError:
        if Path(path).suffix.lower() == ".jp2" and bands is None:
            with suppress(DataError):
                return _PhotographPicture(path, white)
        raise


def _tiff(path: str | PathLike[str], white: White | None, bands: ChosenBands) -> LargePicture:
    """A TIFF read by windows; by rasterio if it has overviews, or of a kind that `tifffile` leaves; else by Pillow."""
    if is_converted(path):
        expected = f"None for {path}, which is turned, or of other colours than grey and RGB"
        check(bands is None, "bands", expected, f"{bands}; convert it")
        return _PhotographPicture(path, white)
    try:
        tiff = TiffPicture(path, white=white, bands=bands)
        if not tiff.has_overviews:
            return tiff
    except DataError as error:
        with suppress(DataError):
            return RasterPicture(path, white=white, bands=bands)
        if bands is None:
            with suppress(DataError):
                photograph = _PhotographPicture(path, white)
                photograph.read((0, 0, 1, 1))
                return photograph
        raise error from None
    try:
        return RasterPicture(path, white=white, bands=bands)
    except DataError:
        return tiff


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
            return _upright_size(image)
    if isinstance(source, Pillow.Image):
        return _upright_size(source)
    height, width = channels_first(pixels_of(source, "picture"), "picture").shape[-2:]
    return width, height


def _upright_size(image: "Image") -> tuple[int, int]:
    """Size of a Pillow image after it is turned upright."""
    if orientation(image) < 5:
        return image.size
    # Pillow swaps the sides of TIFFs itself before it turns them.
    tags = getattr(image, "tag_v2", {})
    width, height = tags.get(_WIDTH, image.size[0]), tags.get(_HEIGHT, image.size[1])
    return height, width
