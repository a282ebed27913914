"""Large pictures that are read window by window: arrays, memory maps, TIFFs, rasters, and files decoded when needed."""

import lzma
import warnings
import weakref
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.gdal import MOST_SIDE, open_raster, raster_settings
from semfov.data.images import (
    MAX_PIXELS,
    check_proportion,
    check_tile,
    open_pillow,
    orientation,
    over_white,
    read_image,
    turned,
    warn_of_range,
)
from semfov.data.inputs import Color, ImageLike, as_image, channels_first, check_local, in_rgb, pixels_of
from semfov.data.reduction import (
    FIRST,
    LARGE,
    OVERSAMPLING,
    PixelBox,
    ReducedCopies,
    bytes_of,
    first_for,
    reduction_for,
)
from semfov.errors import DataError, SemfovError, check, check_pixels, lookup
from semfov.io.files import check_regular

if TYPE_CHECKING:
    from PIL.Image import Image

RASTERS = (".vrt", ".jp2")
"""Ends of the names of files that only GDAL reads by windows; TIFFs can also be read without it."""

_ROWS = 64  # of a decoded picture that are converted at once: more leave the cache of the processor
_TILED = (".tif", ".tiff")
_PLAIN = ("RGB", "RGBA", "L", "LA", "P", "1", "CMYK", "YCbCr")  # modes of up to 8 bits
_WHITE_IS_ZERO, _PALETTE, _YCBCR = 0, 3, 6  # photometric interpretations of a TIFF
_PREMULTIPLIED, _UNASSOCIATED = 1, 2  # kinds of a fourth channel
_SEEN = 64  # side of the windows in which the range of a picture of 16 bits is looked at
_JPEG = 7
_WIDTH, _HEIGHT, _COMPRESSION, _PHOTOMETRIC, _ORIENTATION, _SAMPLES = 256, 257, 259, 262, 274, 277
_INFLATED = 2**18  # bytes of a tile that is inflated for a look first: fewer inflate to 270 MB at most
_INFLATERS: dict[int, Callable[[], Any]] = {
    8: zlib.decompressobj,
    32946: zlib.decompressobj,
    34925: lzma.LZMADecompressor,
}
"""Decoders of compressions whose data may inflate a thousandfold, by their numbers in a TIFF."""


class LargePicture(ABC):
    """Base of 8-bit pictures that are read window by window; size `(width, height)`."""

    size: tuple[int, int]
    path: Path | None = None

    @abstractmethod
    def pixels(self, box: PixelBox) -> NDArray[np.uint8]:
        """Read a window; → `(h, w, 3)`."""

    def reduction(self, ratio: float, oversampling: float = OVERSAMPLING) -> int:
        """Factor by which windows are read that are resampled afterwards; their edges are to be multiples of it."""
        many = self.size[0] * self.size[1] > LARGE
        reduction = reduction_for(ratio, oversampling) if many else 1
        return reduction if reduction >= self._first else 1

    def read(self, box: PixelBox, reduction: int = 1) -> Tensor:
        """Read a window; coarse windows of pictures of more than 16 million pixels are read from reduced copies.

        The copies are made strip by strip, when one is first needed. So no more than a strip of 8 million pixels (25
        MB) is in memory at full resolution. They are kept, and take a twelfth of the memory of the whole picture, and
        at most 134 MB: copies of pictures of more than 537 million pixels begin at a coarser one.

        Shapes: → `(3, h, w)`.
        """
        self._inside(box)
        if reduction < self._first or self.size[0] * self.size[1] <= LARGE:
            return bytes_of(self.pixels(box))
        return self._copies.window(box, reduction)

    def _inside(self, box: PixelBox) -> PixelBox:
        """The box; raises `InputError` where it is empty or not inside the picture."""
        x1, y1, x2, y2 = box
        width, height = self.size
        inside = 0 <= x1 < x2 <= width and 0 <= y1 < y2 <= height
        check(inside, "box", f"a window inside {width} × {height} pixels", box)
        return box

    @cached_property
    def _first(self) -> int:
        """Least factor by which windows are read reduced."""
        return first_for(self.size)

    @cached_property
    def _copies(self) -> ReducedCopies:
        return ReducedCopies(self.size, self.pixels)


class _ArrayPicture(LargePicture):
    """A picture in an array, which may be a `numpy.memmap`; only the pixels of the windows are read.

    Shapes: array `(H, W, 3)`.
    """

    def __init__(self, array: NDArray[np.uint8]) -> None:
        fits = array.dtype == np.uint8 and (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3))
        check(fits and array.size > 0, "array", "bytes of shape (H, W, 3) or (H, W)", f"{array.dtype} {array.shape}")
        self._array = array
        self.size = array.shape[1], array.shape[0]

    def pixels(self, box: PixelBox) -> NDArray[np.uint8]:
        """Read a window."""
        x1, y1, x2, y2 = box
        window = self._array[y1:y2, x1:x2]
        return np.repeat(window[..., None], 3, -1) if window.ndim == 2 else window


class _MemoryPicture(_ArrayPicture):
    """A picture of any common type (`semfov.as_image`), kept in memory as bytes."""

    def __init__(self, image: ImageLike, *, color: Color = "rgb") -> None:
        if isinstance(image, Tensor | np.ndarray) and image.dtype in (torch.uint8, np.dtype(np.uint8)):
            # Bytes are not converted to floats in between, which would take four times the memory.
            pixels = channels_first(pixels_of(image, "picture"), "picture", choose=isinstance(image, Tensor))
            check(len(pixels) == 1, "picture", "one picture", f"a batch of {len(pixels)}; give them one by one")
            super().__init__(to_bytes(in_rgb(pixels, image, color)[0]))
        else:
            super().__init__(to_bytes(as_image(image, argument="picture", color=color).detach()))


def to_bytes(image: Tensor) -> NDArray[np.uint8]:
    """Bytes `(H, W, 3)` of an image `(3, H, W)`, which is RGB in [0, 1] or bytes."""
    if image.dtype != torch.uint8:
        check_pixels(image, "image")
        image = image.clamp(0, 1).mul(255).round()
    pixels: NDArray[np.uint8] = image.permute(1, 2, 0).to("cpu", torch.uint8).contiguous().numpy()
    return pixels


def _from_16(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Bytes, of bytes or of 16-bit numbers, whose white is 65535."""
    if pixels.dtype == np.uint16:
        pixels = (pixels.astype(np.uint32) * 255 + 32767) // 65535
    return pixels.astype(np.uint8, copy=False)


class _PhotographPicture(LargePicture):
    """A picture in a file that Pillow reads.

    Formats such as JPEG cannot be read window by window. The whole picture is decoded when a window is first needed,
    and is kept in memory (three bytes for each pixel). Its pixels are those that `semfov.data.read_image` reads.
    """

    path: Path

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        self._array: NDArray[np.uint8] | None = None
        with _opening(self.path, "opened"), open_pillow(self.path) as image:
            check_proportion(image, self.path)
            self.size = _upright_size(image)

    def pixels(self, box: PixelBox) -> NDArray[np.uint8]:
        """Read a window."""
        x1, y1, x2, y2 = box
        if self._array is None:
            with _opening(self.path, "decoded"), open_pillow(self.path) as image:
                if image.mode in _PLAIN:
                    stored = orientation(image)
                    image.load()
                    self._array = _rgb(turned(image, stored, orientation(image), upright=True))
                else:
                    self._array = to_bytes(read_image(self.path))
        return self._array[y1:y2, x1:x2]


def _rgb(image: "Image") -> NDArray[np.uint8]:
    """Bytes `(H, W, 3)` of a Pillow image of 8 bits, converted a few rows at a time."""
    width, height = image.size
    array = np.empty((height, width, 3), np.uint8)
    for top in range(0, height, _ROWS):
        rows = image.crop((0, top, width, min(top + _ROWS, height)))
        array[top : top + _ROWS] = np.asarray(over_white(rows).convert("RGB"))
    return array


class _TiffPicture(LargePicture):
    """A TIFF of 8 or 16 bits, read tile by tile (or strip by strip) through `tifffile`.

    Only the tiles that overlap a window are decoded, one at a time. Those of 16 bits are scaled by their white, 65535,
    to 8 bits.
    """

    path: Path

    def __init__(self, path: str | PathLike[str]) -> None:
        try:
            import tifffile
        except ImportError:
            raise DataError(f"{path}: expected tifffile for reading TIFFs; pip install tifffile") from None
        self.path = Path(path)
        with _opening(self.path, "opened"):
            self._file = tifffile.TiffFile(path)
            weakref.finalize(self, self._file.close)
            page: Any = self._file.pages[0]
            shape = page.shape
        fits = page.dtype in (np.uint8, np.uint16) and (len(shape) == 2 or (len(shape) == 3 and shape[2] in (3, 4)))
        if not fits or page.planarconfig not in (None, 1) or page.photometric == _PALETTE:
            got = "a palette" if page.photometric == _PALETTE else f"{page.dtype} {shape}"
            expected = "grey or RGB with 8 or 16 bits and interleaved channels"
            raise DataError(f"{path}: expected {expected}, got {got}; convert it")
        if page.compression not in tifffile.TIFF.DECOMPRESSORS:
            packed = page.compression.name
            raise DataError(f"{path}: expected imagecodecs for {packed} compression; pip install imagecodecs")
        self._page, self._alpha = page, shape[2:] == (4,) and [*page.extrasamples][:1]
        self.size = shape[1], shape[0]
        if max(self.size) > MOST_SIDE:
            raise DataError(f"{path}: expected at most {MOST_SIDE:,} pixels along a side, got {shape[1]} × {shape[0]}")
        if page.dtype == np.uint16:
            _warn_of_range(self)

    @property
    def has_overviews(self) -> bool:
        """Whether the file has reduced copies of its own, which `tifffile` does not tell apart from other pages."""
        with _opening(self.path, "opened"):
            pages: Any = self._file.pages[1:]
            return bool(self._page.subifds) or any(page.is_reduced for page in pages)

    def pixels(self, box: PixelBox) -> NDArray[np.uint8]:
        """Read a window."""
        with _opening(self.path, "decoded"):
            return self._tiles(box)

    def _tiles(self, box: PixelBox) -> NDArray[np.uint8]:
        x1, y1, x2, y2 = box
        page = self._page
        wide, high = (page.tilewidth, page.tilelength) if page.is_tiled else (self.size[0], page.rowsperstrip)
        across, size = -(-self.size[0] // wide), wide * high * page.samplesperpixel * page.dtype.itemsize
        window = np.zeros((y2 - y1, x2 - x1, 3), np.uint8)
        numbers = [
            row * across + column
            for row in range(y1 // high, -(-y2 // high))
            for column in range(x1 // wide, -(-x2 // wide))
        ]
        for number in numbers:
            offset, count = page.dataoffsets[number], page.databytecounts[number]
            if not count:
                continue  # a tile that is not stored in the file is black
            self._file.filehandle.seek(offset)
            check_tile(size, count, f"image {self.path}")
            data = self._file.filehandle.read(count)
            make = _INFLATERS.get(int(page.compression))
            most = 2 * size + 2**16
            if make is not None and len(data) > _INFLATED and len(make().decompress(data, most)) >= most:
                raise DataError(
                    f"image {self.path}: expected tiles of {size:,} bytes, got one that inflates to more; replace it"
                )
            tile = page.decode(data, number, jpegtables=page.jpegtables)[0][0]
            top, left = number // across * high, number % across * wide
            tile = tile[: self.size[1] - top, : self.size[0] - left]
            rows = slice(max(y1 - top, 0), min(y2 - top, tile.shape[0]))
            columns = slice(max(x1 - left, 0), min(x2 - left, tile.shape[1]))
            at = slice(top + rows.start - y1, top + rows.stop - y1)
            along = slice(left + columns.start - x1, left + columns.stop - x1)
            window[at, along] = self._bytes(tile[rows, columns])
        return window

    def _bytes(self, tile: NDArray[Any]) -> NDArray[np.uint8]:
        """Grey or RGB bytes, in which 0 is black; transparent pixels are blended with white."""
        tile = _from_16(tile)
        if self._alpha in ([_PREMULTIPLIED], [_UNASSOCIATED]):
            share = tile[..., 3:].astype(np.uint16)
            colour = tile[..., :3] if self._alpha == [_PREMULTIPLIED] else (tile[..., :3] * share + 127) // 255
            return np.minimum(colour + (255 - share), 255).astype(np.uint8)
        tile = tile[..., : min(3, tile.shape[-1])]
        return 255 - tile if self._page.photometric == _WHITE_IS_ZERO else tile


class _RasterPicture(LargePicture):
    """A picture in a file that GDAL reads: a cloud-optimised GeoTIFF, a mosaic of files (`.vrt`), JPEG 2000.

    Windows are read alone. Coarse windows are read from the overviews of the file, if it has some. Bands that the file
    calls red, green and blue are the channels, else the first three, or a single one as grey. Bands of 16 bits are
    scaled by their white, 65535, to 8 bits.
    """

    path: Path

    def __init__(self, path: str | PathLike[str]) -> None:
        try:
            self._settings = raster_settings()
        except ImportError:
            raise DataError(f'{path}: expected rasterio for reading it; pip install "semfov[geo]"') from None
        self.path = Path(path)
        with _opening(self.path, "opened"), self._settings:
            self._file: Any = open_raster(self.path)
        weakref.finalize(self, self._file.close)
        meanings = [each.name for each in self._file.colorinterp]
        kinds = {*self._file.dtypes}
        if "palette" in meanings or not kinds <= {"uint8", "uint16"}:
            got = "a palette" if "palette" in meanings else ", ".join(sorted(kinds))
            raise DataError(f"{path}: expected bands of 8 or 16 bits, got {got}; convert it (gdal_translate)")
        named = [meanings.index(name) + 1 for name in ("red", "green", "blue") if name in meanings]
        self._bands = named if len(named) == 3 else [1, 2, 3] if self._file.count >= 3 else [1]
        self.size = self._file.width, self._file.height
        if "uint16" in kinds:
            _warn_of_range(self)
        self._has_overviews = bool(self._file.overviews(self._bands[0]))

    @cached_property
    def _first(self) -> int:
        return FIRST if self._has_overviews else super()._first

    def pixels(self, box: PixelBox) -> NDArray[np.uint8]:
        """Read a window."""
        return self._window(box, 1)

    def read(self, box: PixelBox, reduction: int = 1) -> Tensor:
        """Read a window; coarse ones from the overviews of the file, else as in other large pictures."""
        if reduction < FIRST or not self._has_overviews:
            return super().read(box, reduction)
        x1, y1, x2, y2 = self._inside(box)
        right, bottom = (min(-(-n // reduction) * reduction, m) for n, m in zip((x2, y2), self.size, strict=True))
        outwards = x1 // reduction * reduction, y1 // reduction * reduction, right, bottom
        return bytes_of(self._window(outwards, reduction))

    def _window(self, box: PixelBox, reduction: int) -> NDArray[np.uint8]:
        from rasterio.enums import Resampling
        from rasterio.windows import Window

        x1, y1, x2, y2 = box
        shape = len(self._bands), -(-(y2 - y1) // reduction), -(-(x2 - x1) // reduction)
        with _opening(self.path, "decoded"), self._settings:
            bands = self._file.read(
                self._bands, window=Window(x1, y1, x2 - x1, y2 - y1), out_shape=shape, resampling=Resampling.average
            )
        pixels = np.moveaxis(_from_16(bands), 0, -1)
        return np.repeat(pixels, 3, -1) if len(self._bands) == 1 else pixels


def open_large(source: LargePicture | ImageLike, *, color: Color = "rgb") -> LargePicture:
    """Open a picture of any common type (`semfov.as_image`) for reading window by window.

    Files `.tif` and `.tiff` are read tile by tile if `tifffile` is installed, and by rasterio if that is installed and
    they have overviews or are of a kind that `tifffile` leaves; else as other photographs. Rasters `.vrt` and `.jp2`
    need rasterio. Arrays of bytes `(H, W, 3)` and `(H, W)` are not copied, so only the windows of a
    `numpy.memmap` are read.
    """
    if isinstance(source, LargePicture):
        return source
    if isinstance(source, np.ndarray) and source.dtype == np.uint8 and source.size and _by_rows(source.shape):
        swap = lookup(color, get_args(Color), "order of channels") == "bgr" and source.ndim == 3
        return _ArrayPicture(source[..., ::-1] if swap else source)
    if not isinstance(source, str | PathLike):
        return _MemoryPicture(source, color=color)
    check_local(source, "picture")
    kind = Path(source).suffix.lower()
    if kind in RASTERS:
        return _raster(source)
    return _tiff(source) if kind in _TILED else _PhotographPicture(source)


def _raster(path: str | PathLike[str]) -> LargePicture:
    """A raster read by windows; JPEG 2000 by Pillow where rasterio is not there."""
    try:
        return _RasterPicture(path)
    except DataError:
        if Path(path).suffix.lower() == ".jp2":
            with suppress(DataError):
                return _PhotographPicture(path)
        raise


def _tiff(path: str | PathLike[str]) -> LargePicture:
    """A TIFF read by windows; by rasterio if it has overviews, or of a kind that `tifffile` leaves; else by Pillow."""
    if _is_converted(path):
        return _PhotographPicture(path)
    try:
        tiff = _TiffPicture(path)
        if not tiff.has_overviews:
            return tiff
    except DataError as error:
        with suppress(DataError):
            return _RasterPicture(path)
        with suppress(DataError):
            photograph = _PhotographPicture(path)
            photograph.read((0, 0, 1, 1))
            return photograph
        raise error from None
    try:
        return _RasterPicture(path)
    except DataError:
        return tiff


def _warn_of_range(picture: LargePicture) -> None:
    """Warn if nine windows over a picture of 16 bits have few of their values."""
    (width, height), values = picture.size, []
    with suppress(DataError):  # what cannot be decoded is refused where it is read
        for place in range(9):
            x, y = (length * (1 + 2 * n) // 6 for length, n in zip((width, height), divmod(place, 3), strict=True))
            values.append(picture.pixels((x, y, min(x + _SEEN, width), min(y + _SEEN, height))))
        least, most = min(each.min() for each in values), max(each.max() for each in values)
        assert picture.path is not None
        warn_of_range(257.0 * least, 257.0 * most, picture.path)


def _is_converted(path: str | PathLike[str]) -> bool:
    """Whether a TIFF is turned, or of other colours than grey and RGB, or grey with alpha: Pillow converts these."""
    try:
        with open_pillow(path) as image:
            tags = getattr(image, "tag_v2", {})
    except Exception:  # files that Pillow does not read are left to other readers
        return False
    kind, packed = tags.get(_PHOTOMETRIC, 1), tags.get(_COMPRESSION, 1)
    unusual = kind > _PALETTE and (kind, packed) != (_YCBCR, _JPEG)
    return unusual or tags.get(_ORIENTATION, 1) != 1 or tags.get(_SAMPLES, 1) == 2


def picture_size(source: LargePicture | ImageLike) -> tuple[int, int]:
    """Size of a picture of any common type, without decoding a file; → `(width, height)`."""
    from PIL import Image as Pillow

    if isinstance(source, LargePicture):
        return source.size
    if isinstance(source, str | PathLike):
        path = Path(source)
        if path.suffix.lower() in (*_TILED, *RASTERS):
            with suppress(DataError):
                return open_large(path).size
        with _opening(path, "opened"), open_pillow(path) as image:
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


def _by_rows(shape: tuple[int, ...]) -> bool:
    """Whether a shape is `(H, W)` or `(H, W, 3)`, and cannot be `(3, H, W)`."""
    return len(shape) == 2 or (len(shape) == 3 and shape[2] == 3 and shape[0] != 3)


@contextmanager
def _opening(path: Path, what: str) -> Iterator[None]:
    """Raise `DataError` for a file that cannot be read as a picture, for any error of a decoder."""
    check_regular(path, f"image {path}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about damaged metadata and large files
        try:
            yield
        except FileNotFoundError:
            raise DataError(f"image {path}: no such file; check its path") from None
        except SemfovError:
            raise
        except Exception as error:  # decoders of damaged files raise errors of many kinds
            if type(error).__name__ == "DecompressionBombError":
                most = f"expected at most {2 * MAX_PIXELS:,} pixels of a file that is decoded as a whole"
                raise DataError(f"image {path}: {most}, got more; convert it to a tiled TIFF") from None
            reason = " ".join(str(error).split()) or type(error).__name__
            raise DataError(f"image {path}: cannot be {what} ({reason}); replace it") from None
