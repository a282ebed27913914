"""TIFFs and rasters, which are read window by window by `tifffile` and GDAL, or by Pillow where they leave them."""

import lzma
import re
import warnings
import weakref
import zlib
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from functools import cached_property
from os import PathLike
from pathlib import Path
from threading import Lock
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.gdal import check_size, raster_settings
from semfov.data.images import (
    PhotographPicture,
    check_tile,
    open_pillow,
    opening,
    quiet_decoders,
    warn_of_range,
)
from semfov.data.tone import White, black_and_white, bytes_between
from semfov.data.vrt import Mosaic, open_raster
from semfov.data.windowed import RASTERS, ChosenBands, LargePicture
from semfov.errors import DataError, check, check_data, needing
from semfov.io.files import check_regular

_Box = tuple[int, int, int, int]
_WHITE_IS_ZERO, _RGB, _PALETTE, _YCBCR = 0, 2, 3, 6  # photometric interpretations
_PREMULTIPLIED, _UNASSOCIATED = 1, 2  # kinds of a further channel
_JPEG = 7
_COMPRESSION, _PHOTOMETRIC, _ORIENTATION, _SAMPLES, _EXTRA, _METADATA, _NODATA = 259, 262, 274, 277, 338, 42112, 42113
_NAMED = re.compile(r'<Item name="COLORINTERP" sample="(\d{1,5})" role="colorinterp">(\w{1,20})</Item>')
_ALWAYS = (1, 8, 32946)  # compressions whose decoders are always there
_REDUCED, _MASK = 1, 4  # bits of the kind of a page
_MOST_LAYERS = 64  # pages that are channels of one picture
_ROWS = 64  # of a picture that is stored in one strip, which are read at once
_PLANES = 2  # planar configuration of channels that are stored one after the other
_INFLATED = 2**18  # bytes of a tile that is inflated for a look first: fewer inflate to 270 MB at most
_INFLATERS: dict[int, Callable[[], Any]] = {
    8: zlib.decompressobj,
    32946: zlib.decompressobj,
    34925: lzma.LZMADecompressor,
}
"""Decoders of compressions whose data may inflate a thousandfold, by their numbers in a TIFF."""


class _TiffPicture(LargePicture):
    """A TIFF, read by windows through `tifffile`; one of neither 8 nor 16 bits needs `white`."""

    path: Path

    def __init__(
        self, path: str | PathLike[str], *, white: White | None = None, bands: int | Sequence[int] | None = None
    ) -> None:
        with needing("tifffile", path, error=DataError):
            import tifffile
        self.path, self._lock = Path(path), Lock()
        with opening(self.path, "opened"):
            self.file = tifffile.TiffFile(path)
            weakref.finalize(self, self.file.close)
            pages: Any = self.file.pages
            # The first page may be a thumbnail of another one.
            first = (number for number in range(min(len(pages), 64)) if not pages[number].is_reduced)
            self.page: Any = pages[next(first, 0) if pages[0].is_reduced else 0]
            page: Any = self.page
            self._layers = _layers_of(self.file, page)
            count = len(self._layers) if len(self._layers) > 1 else int(page.samplesperpixel)
            self.size = int(page.imagewidth), int(page.imagelength)
            self._check_kind(known=white is not None)
        extra = [int(each) for each in page.extrasamples]
        self._alpha = next((kind for kind in extra if kind in (_PREMULTIPLIED, _UNASSOCIATED)), 0)
        colours = count - len(extra)
        metadata = page.tags.get(_METADATA)
        named = {name: int(band) + 1 for band, name in _NAMED.findall("" if metadata is None else str(metadata.value))}
        if self._alpha and named.get("Alpha", 0) == 0 and colours + extra.index(self._alpha) + 1 in named.values():
            self._alpha = 0  # GDAL names that band otherwise
        colour = tuple(named[name] for name in ("Red", "Green", "Blue") if name in named)
        usual = colour if len(colour) == 3 else None
        if usual is None and colours == 3 and (page.photometric == _RGB or len(self._layers) > 1):
            usual = 1, 2, 3
        self._channels = [band - 1 for band in _chosen_bands(count, bands, usual, self.path, alpha=bool(self._alpha))]
        if self._alpha:
            self._channels.append(colours + extra.index(self._alpha))
        self._nodata = self._value_of_nothing()
        if page.compression not in _ALWAYS:
            with opening(self.path, "decoded"):
                self._values((0, 0, 1, 1))  # a decoder that is listed may not be there
        shown = len(self._channels) - bool(self._alpha)
        self._tone = _tone_of(
            self, white, lambda box: self._values(box)[..., :shown], nodata=self._nodata, wide=page.dtype == np.uint16
        )
        self.nothing = self._colour_of_nothing()

    def _check_kind(self, *, known: bool) -> None:
        """Raise `DataError` for a TIFF that is left to other readers; `known` says which values are white."""
        import tifffile

        page, count = self.page, int(self.page.samplesperpixel)
        kind = "" if page.dtype is None else page.dtype.kind
        plain = page.dtype in (np.uint8, np.uint16)
        fits = kind in "uif" and len(page.shape) == 2 + (count > 1) and page.bitspersample == 8 * page.dtype.itemsize
        more = "give white='auto', or the values that are black and white" if fits else "convert it"
        check_data(fits and (plain or known), self.path, "8 or 16 bits", f"{page.dtype} {page.shape}; {more}")
        check_data(page.photometric != _PALETTE, self.path, "grey, RGB or bands", "a palette; convert it")
        if page.compression not in tifffile.TIFF.DECOMPRESSORS or page.predictor not in tifffile.TIFF.UNPREDICTORS:
            packed = f"{page.compression.name} compression with predictor {int(page.predictor)}"
            raise DataError(f"{self.path}: expected imagecodecs for {packed}; pip install imagecodecs")
        check_size(self.size, self.path.stat().st_size, self.path)

    def pixels(self, box: _Box) -> NDArray[np.uint8]:
        with opening(self.path, "decoded"):
            return self._bytes(self._values(box))

    @cached_property
    def _rows_are_plain(self) -> bool:
        """Whether the whole picture is one strip that is not packed, of which rows can be read."""
        page = self.page
        whole = not page.is_tiled and page.rowsperstrip >= self.size[1] and all(page.databytecounts)
        return bool(whole and page.compression == 1 and page.predictor == 1 and page.fillorder == 1)

    @cached_property
    def _kept(self) -> dict[tuple[int, int], NDArray[Any]]:
        """Strips that are the whole picture, decoded."""
        return {}

    @cached_property
    def _tile_size(self) -> tuple[int, int]:
        """Width and height of a tile, of a strip, or of what is read at once of a strip that is the whole picture."""
        page = self.page
        if page.is_tiled:
            return page.tilewidth, page.tilelength
        return self.size[0], min(_ROWS, self.size[1]) if self._rows_are_plain else page.rowsperstrip

    @cached_property
    def _held(self) -> NDArray[np.bool_]:
        """Which tiles are stored in the file, `(rows, columns)`."""
        across, down = (-(-length // side) for length, side in zip(self.size, self._tile_size, strict=True))
        if self._rows_are_plain or len(self._layers) > 1:
            return np.ones((down, across), np.bool_)
        counts = np.asarray(self.page.databytecounts, np.int64)
        planes = max(len(counts) // (across * down), 1)
        return np.logical_or.reduce(counts[: planes * across * down].reshape(planes, down, across) > 0)

    def holds(self, box: _Box) -> bool:
        x1, y1, x2, y2 = box
        wide, high = self._tile_size
        return bool(self._held[y1 // high : -(-y2 // high), x1 // wide : -(-x2 // wide)].any())

    def _values(self, box: _Box) -> NDArray[Any]:
        """The values of the channels in a window, the alpha last, `(h, w, C)`."""
        x1, y1, x2, y2 = box
        page, channels = self.page, self._channels
        wide, high = self._tile_size
        across, down = -(-self.size[0] // wide), -(-self.size[1] // high)
        layered = len(self._layers) > 1
        planes = layered or (page.planarconfig == _PLANES and page.samplesperpixel > 1)
        size = wide * high * (1 if planes else page.samplesperpixel) * page.dtype.itemsize
        # What is not stored is without data, or 0, as GDAL reads it.
        window = np.full((y2 - y1, x2 - x1, len(channels)), self._nodata or 0, page.dtype)
        for place, channel in enumerate(channels) if planes else [(slice(None), 0)]:
            for row in range(y1 // high, -(-y2 // high)):
                for column in range(x1 // wide, -(-x2 // wide)):
                    plane = channel * down if planes and not layered else 0
                    number = (plane + row) * across + column
                    tile = self._tile(self._layers[channel if layered else 0], number, size)
                    if tile is None:
                        continue
                    top, left = row * high, column * wide
                    tile = tile[: self.size[1] - top, : self.size[0] - left]
                    rows = slice(max(y1 - top, 0), min(y2 - top, tile.shape[0]))
                    columns = slice(max(x1 - left, 0), min(x2 - left, tile.shape[1]))
                    at = slice(top + rows.start - y1, top + rows.stop - y1)
                    along = slice(left + columns.start - x1, left + columns.stop - x1)
                    part = tile[rows, columns]
                    if planes:
                        part = part[..., 0]
                    elif channels != [*range(part.shape[-1])]:
                        part = part[..., channels]
                    window[at, along, place] = part
        return window

    def _tile(self, layer: Any, number: int, size: int) -> NDArray[Any] | None:
        """A tile of a page; None for one that is not stored in the file."""
        page = self.page
        if self._rows_are_plain:
            return self._rows(layer, number)
        if (layer.index, number) in self._kept:
            return self._kept[layer.index, number]
        offset, count = layer.dataoffsets[number], layer.databytecounts[number]
        if not count:
            return None
        check_tile(size, count, f"image {self.path}")
        data = self._stored(offset, count)
        make, most = _INFLATERS.get(int(page.compression)), 2 * size + 2**16
        fits = make is None or len(data) <= _INFLATED or len(make().decompress(data, most)) < most
        check_data(fits, f"image {self.path}", f"tiles of {size:,} bytes", "one that inflates to more; replace it")
        tile: NDArray[Any] = page.decode(data, number, jpegtables=page.jpegtables)[0][0]
        if not page.is_tiled and page.rowsperstrip >= self.size[1]:
            self._kept[layer.index, number] = tile  # the whole picture, which each window would decode again
        return tile

    def _stored(self, offset: int, count: int) -> bytes:
        with self._lock:
            self.file.filehandle.seek(offset)
            return bytes(self.file.filehandle.read(count))

    def _rows(self, layer: Any, number: int) -> NDArray[Any]:
        """Rows of a picture that is stored in one strip as it is, `(h, w, samples)`; `number` counts such parts."""
        page, (wide, high) = self.page, self._tile_size
        down = -(-self.size[1] // high)
        plane, part = divmod(number, down)
        rows = min(high, self.size[1] - part * high)
        samples = 1 if page.planarconfig == _PLANES else page.samplesperpixel
        kind = page.dtype.newbyteorder(self.file.byteorder)
        line = wide * samples * kind.itemsize
        data = self._stored(layer.dataoffsets[plane] + part * high * line, rows * line)
        return np.frombuffer(data, kind).reshape(rows, wide, samples)

    def _bytes(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        count = len(self._channels) - bool(self._alpha)
        tile = bytes_between(values[..., :count], self._tone)
        if self.page.photometric == _WHITE_IS_ZERO:
            tile = 255 - tile
        if self._alpha:
            most = np.iinfo(values.dtype).max if values.dtype.kind in "ui" else 1.0
            share = bytes_between(values[..., count:], (0.0, float(most))).astype(np.uint16)
            colour = tile if self._alpha == _PREMULTIPLIED else (tile * share + 127) // 255
            tile = np.minimum(colour + (255 - share), 255).astype(np.uint8)
        return np.repeat(tile, 3, -1) if count == 1 else tile

    def _value_of_nothing(self) -> float | None:
        """The value of pixels without data; None where the file names none that its type has."""
        tag, kind = self.page.tags.get(_NODATA), self.page.dtype
        try:
            value = float(str("" if tag is None else tag.value).strip("\0 "))
        except ValueError:  # some programs write words
            return None
        limits = np.iinfo(kind) if kind.kind in "ui" else None
        return value if limits is None or limits.min <= value <= limits.max else None

    def _colour_of_nothing(self) -> tuple[int, int, int] | None:
        """The colour in which pixels without data are shown; None where the file does not tell them."""
        if self._alpha:
            return 255, 255, 255
        if self._nodata is None:
            return None
        values = np.full((1, 1, len(self._channels)), self._nodata, self.page.dtype)
        red, green, blue = self._bytes(values)[0, 0].tolist()
        return red, green, blue


def _layers_of(file: Any, page: Any) -> list[Any]:
    """The pages of a TIFF that are the channels of one picture (OME, ImageJ's composites), else the page alone."""
    for series in file.series[:1]:
        pages = list(series.pages)
        channels = series.axes == "CYX" and 2 <= len(pages) <= _MOST_LAYERS and page.samplesperpixel == 1
        if channels and all(each is not None and each.shape == page.shape for each in pages):
            return pages
    return [page]


def _is_other(page: Any) -> bool:
    """Whether a page is a reduced copy or a mask of another one."""
    return bool(getattr(page, "subfiletype", 0) & (_REDUCED | _MASK))  # pages that are like the first have none


def _tags_of(path: str | PathLike[str]) -> Any:
    """The tags of the first page of a TIFF, by their numbers; none where it has none that can be read."""
    tags: Any = {}
    check_regular(path, f"image {Path(path)}")
    with quiet_decoders:
        try:
            with open_pillow(path) as image:
                tags = getattr(image, "tag_v2", {})
        except Exception:  # files that Pillow does not read are left to other readers
            with suppress(Exception):
                import tifffile

                with tifffile.TiffFile(path) as file:
                    first: Any = file.pages[0]
                    tags = {tag.code: tag.value for tag in first.tags.values()}
    return tags


def _is_converted(path: str | PathLike[str]) -> bool:
    """Whether a TIFF is turned, or of other colours than grey and RGB: Pillow converts these, or nobody reads them."""
    tags = _tags_of(path)
    kind, packed = tags.get(_PHOTOMETRIC, 1), tags.get(_COMPRESSION, 1)
    turned, bands = tags.get(_ORIENTATION, 1), tags.get(_SAMPLES, 1)
    fits = turned == 1 or kind > 1 or bands <= 2  # of others Pillow reads none, or the first as grey
    got = f"{turned} of {bands} bands; turn it upright"
    check_data(fits, f"image {Path(path)}", "orientation 1 of bands without colours", got)
    unusual = kind > _PALETTE and (kind, packed) != (_YCBCR, _JPEG)
    return bool(unusual or turned != 1)


class _RasterPicture(LargePicture):
    """A raster, whose coarse windows are read from the overviews of the file, if it has some."""

    path: Path

    def __init__(
        self, path: str | PathLike[str], *, white: White | None = None, bands: int | Sequence[int] | None = None
    ) -> None:
        with needing("rasterio", path, '"semfov[geo]"', DataError):
            self._settings = raster_settings()
        self.path, self._lock = Path(path), Lock()  # GDAL's datasets are for one thread at a time
        with opening(self.path, "opened"), self._settings:
            self._file: Any = open_raster(self.path)
        weakref.finalize(self, self._file.close)
        meanings = [each.name for each in self._file.colorinterp]
        kinds = {*self._file.dtypes}
        plain = "palette" not in meanings
        check_data(plain, path, "grey, RGB or bands", "a palette; convert it (gdal_translate)")
        scaled = white is not None and not any("complex" in kind for kind in kinds)
        got = f"{', '.join(sorted(kinds))}; give white='auto', or the values that are black and white"
        check_data(scaled or kinds <= {"uint8", "uint16"}, path, "bands of 8 or 16 bits", got)
        named = tuple(meanings.index(name) + 1 for name in ("red", "green", "blue") if name in meanings)
        usual = named if len(named) == 3 else None
        self._bands = _chosen_bands(self._file.count, bands, usual, self.path, alpha="alpha" in meanings)
        self.size = self._file.width, self._file.height
        self._has_overviews = bool(self._file.overviews(self._bands[0]))
        flags = {each.name for each in self._file.mask_flag_enums[self._bands[0] - 1]}
        self._masked = "per_dataset" in flags
        # What GDAL leaves to those who show a picture: TIFFs with other numbers for white, and colours times alpha.
        tags = _tags_of(path) if self.path.suffix.lower() in (".tif", ".tiff") else {}
        self._inverted = tags.get(_PHOTOMETRIC) == _WHITE_IS_ZERO
        self._premultiplied = _PREMULTIPLIED in np.atleast_1d(tags.get(_EXTRA, ()))
        nodata = self._file.nodatavals[self._bands[0] - 1]
        wide = "uint16" in kinds
        self._tone = _tone_of(self, white, lambda box: self._values(box, 1), nodata=nodata, wide=wide)
        if self._masked:
            self.nothing = 255, 255, 255
        elif nodata is not None:
            grey = int(self._shown(np.full((1,), nodata, self._file.dtypes[self._bands[0] - 1]))[0])
            self.nothing = grey, grey, grey

    def _shown(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        pixels = bytes_between(values, self._tone)
        return 255 - pixels if self._inverted else pixels

    def holds(self, box: _Box) -> bool:
        if isinstance(self._file, Mosaic):
            return self._file.holds(box)
        if self._file.driver != "GTiff":
            return True
        high, wide = self._file.block_shapes[0]
        rows = range(box[1] // high, -(-box[3] // high))
        columns = range(box[0] // wide, -(-box[2] // wide))
        sizes = (f"BLOCK_SIZE_{column}_{row}" for row in rows for column in columns)
        with self._lock:
            return any(self._file.get_tag_item(size, "TIFF", bidx=self._bands[0]) for size in sizes)

    def _reduced(self, box: _Box, reduction: int) -> Tensor:
        """A window from the overviews of the file, or from a copy where it has none."""
        if not self._has_overviews:
            return super()._reduced(box, reduction)
        x1, y1, x2, y2 = box
        right, bottom = (min(-(-n // reduction) * reduction, m) for n, m in zip((x2, y2), self.size, strict=True))
        outwards = x1 // reduction * reduction, y1 // reduction * reduction, right, bottom
        return torch.from_numpy(self.pixels(outwards, reduction)).permute(2, 0, 1)

    def pixels(self, box: _Box, reduction: int = 1) -> NDArray[np.uint8]:
        pixels = self._shown(self._values(box, reduction))
        if self._masked:
            share = self._values(box, reduction, mask=True).astype(np.uint16)
            colour = pixels if self._premultiplied else (pixels * share + 127) // 255
            pixels = (colour + (255 - share)).clip(max=255).astype(np.uint8)
        return np.repeat(pixels, 3, -1) if len(self._bands) == 1 else pixels

    def _values(self, box: _Box, reduction: int, *, mask: bool = False) -> NDArray[Any]:
        """Values of the bands, or of their mask, `(h, w, C)`."""
        from rasterio.enums import Resampling
        from rasterio.windows import Window

        x1, y1, x2, y2 = box
        shape = -(-(y2 - y1) // reduction), -(-(x2 - x1) // reduction)
        window = {"window": Window(x1, y1, x2 - x1, y2 - y1), "resampling": Resampling.average}
        with self._lock, opening(self.path, "decoded"), self._settings:
            if mask:
                found = self._file.read_masks([self._bands[0]], out_shape=(1, *shape), **window)
            else:
                found = self._file.read(self._bands, out_shape=(len(self._bands), *shape), **window)
        return np.moveaxis(found, 0, -1)


def _raster(path: str | PathLike[str], white: White | None, bands: ChosenBands) -> LargePicture:
    """A raster read by windows; JPEG 2000 by Pillow where rasterio is not there."""
    try:
        return _RasterPicture(path, white=white, bands=bands)
    except DataError:
        if Path(path).suffix.lower() == ".jp2" and bands is None:
            with suppress(DataError):
                return PhotographPicture(path, white)
        raise


def _tiff(path: str | PathLike[str], white: White | None, bands: ChosenBands) -> LargePicture:
    """A TIFF read by windows; by rasterio if it has overviews, or of a kind that `tifffile` leaves; else by Pillow."""
    if _is_converted(path):
        expected = f"None for {path}, which is turned, or of other colours than grey and RGB"
        check(bands is None, "bands", expected, f"{bands}; convert it")
        return PhotographPicture(path, white)
    try:
        tiff = _TiffPicture(path, white=white, bands=bands)
        with opening(tiff.path, "opened"):
            # `tifffile` tells neither reduced copies nor masks apart from other pages.
            pages: Any = tiff.file.pages[1:]
            if not tiff.page.subifds and not any(map(_is_other, pages)):
                return tiff
    except DataError as error:
        with suppress(DataError):
            return _RasterPicture(path, white=white, bands=bands)
        if bands is None:
            with suppress(DataError):
                photograph = PhotographPicture(path, white)
                photograph.read((0, 0, 1, 1))
                return photograph
        raise error from None
    try:
        return _RasterPicture(path, white=white, bands=bands)
    except DataError:
        return tiff


_ACROSS, _SIDE = 5, 64  # windows in a row, and their sides in pixels, in which the values of a picture are looked at


def _chosen_bands(
    count: int, bands: ChosenBands, usual: tuple[int, ...] | None, path: Path, *, alpha: bool = False
) -> list[int]:
    """The bands that are shown, one or three, from 1; `usual` has those that a file with `count` bands names."""
    if bands is not None:
        numbers = [*bands] if isinstance(bands, tuple | list) else [cast(int, bands)]
        check(max(numbers) <= count, "bands", f"numbers from 1 to {count} for {path}", bands)
        return numbers
    if usual is not None:
        return [*usual]
    colours = count - alpha
    shown = [1, 2, 3] if colours >= 3 else [1]
    if colours not in (1, 3):
        words = "1 is shown as grey" if len(shown) == 1 else "1, 2 and 3 are shown as red, green and blue"
        warnings.warn(f"image {path}: of {count} bands without names {words}; choose by bands=", stacklevel=2)
    return shown


def _tone_of(
    picture: LargePicture,
    white: White | None,
    values: Callable[[_Box], NDArray[Any]],
    *,
    nodata: float | None,
    wide: bool,
) -> tuple[float, float] | None:
    """The values that are black and white in a file; None by its type, with a warning where few of 16 bits are used."""
    if white is None and not wide:
        return None
    assert picture.path is not None
    if white is not None and not isinstance(white, str):
        return black_and_white(white, np.zeros(0))
    seen, (width, height) = [], picture.size
    downs, acrosses = ([length * (1 + 2 * n) // (2 * _ACROSS) for n in range(_ACROSS)] for length in (height, width))
    boxes = [(x, y, min(x + _SIDE, width), min(y + _SIDE, height)) for y in downs for x in acrosses]
    # What cannot be decoded is refused where it is read.
    with nullcontext() if white else suppress(Exception):
        seen = [values(box).ravel() for box in boxes]
    if white is not None:
        return black_and_white(white, np.concatenate(seen), nodata)
    if seen:
        warn_of_range(float(min(each.min() for each in seen)), float(max(each.max() for each in seen)), picture.path)
    return None


def open_by_windows(
    path: str | PathLike[str], *, white: White | None = None, bands: ChosenBands = None
) -> LargePicture:
    """Open a file whose name is that of a TIFF or a raster (`BY_WINDOWS`)."""
    return (_raster if Path(path).suffix.lower() in RASTERS else _tiff)(path, white, bands)
