"""TIFFs that are read by windows, tile by tile (or strip by strip), through tifffile."""

import lzma
import math
import re
import weakref
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from os import PathLike
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semfov.data.gdal import MOST_SIDE
from semfov.data.images import check_tile, open_pillow, opening, quiet_decoders
from semfov.data.reduction import PixelBox
from semfov.data.tone import White, bytes_between
from semfov.data.windowed import LargePicture, chosen_bands, tone_of
from semfov.errors import DataError
from semfov.io.files import check_regular

_WHITE_IS_ZERO, _RGB, _PALETTE, _YCBCR = 0, 2, 3, 6  # photometric interpretations
_PREMULTIPLIED, _UNASSOCIATED = 1, 2  # kinds of a further channel
_JPEG = 7
_COMPRESSION, _PHOTOMETRIC, _ORIENTATION, _SAMPLES, _METADATA, _NODATA = 259, 262, 274, 277, 42112, 42113  # tags
_NAMED = re.compile(r'<Item name="COLORINTERP" sample="(\d{1,5})" role="colorinterp">(\w{1,20})</Item>')
_ALWAYS = (1, 8, 32946)  # compressions whose decoders are always there
_PLANES = 2  # planar configuration of channels that are stored one after the other
_INFLATED = 2**18  # bytes of a tile that is inflated for a look first: fewer inflate to 270 MB at most
_INFLATERS: dict[int, Callable[[], Any]] = {
    8: zlib.decompressobj,
    32946: zlib.decompressobj,
    34925: lzma.LZMADecompressor,
}
"""Decoders of compressions whose data may inflate a thousandfold, by their numbers in a TIFF."""


class TiffPicture(LargePicture):
    """A TIFF, read by windows through `tifffile`; one of neither 8 nor 16 bits needs `white`."""

    path: Path

    def __init__(
        self, path: str | PathLike[str], *, white: White | None = None, bands: int | Sequence[int] | None = None
    ) -> None:
        try:
            import tifffile
        except ImportError:
            raise DataError(f"{path}: expected tifffile for reading TIFFs; pip install tifffile") from None
        self.path, self._lock = Path(path), Lock()
        with opening(self.path, "opened"):
            self._file = tifffile.TiffFile(path)
            weakref.finalize(self, self._file.close)
            pages: Any = self._file.pages
            # The first page may be a thumbnail of another one.
            first = (number for number in range(min(len(pages), 64)) if not pages[number].is_reduced)
            self._page: Any = pages[next(first, 0) if pages[0].is_reduced else 0]
        page: Any = self._page
        count = int(page.samplesperpixel)
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
        if usual is None and colours == 3 and page.photometric == _RGB:
            usual = 1, 2, 3
        self._channels = [band - 1 for band in chosen_bands(count, bands, usual, self.path, alpha=bool(self._alpha))]
        if self._alpha:
            self._channels.append(colours + extra.index(self._alpha))
        nodata = page.tags.get(_NODATA)
        self._nodata: float | None = None
        with suppress(ValueError):  # some programs write words
            self._nodata = None if nodata is None else float(str(nodata.value).strip("\0 "))
        if page.compression not in _ALWAYS:
            with opening(self.path, "decoded"):
                self._values((0, 0, 1, 1))  # a decoder that is listed may not be there
        shown = len(self._channels) - bool(self._alpha)
        self._tone = tone_of(
            self, white, lambda box: self._values(box)[..., :shown], nodata=self._nodata, wide=page.dtype == np.uint16
        )
        self.nothing = self._colour_of_nothing()

    def _check_kind(self, *, known: bool) -> None:
        """Raise `DataError` for a TIFF that is left to other readers; `known` says which values are white."""
        import tifffile

        page, count = self._page, int(self._page.samplesperpixel)
        kind = "" if page.dtype is None else page.dtype.kind
        plain = page.dtype in (np.uint8, np.uint16)
        fits = kind in "uif" and len(page.shape) == 2 + (count > 1) and page.bitspersample == 8 * page.dtype.itemsize
        if not (fits and (plain or known)):
            more = "give white='auto', or the values that are black and white" if fits else "convert it"
            raise DataError(f"{self.path}: expected 8 or 16 bits, got {page.dtype} {page.shape}; {more}")
        if page.photometric == _PALETTE:
            raise DataError(f"{self.path}: expected grey, RGB or bands, got a palette; convert it")
        if page.compression not in tifffile.TIFF.DECOMPRESSORS or page.predictor not in tifffile.TIFF.UNPREDICTORS:
            packed = f"{page.compression.name} compression with predictor {int(page.predictor)}"
            raise DataError(f"{self.path}: expected imagecodecs for {packed}; pip install imagecodecs")
        if max(self.size) > MOST_SIDE:
            got = f"{self.size[0]} × {self.size[1]}"
            raise DataError(f"{self.path}: expected at most {MOST_SIDE:,} pixels along a side, got {got}")

    @property
    def has_overviews(self) -> bool:
        """Whether the file has reduced copies of its own, which `tifffile` does not tell apart from other pages."""
        with opening(self.path, "opened"):
            pages: Any = self._file.pages[1:]
            return bool(self._page.subifds) or any(page.is_reduced for page in pages)

    def pixels(self, box: PixelBox) -> NDArray[np.uint8]:
        with opening(self.path, "decoded"):
            return self._bytes(self._values(box))

    def _values(self, box: PixelBox) -> NDArray[Any]:
        """The values of the channels in a window, the alpha last, `(h, w, C)`."""
        x1, y1, x2, y2 = box
        page, channels = self._page, self._channels
        wide, high = (page.tilewidth, page.tilelength) if page.is_tiled else (self.size[0], page.rowsperstrip)
        across, down = -(-self.size[0] // wide), -(-self.size[1] // high)
        planes = page.planarconfig == _PLANES and page.samplesperpixel > 1
        size = wide * high * (1 if planes else page.samplesperpixel) * page.dtype.itemsize
        window = np.zeros((y2 - y1, x2 - x1, len(channels)), page.dtype)
        for place, channel in enumerate(channels) if planes else [(slice(None), 0)]:
            for row in range(y1 // high, -(-y2 // high)):
                for column in range(x1 // wide, -(-x2 // wide)):
                    number = (channel * down if planes else 0) * across + row * across + column
                    tile = self._tile(number, size)
                    if tile is None:
                        continue
                    top, left = row * high, column * wide
                    tile = tile[: self.size[1] - top, : self.size[0] - left]
                    rows = slice(max(y1 - top, 0), min(y2 - top, tile.shape[0]))
                    columns = slice(max(x1 - left, 0), min(x2 - left, tile.shape[1]))
                    at = slice(top + rows.start - y1, top + rows.stop - y1)
                    along = slice(left + columns.start - x1, left + columns.stop - x1)
                    part = tile[rows, columns]
                    window[at, along, place] = part[..., 0] if planes else _taken(part, channels)
        return window

    def _tile(self, number: int, size: int) -> NDArray[Any] | None:
        """A tile; None for one that is not stored in the file."""
        page = self._page
        offset, count = page.dataoffsets[number], page.databytecounts[number]
        if not count:
            return None
        check_tile(size, count, f"image {self.path}")
        with self._lock:
            self._file.filehandle.seek(offset)
            data = self._file.filehandle.read(count)
        make = _INFLATERS.get(int(page.compression))
        most = 2 * size + 2**16
        if make is not None and len(data) > _INFLATED and len(make().decompress(data, most)) >= most:
            raise DataError(
                f"image {self.path}: expected tiles of {size:,} bytes, got one that inflates to more; replace it"
            )
        tile: NDArray[Any] = page.decode(data, number, jpegtables=page.jpegtables)[0][0]
        return tile

    def _bytes(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """Grey or RGB bytes, in which 0 is black."""
        count = len(self._channels) - bool(self._alpha)
        tile = bytes_between(values[..., :count], self._tone)
        if self._page.photometric == _WHITE_IS_ZERO:
            tile = 255 - tile
        if self._alpha:
            most = np.iinfo(values.dtype).max if values.dtype.kind in "ui" else 1.0
            share = bytes_between(values[..., count:], (0.0, float(most))).astype(np.uint16)
            colour = tile if self._alpha == _PREMULTIPLIED else (tile * share + 127) // 255
            tile = np.minimum(colour + (255 - share), 255).astype(np.uint8)
        return np.repeat(tile, 3, -1) if count == 1 else tile

    def _colour_of_nothing(self) -> tuple[int, int, int] | None:
        """The colour in which pixels without data are shown; None where the file does not tell them."""
        if self._alpha:
            return 255, 255, 255
        kind = self._page.dtype.kind
        limits = np.iinfo(self._page.dtype) if kind in "ui" else None
        value = self._nodata
        if value is None or (limits and not (limits.min <= value <= limits.max and math.isfinite(value))):
            return None
        red, green, blue = self._bytes(np.full((1, 1, len(self._channels)), value, self._page.dtype))[0, 0].tolist()
        return red, green, blue


def _taken(tile: NDArray[Any], channels: list[int]) -> NDArray[Any]:
    """The channels of a tile, without a copy where they are all."""
    return tile if channels == [*range(tile.shape[-1])] else tile[..., channels]


def is_converted(path: str | PathLike[str]) -> bool:
    """Whether a TIFF is turned, or of other colours than grey and RGB: Pillow converts these, or nobody reads them."""
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
    kind, packed = tags.get(_PHOTOMETRIC, 1), tags.get(_COMPRESSION, 1)
    turned, bands = tags.get(_ORIENTATION, 1), tags.get(_SAMPLES, 1)
    if turned != 1 and kind <= 1 and bands > 2:  # Pillow reads none of them, or the first as grey
        expected = "orientation 1 of bands without colours"
        raise DataError(f"image {Path(path)}: expected {expected}, got {turned} of {bands} bands; turn it upright")
    unusual = kind > _PALETTE and (kind, packed) != (_YCBCR, _JPEG)
    return bool(unusual or turned != 1)
