"""TIFFs that are read tile by tile through tifffile.

    page ──► a grid of tiles, (row, column); a strip is a tile as wide as the picture

Channels lie beside each other in each pixel of a tile, or one after the other: then each has a grid of its own, in the
same page (planes) or in a page of its own (layers).
"""

import lzma
import math
import re
import warnings
import weakref
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import IntEnum
from functools import cached_property
from itertools import product
from os import PathLike
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from semfov.data.description import Description, as_rgb, named_colours
from semfov.data.gdal import check_size
from semfov.data.images import check_decoding, check_tile, opening
from semfov.data.tiff_tags import (
    GDAL_METADATA,
    GDAL_NODATA,
    MASK,
    PALETTE,
    PLANES,
    PREMULTIPLIED,
    REDUCED,
    RGB,
    UNASSOCIATED,
    WHITE_IS_ZERO,
)
from semfov.data.tone import Values, White, bytes_between
from semfov.data.windowed import Box, ChosenBands, LargePicture
from semfov.errors import DataError, check_data, needing

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffTags

_NAMED = re.compile(r'<Item name="COLORINTERP" sample="(\d{1,5})" role="colorinterp">(\w{1,20})</Item>')
"""How GDAL writes the name of a band, counted from 0, into its tag."""

_BITS = {np.dtype(np.uint8): 8, np.dtype(np.uint16): 16}  # of values without a sign that need no `white`
_MOST_PAGES = 64  # that are looked through for the first that is no thumbnail
_MOST_LAYERS = 64  # pages that are channels of one picture
_MOST_OF_SERIES = 2**14  # pages whose series are looked for, which takes a second for some thousand
_ROWS = 64  # of a picture that is stored in one strip, which are read at once
_INFLATED = 2**18  # bytes of a tile that is inflated for a look first: fewer inflate to 270 MB at most


class _Inflater(Protocol):
    """A decoder that stops after a number of bytes."""

    def decompress(self, data: bytes, max_length: int, /) -> bytes: ...


_INFLATERS: dict[int, Callable[[], _Inflater]] = {
    8: zlib.decompressobj,
    32946: zlib.decompressobj,
    34925: lzma.LZMADecompressor,
}
"""Decoders of compressions whose data may inflate a thousandfold, by their numbers in a TIFF."""

_WITH_DECODER = (1, 8, 32946)  # compressions whose decoders are always there


class _Layer(Protocol):
    """What is read of any page of tifffile: its number, and where its tiles lie in the file."""

    index: int
    shape: tuple[int, ...]
    dataoffsets: Sequence[int]
    databytecounts: Sequence[int]


class _Page(_Layer, Protocol):
    """What is read of the page of a picture; sizes in pixels, kinds by the numbers of TIFF."""

    tags: "TiffTags"
    dtype: np.dtype[Any]
    is_reduced: bool
    imagewidth: int
    imagelength: int
    is_tiled: bool
    tilewidth: int
    tilelength: int
    rowsperstrip: int
    bitspersample: int
    samplesperpixel: int
    extrasamples: Sequence[int]
    photometric: int
    planarconfig: int
    compression: IntEnum
    predictor: int
    fillorder: int
    jpegtables: bytes | None
    subifds: Sequence[int] | None

    def decode(self, data: bytes, number: int, *, jpegtables: bytes | None) -> tuple[Values, object, object]: ...


class TiffPicture(LargePicture):
    """A TIFF that tifffile reads by windows; values of neither 8 nor 16 bits need `white`.

    Private attributes: `_channels` has the channels of a pixel that are read, from 0: one or three colours, and the
    alpha last, if there is one. `_nodata` is the value of pixels without data, and None where the file states none.

    Raises:
        DataError: the file is damaged, or of a kind that is left to other readers.
        InputError: it has no such band.
    """

    path: Path

    def __init__(self, path: str | PathLike[str], *, white: White | None = None, bands: ChosenBands = None) -> None:
        with needing("tifffile", path, error=DataError):
            import tifffile
        self.path = Path(path)
        with opening(self.path, "opened"):
            # A series of OME may name other files.
            self.file = tifffile.TiffFile(path, _multifile=False)
            weakref.finalize(self, self.file.close)
            self.page = _first_page(self.file)
            layers, pictures = _layers_of(self.file, self.page)
            self.size = _size_of(self.page)
            _check_kind(self.page, self.path, has_white=white is not None)
            check_size(self.size, self.path.stat().st_size, self.path)
            self._tiles = _Tiles(self.path, self.file, self.page, layers)
        if pictures > 1:
            remedy = "save the others as files of their own"
            warnings.warn(f"image {path}: the first of {pictures} pictures in it is shown; {remedy}", stacklevel=2)

        description = _describe(self.path, self.page, layers)
        shown = description.shown_bands(bands)
        self._colours = len(shown)
        if description.alpha is not None:
            shown.append(description.alpha)
        self._channels = [band - 1 for band in shown]
        self._nodata = _nodata_of(self.page)
        self._check_decoder()
        # The tone of some values is chosen by the values in the file, which are read here.
        self._display = description.display(white, self._colour_values, self._nodata)
        self.nothing = self._colour_of_nothing()

    def _check_decoder(self) -> None:
        """Decode one pixel; raises `DataError` where the decoder of the compression is listed but not installed."""
        if self.page.compression not in _WITH_DECODER:
            with opening(self.path, "decoded"):
                self._values((0, 0, 1, 1))

    def pixels(self, box: Box) -> NDArray[np.uint8]:
        with opening(self.path, "decoded"):
            return self._shown(self._values(box))

    def holds(self, box: Box) -> bool:
        return self._tiles.holds(box)

    def stands_alone(self) -> bool:
        """Tell whether the file has no reduced copies and no masks of the picture, of which tifffile knows nothing."""
        # The channels of GDAL are those of one page.
        has_copies = bool(self.page.subifds) and not self._tiles.has_layers
        if len(self.file.pages) > _MOST_PAGES:  # GDAL would list them all
            return True
        return not has_copies and not any(kind & (REDUCED | MASK) for kind in self._kinds())

    def has_mask(self) -> bool:
        """Tell whether the file has a mask of the picture, which is not read."""
        return any(kind & MASK for kind in self._kinds())

    def _kinds(self) -> list[int]:
        """List what the pages after the first are; one that has the tags of the first has none of its own."""
        with opening(self.path, "opened"):
            return [getattr(page, "subfiletype", 0) for page in self.file.pages[1:_MOST_PAGES]]

    def _values(self, box: Box) -> Values:
        """Read the values of the channels in a window, the alpha last, `(h, w, C)`."""
        x1, y1, x2, y2 = box
        # What is not stored is without data, or 0, as GDAL reads it.
        window = np.full((y2 - y1, x2 - x1, len(self._channels)), self._nodata or 0, self.page.dtype)
        if self._tiles.separate:
            self._read_planes(box, window)
        else:
            self._read_samples(box, window)
        return window

    def _read_planes(self, box: Box, window: Values) -> None:
        """Read the values of channels that are stored one after the other into a window."""
        for place, channel in enumerate(self._channels):
            for rows, columns, values in self._tiles.parts(box, channel):
                window[rows, columns, place] = values[..., 0]

    def _read_samples(self, box: Box, window: Values) -> None:
        """Read the values of channels that are stored together at each pixel into a window."""
        for rows, columns, values in self._tiles.parts(box):
            # Choosing channels copies the tile, which is needless where they are all of them.
            are_all = self._channels == [*range(values.shape[-1])]
            window[rows, columns] = values if are_all else values[..., self._channels]

    def _colour_values(self, box: Box) -> Values:
        """Read the values in a window without the alpha, `(h, w, 1 or 3)`."""
        return self._values(box)[..., : self._colours]

    def _shown(self, values: Values) -> NDArray[np.uint8]:
        """Convert values with the alpha last to bytes over white, `(h, w, 3)`."""
        pixels = self._display.colours(values[..., : self._colours])
        if self._has_alpha:
            opaque = np.iinfo(values.dtype).max if values.dtype.kind in "ui" else 1.0
            alpha = bytes_between(values[..., self._colours :], (0.0, float(opaque)))
            pixels = self._display.over_white(pixels, alpha)
        return as_rgb(pixels)

    @property
    def _has_alpha(self) -> bool:
        return len(self._channels) > self._colours

    def _colour_of_nothing(self) -> tuple[int, int, int] | None:
        """Find the colour in which pixels without data are shown; None where the file does not tell them."""
        if self._has_alpha:
            return 255, 255, 255
        if self._nodata is None:
            return None
        pixel = np.full((1, 1, len(self._channels)), self._nodata, self.page.dtype)
        red, green, blue = self._shown(pixel)[0, 0].tolist()
        return red, green, blue


class _Tiles:
    """The tiles, or strips, of a picture, each read and decoded when a window needs it.

    Args:
        path: of the file.
        file: of tifffile.
        page: that of the picture, whose kind and size all layers have.
        layers: the pages of the channels, or the page alone.

    Attributes:
        width, height: of a tile in pixels. Of a picture that is one strip of plain rows, some rows are a tile.
        columns, rows: of tiles in the grid of a channel.
        has_layers: whether each channel has a page of its own.
        separate: whether each channel has a grid of tiles of its own, in its page or in a plane of the only one.

    Private attributes: `_grids` has the page and the plane of each grid, and `_samples` the numbers of a pixel in one.
    `_decoded` keeps strips that are the whole picture, by page and number, as each window would decode them again.
    `_inflatable` has page and number of the large packed tiles that inflate to their size: each is asked once, as that
    takes as long as decoding it. `_lock` is held while the place in the file is moved.

    Invariant: tiles of a grid cover the picture without overlaps, `columns` by `rows` of them; those of the last column
    and the last row may reach beyond it. `_decoded` is empty for pictures of several tiles.
    """

    def __init__(self, path: Path, file: "TiffFile", page: _Page, layers: Sequence[_Layer]) -> None:
        self._path = path
        self._file = file
        self._page = page
        self._lock = Lock()
        self._decoded: dict[tuple[int, int], Values] = {}
        self._inflatable: set[tuple[int, int]] = set()
        width, height = self._size = _size_of(page)
        self._is_one_strip = not page.is_tiled and page.rowsperstrip >= height
        # What is not packed has its rows at known places in the file.
        is_plain = (page.compression, page.predictor, page.fillorder) == (1, 1, 1)
        self._has_plain_rows = self._is_one_strip and is_plain and all(page.databytecounts)
        self.width = page.tilewidth if page.is_tiled else width
        self.height = page.tilelength if page.is_tiled else page.rowsperstrip
        if self._has_plain_rows:
            self.height = min(_ROWS, height)
        self.columns = len(_tiles_along(0, width, self.width))
        self.rows = len(_tiles_along(0, height, self.height))
        planes = page.samplesperpixel if page.planarconfig == PLANES else 1
        self.has_layers = len(layers) > 1
        self.separate = self.has_layers or planes > 1
        self._samples = 1 if self.separate else page.samplesperpixel
        # Either has one of them alone: a page of several samples has no layers.
        self._grids = [*product(layers, range(planes))]

    @cached_property
    def _is_stored(self) -> NDArray[np.bool_]:
        """Which tiles the file has of any channel, `(rows, columns)`."""
        if self._has_plain_rows or self.has_layers:
            return np.ones((self.rows, self.columns), np.bool_)
        counts = np.asarray(self._page.databytecounts, np.int64)
        tiles = self.rows * self.columns
        planes = max(len(counts) // tiles, 1)
        return np.logical_or.reduce(counts[: planes * tiles].reshape(planes, self.rows, self.columns) > 0)

    def holds(self, box: Box) -> bool:
        """Tell whether a tile of a window is stored in the file."""
        x1, y1, x2, y2 = box
        rows = _tiles_along(y1, y2, self.height)
        columns = _tiles_along(x1, x2, self.width)
        return bool(self._is_stored[rows.start : rows.stop, columns.start : columns.stop].any())

    def parts(self, box: Box, channel: int = 0) -> Iterator[tuple[slice, slice, Values]]:
        """Read the parts of a window that are stored, tile by tile.

        Args:
            box: the window.
            channel: whose tiles are read where channels are separate, from 0.

        Yields:
            Rows and columns in the window, and their values `(h, w, samples)`.
        """
        x1, y1, x2, y2 = box
        tile_rows = _tiles_along(y1, y2, self.height)
        tile_columns = _tiles_along(x1, x2, self.width)
        for row, column in product(tile_rows, tile_columns):
            tile = self._tile(row, column, channel)
            if tile is None:
                continue
            left = column * self.width
            top = row * self.height
            # The last tiles reach beyond the picture.
            tile = tile[: self._size[1] - top, : self._size[0] - left]
            rows, rows_in_window = _overlap(top, tile.shape[0], y1, y2)
            columns, columns_in_window = _overlap(left, tile.shape[1], x1, x2)
            yield rows_in_window, columns_in_window, tile[rows, columns]

    def _tile(self, row: int, column: int, channel: int) -> Values | None:
        """Read a tile, `(h, w, samples)`; None for one that is not stored in the file."""
        layer, plane = self._grids[channel]
        if self._has_plain_rows:
            return self._plain_rows(layer, plane, row)
        # In a page, the tiles of a plane follow those of the planes before it.
        return self._decode(layer, (plane * self.rows + row) * self.columns + column)

    def _decode(self, layer: _Layer, number: int) -> Values | None:
        """Decode the tile of a number in a page, `(h, w, samples)`; None for one that is not stored in the file."""
        key = layer.index, number
        if key in self._decoded:
            return self._decoded[key]
        stored = layer.databytecounts[number]
        if not stored:
            return None
        bytes_a_pixel = self._samples * self._page.dtype.itemsize
        size = self.width * self.height * bytes_a_pixel
        check_tile(size, stored, f"image {self._path}")
        if self._is_one_strip:  # is there unpacked, decoded, and as the bytes that are shown
            check_decoding(self._size, 2 * bytes_a_pixel + 3, stored, f"image {self._path}")
        data = self.read_bytes(layer.dataoffsets[number], stored)
        self._check_inflation(key, data, size)
        tile: Values = self._page.decode(data, number, jpegtables=self._page.jpegtables)[0][0]
        if self._is_one_strip:
            self._decoded[key] = tile
        return tile

    def _check_inflation(self, key: tuple[int, int], data: bytes, size: int) -> None:
        """Raise `DataError` for a packed tile that inflates to far more than its `size` in bytes."""
        make_inflater = _INFLATERS.get(int(self._page.compression))
        if make_inflater is None or len(data) <= _INFLATED or key in self._inflatable:
            return
        most = 2 * size + 2**16
        inflated = make_inflater().decompress(data, most)
        got = "one that inflates to more; replace it"
        check_data(len(inflated) < most, f"image {self._path}", f"tiles of {size:,} bytes", got)
        self._inflatable.add(key)

    def _plain_rows(self, layer: _Layer, plane: int, part: int) -> Values:
        """Read rows of a picture that is one strip as it is, `(h, w, samples)`; `part` counts such parts of a plane."""
        top = part * self.height
        rows = min(self.height, self._size[1] - top)
        kind = self._page.dtype.newbyteorder(self._file.byteorder)
        line = self.width * self._samples * kind.itemsize
        data = self.read_bytes(layer.dataoffsets[plane] + top * line, rows * line)
        return np.frombuffer(data, kind).reshape(rows, self.width, self._samples)

    def read_bytes(self, offset: int, count: int) -> bytes:
        """Read bytes of the file."""
        with self._lock:
            self._file.filehandle.seek(offset)
            return bytes(self._file.filehandle.read(count))


def _tiles_along(start: int, stop: int, length: int) -> range:
    """Find the numbers of the tiles of a length that show pixels from `start` to before `stop`, along one side."""
    return range(start // length, -(-stop // length))


def _overlap(place: int, length: int, start: int, stop: int) -> tuple[slice, slice]:
    """Find what a window shows of a tile, along one side.

    Args:
        place: of the tile in the picture, in pixels.
        length: of the tile.
        start: of the window.
        stop: end of the window.

    Returns:
        The pixels of the tile, and those of the window.
    """
    first = max(start, place)
    end = min(stop, place + length)
    return slice(first - place, end - place), slice(first - start, end - start)


def _first_page(file: "TiffFile") -> _Page:
    """Find the first page that is no reduced copy, such as a thumbnail, of another one."""
    # A page is read when it is asked for, and a file may have very many.
    pages = cast(Sequence[_Page], file.pages)
    numbers = range(min(len(pages), _MOST_PAGES))
    return next((pages[number] for number in numbers if not pages[number].is_reduced), pages[0])


def _size_of(page: _Page) -> tuple[int, int]:
    """Read `(width, height)` of a page."""
    return int(page.imagewidth), int(page.imagelength)


def _layers_of(file: "TiffFile", page: _Page) -> tuple[Sequence[_Layer], int]:
    """List the pages that are the channels of one picture (OME, ImageJ's composites), else the page alone.

    Of a stack, such as planes of a microscope or moments, they are those of the first picture.

    Args:
        file: the file.
        page: its first page that is no reduced copy.

    Returns:
        The pages, and the number of pictures in the stack.
    """
    count = len(file.pages)
    # Those of Micro-Manager are spread over files beside this one, which are not opened.
    if count > _MOST_OF_SERIES or file.is_mmstack or file.is_ndtiff:
        return [page], count
    if not file.series or file.series[0].keyframe.index != page.index:
        return [page], 1
    series = file.series[0]
    pages = cast(Sequence[_Layer | None], series.pages)
    # A page has rows (Y) and columns (X), and perhaps samples (S); the axes before these number the pages.
    axes = series.axes.removesuffix("S").removesuffix("YX")
    lengths = series.shape[: len(axes)]
    if math.prod(lengths) != len(pages):
        return [page], 1
    channels = dict(zip(axes, lengths, strict=True)).get("C", 1)
    pictures = len(pages) // channels
    # A page of several samples has its channels in itself.
    if page.samplesperpixel > 1 or not 2 <= channels <= _MOST_LAYERS:
        return [page], pictures
    layers = _pages_alike(pages, _first_picture(axes, lengths), page.shape)
    return layers or [page], pictures


def _pages_alike(pages: Sequence[_Layer | None], numbers: Sequence[int], shape: tuple[int, ...]) -> list[_Layer]:
    """List the pages of some numbers; none where one of them is not in the file, or of another shape."""
    layers: list[_Layer] = []
    for number in numbers:
        layer = pages[number]
        if layer is None or layer.shape != shape:
            return []
        layers.append(layer)
    return layers


def _first_picture(axes: str, lengths: tuple[int, ...]) -> list[int]:
    """List the pages of the first picture of a stack: all along the axis of channels, the first along all others.

    >>> _first_picture("TC", (5, 3))
    [0, 1, 2]
    >>> _first_picture("CZ", (3, 5))
    [0, 5, 10]
    """
    numbers = np.arange(math.prod(lengths)).reshape(lengths)
    picture = tuple(slice(None) if axis == "C" else 0 for axis in axes)
    return numbers[picture].tolist()


def _check_kind(page: _Page, path: Path, *, has_white: bool) -> None:
    """Raise `DataError` for a page that is left to other readers; `has_white` if its black and white are stated."""
    import tifffile

    remedy = "give white='auto', or the values that are black and white" if _is_image(page) else "convert it"
    has_tone = has_white or page.dtype in _BITS
    check_data(_is_image(page) and has_tone, path, "8 or 16 bits", f"{page.dtype} {page.shape}; {remedy}")
    check_data(page.photometric != PALETTE, path, "grey, RGB or bands", "a palette; convert it")
    if page.compression not in tifffile.TIFF.DECOMPRESSORS or page.predictor not in tifffile.TIFF.UNPREDICTORS:
        packing = f"{page.compression.name} compression with predictor {int(page.predictor)}"
        raise DataError(f"{path}: expected imagecodecs for {packing}; pip install imagecodecs")


def _is_image(page: _Page) -> bool:
    """Tell whether a page has numbers in two dimensions that NumPy has a type for, which those of 12 bits lack."""
    if page.dtype is None or page.dtype.kind not in "uif":
        return False
    dimensions = 2 if page.samplesperpixel == 1 else 3
    return len(page.shape) == dimensions and page.bitspersample == 8 * page.dtype.itemsize


def _describe(path: Path, page: _Page, layers: Sequence[_Layer]) -> Description:
    """Describe the values of a page by its tags; bands are numbered from 1."""
    has_layers = len(layers) > 1
    count = len(layers) if has_layers else int(page.samplesperpixel)
    # The further channels, such as alphas, follow those that the kind of picture has.
    kinds = [int(kind) for kind in page.extrasamples]
    first_extra = count - len(kinds) + 1
    extra = dict(enumerate(kinds, first_extra))
    names = _named_bands(page)
    colours = named_colours(names)
    has_three_colours = first_extra == 4 and (page.photometric == RGB or has_layers)
    if colours is None and has_three_colours:
        colours = 1, 2, 3
    alpha = _alpha_of(extra, names)
    return Description(
        path=path,
        size=_size_of(page),
        count=count,
        colours=colours,
        alpha=alpha,
        premultiplied=alpha is not None and extra[alpha] == PREMULTIPLIED,
        white_is_zero=page.photometric == WHITE_IS_ZERO,
        bits=_BITS.get(page.dtype),
    )


def _alpha_of(extra: Mapping[int, int], names: Mapping[str, int]) -> int | None:
    """Find the band that is an alpha.

    Args:
        extra: what TIFF calls the further bands, by their numbers from 1.
        names: numbers of bands by the names that GDAL gives them.

    Returns:
        Its number; None without one, and where GDAL gives it another name.
    """
    alphas = [band for band, kind in extra.items() if kind in (PREMULTIPLIED, UNASSOCIATED)]
    if not alphas:
        return None
    band = alphas[0]
    has_other_name = band in names.values() and "alpha" not in names
    return None if has_other_name else band


def _named_bands(page: _Page) -> dict[str, int]:
    """Find the numbers of bands, from 1, by the names that GDAL has written into a tag, in lower case."""
    metadata = page.tags.get(GDAL_METADATA)
    if metadata is None:
        return {}
    return {name.lower(): int(sample) + 1 for sample, name in _NAMED.findall(str(metadata.value))}


def _nodata_of(page: _Page) -> float | None:
    """Read the value of pixels without data; None where the file states none that its type has."""
    tag = page.tags.get(GDAL_NODATA)
    if tag is None:
        return None
    try:
        value = float(str(tag.value).strip("\0 "))
    except ValueError:  # some programs write words
        return None
    if page.dtype.kind == "f":
        return value
    limits = np.iinfo(page.dtype)
    return value if limits.min <= value <= limits.max else None
