"""The text of a mosaic of files, GDAL's VRT: what it may say is listed here, and all else is refused."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree as XML

import numpy as np
from numpy.typing import NDArray

from semfov.data.gdal import Dataset, check_size, check_system, driver_of
from semfov.errors import DataError, check_data
from semfov.io.files import inside, read_bytes

if TYPE_CHECKING:
    from rasterio.crs import CRS

Rect = tuple[float, float, float, float]
"""`(x, y, width, height)` in pixels."""

_MOST_BYTES = 2**26  # of the text of a mosaic
_MOST_SOURCES = 2**15  # of all bands, each of which takes a fraction of a millisecond
_MOST_LAYERS = 16  # sources that lie one over another
_TYPES = {
    "Byte": "uint8",
    "Int8": "int8",
    "UInt16": "uint16",
    "Int16": "int16",
    "UInt32": "uint32",
    "Int32": "int32",
    "Float32": "float32",
    "Float64": "float64",
}
"""Dtypes by GDAL's names."""

_RESAMPLINGS = ("nearest", "bilinear", "cubic", "cubic_spline", "lanczos", "average", "mode")
_TRUE = ("1", "true", "yes")

# Parts of a mosaic's text that are read, those that are left out, and no others.
_DATASET = ("SRS", "GeoTransform", "VRTRasterBand", "MaskBand")
_BAND = ("ColorInterp", "NoDataValue", "HideNoDataValue", "ColorTable")
_SOURCES = ("SimpleSource", "ComplexSource", "AveragedSource")
_SOURCE = (
    *("SourceFilename", "SourceBand", "SourceProperties", "SrcRect", "DstRect"),
    *("NODATA", "UseMaskBand", "LUT", "ScaleOffset", "ScaleRatio", "ColorTableComponent"),
)
_LEFT_OUT = (
    *("Metadata", "GCPList", "OverviewList", "BlockXSize", "BlockYSize"),
    *("Description", "UnitType", "Offset", "Scale", "CategoryNames", "Histograms"),
)


@dataclass(frozen=True)
class Source:
    """A part of a file and its place in a band.

    Attributes:
        path: the file.
        band: of the file, from 1.
        of_mask: whether the band's mask is taken in its place.
        window: the part of the file that is shown.
        place: where it lies in the mosaic.
        resampling: name of rasterio's method.
        nodata: value of pixels that are not there; None for none.
        masked: whether pixels outside the file's mask are not there.
        component: of the file's table of colours, from 1; 0 for none.
        ratio: by which values are multiplied.
        offset: that is added then.
        table: values, and what stands for them.
        discrete: whether averages of its values would mix what is there with what is not, or the numbers of colours.
    """

    path: Path
    band: int
    of_mask: bool
    window: Rect
    place: Rect
    resampling: str
    nodata: float | None
    masked: bool
    component: int
    ratio: float
    offset: float
    table: tuple[tuple[float, float], ...]
    discrete: bool


@dataclass(frozen=True)
class Band:
    """A band of a mosaic.

    Attributes:
        kind: dtype of its values.
        meaning: such as `red` or `alpha`, in lower case; empty where the text has none.
        nodata: value of pixels that no source covers; None for 0.
        hides_nodata: whether that value is nobody's concern.
        sources: each of which covers those before it.
        places: of the sources, `(N, 4)`: x1, y1, x2, y2.
    """

    kind: str
    meaning: str
    nodata: float | None
    hides_nodata: bool
    sources: tuple[Source, ...]
    places: NDArray[np.float64]


@dataclass(frozen=True)
class MosaicText:
    """The parsed text of a mosaic.

    Attributes:
        size: `(width, height)` in pixels.
        bands: at least one.
        mask: of all bands; None without one.
        system: the reference system of rasterio; None without one.
        transform: GDAL's six numbers from pixels to the system; None without them.
        has_overviews: of each file of the sources, whether it has reduced copies.
    """

    size: tuple[int, int]
    bands: tuple[Band, ...]
    mask: Band | None
    system: "CRS | None"
    transform: tuple[float, ...] | None
    has_overviews: dict[Path, bool]


def read_mosaic(path: Path, open_source: Callable[[Path], Dataset]) -> MosaicText:
    """Read the text of a mosaic, and check its sources.

    Args:
        path: the file.
        open_source: opens a file of a source as a dataset of rasterio.

    Returns:
        What it says.

    Raises:
        DataError: the text is damaged, or says what is not read.
    """
    root = _root(path)
    parts = _known_parts(root, _DATASET, path)
    sources = sum(part.tag in _SOURCES for part in root.iter())
    check_data(sources <= _MOST_SOURCES, path, f"at most {_MOST_SOURCES:,} sources", f"{sources:,}; join files first")
    width = int(_pixels(root, "rasterXSize", path))
    height = int(_pixels(root, "rasterYSize", path))
    check_data(min(width, height) > 0, path, "a width and a height", f"{width} × {height}")
    reader = _Reader(path, (width, height), open_source)
    bands = tuple(reader.band(part) for part in parts if part.tag == "VRTRasterBand")
    mask = _mask_of(parts, reader, path)
    check_data(bool(bands), path, "at least one band", "none")
    # In proportion to all files of the mosaic, as its own text is short.
    held = path.stat().st_size + sum(file.stat().st_size for file in reader.has_overviews)
    check_size((width, height), held, path)
    system = _first(parts, "SRS")
    transform = _first(parts, "GeoTransform")
    return MosaicText(
        size=(width, height),
        bands=bands,
        mask=mask,
        system=None if system is None else _system(system, path),
        transform=None if transform is None else _numbers(transform.text, 6, path),
        has_overviews=reader.has_overviews,
    )


def _first(parts: Sequence[XML.Element], tag: str) -> XML.Element | None:
    """Find the first part with a tag."""
    return next((part for part in parts if part.tag == tag), None)


class _Reader:
    """A reader of the bands of a mosaic.

    Attributes:
        has_overviews: of each file of the sources read so far, whether it has reduced copies.

    Private attribute: `_files` has these files, which are checked, by the names in the text.

    Invariant: a file is in `_files` only after it was found to lie in the folder of the mosaic or below and to be a
    picture, and is then in `has_overviews`, too; no other file is opened.
    """

    def __init__(self, path: Path, size: tuple[int, int], open_source: Callable[[Path], Dataset]) -> None:
        self._path = path
        self._size = size
        self._open_source = open_source
        self.has_overviews: dict[Path, bool] = {}
        self._files: dict[str, Path] = {}

    def band(self, element: XML.Element) -> Band:
        """Read a band with its sources."""
        parts = _known_parts(element, (*_BAND, *_SOURCES), self._path)
        kind = element.attrib.get("dataType", "Byte")
        check_data(kind in _TYPES, self._path, f"bands of {', '.join(_TYPES)}", f"{kind!r:.40}")
        texts = {part.tag: _text(part) for part in parts if part.tag in _BAND}
        nodata = self._number(texts["NoDataValue"]) if "NoDataValue" in texts else None
        sources = tuple(self._source(part) for part in parts if part.tag in _SOURCES)
        places = np.array([source.place for source in sources], np.float64).reshape(-1, 4)
        places[:, 2:] += places[:, :2]
        self._check_layers(places)
        return Band(
            kind=_TYPES[kind],
            meaning=texts.get("ColorInterp", "").lower(),
            nodata=nodata,
            hides_nodata=texts.get("HideNoDataValue", "0") not in ("0", ""),
            sources=sources,
            places=places,
        )

    def _check_layers(self, places: NDArray[np.float64]) -> None:
        """Raise `DataError` for sources that lie over each other so often that a window would take minutes."""
        width, height = self._size
        areas = np.prod(places[:, 2:] - places[:, :2], 1)
        layers = float(areas.sum()) / (width * height)
        expected = f"sources that cover it at most {_MOST_LAYERS} times"
        check_data(layers <= _MOST_LAYERS, self._path, expected, f"as much as {layers:,.0f} times")

    def _source(self, element: XML.Element) -> Source:
        """Read a source, whose file is opened to check what is said of it."""
        path = self._path
        parts = {part.tag: part for part in _known_parts(element, _SOURCE, path)}
        texts = {name: _text(part) for name, part in parts.items()}
        check_data("SourceFilename" in parts, path, "sources with the names of files", "one without")
        file = self._file(parts["SourceFilename"])
        raster = self._open_source(file)
        band, of_mask = self._band_of(texts.get("SourceBand", "1"), file, raster)
        window, place = self._rects(parts, raster)
        component = texts.get("ColorTableComponent", "0")
        check_data(component in ("0", "1", "2", "3", "4"), path, "a component from 1 to 4", f"{component!r:.40}")
        nodata = self._number(texts["NODATA"]) if "NODATA" in texts else None
        masked = texts.get("UseMaskBand", "").lower() in _TRUE
        table = self._table(texts.get("LUT", ""))
        # GDAL leaves the file's own value without data out of averages.
        has_other_nodata = nodata is not None and nodata != raster.nodatavals[band - 1]
        return Source(
            path=file,
            band=band,
            of_mask=of_mask,
            window=window,
            place=place,
            resampling=self._resampling(element),
            nodata=nodata,
            masked=masked,
            component=int(component),
            ratio=self._number(texts.get("ScaleRatio", "1")),
            offset=self._number(texts.get("ScaleOffset", "0")),
            table=table,
            discrete=has_other_nodata or masked or component != "0" or bool(table),
        )

    def _file(self, name: XML.Element) -> Path:
        """Find the file of a source, which is a picture in the folder of the mosaic or below."""
        text = name.text or ""
        is_relative = name.attrib.get("relativeToVRT") == "1"
        # Other names are relative to the working folder, or absolute.
        place = text if is_relative else str(Path(text).absolute())
        if place not in self._files:
            file = _picture(self._path, place)
            self._files[place] = file
            self.has_overviews[file] = bool(self._open_source(file).overviews(1))
        return self._files[place]

    def _band_of(self, text: str, file: Path, raster: Dataset) -> tuple[int, bool]:
        """Read the number of a source's band, and whether its mask is taken: `2`, or `mask,2`."""
        word, _, number = text.rpartition(",")
        is_band = word in ("", "mask") and number.isdecimal() and 1 <= int(number) <= raster.count
        expected = f"a band of {file.name} from 1 to {raster.count}"
        check_data(is_band, self._path, expected, f"{text!r:.40}")
        return int(number), word == "mask"

    def _rects(self, parts: dict[str, XML.Element], raster: Dataset) -> tuple[Rect, Rect]:
        """Read the part of a source's file that is shown, cut to the file, and its place in the mosaic."""
        are_both = ("SrcRect" in parts) == ("DstRect" in parts)
        check_data(are_both, self._path, "both SrcRect and DstRect of a source, or neither", "one of them")
        if "SrcRect" in parts:
            window = _rect(parts["SrcRect"], self._path)
            place = _rect(parts["DstRect"], self._path)
        else:
            window = place = (0.0, 0.0, float(raster.width), float(raster.height))
        x, width, left, place_width = _cut_side(window[0], window[2], place[0], place[2], raster.width)
        y, height, top, place_height = _cut_side(window[1], window[3], place[1], place[3], raster.height)
        return (x, y, width, height), (left, top, place_width, place_height)

    def _resampling(self, element: XML.Element) -> str:
        """Read the name of a source's resampling."""
        if element.tag == "AveragedSource":
            return "average"
        name = element.attrib.get("resampling", "nearest")
        # GDAL writes it without, rasterio with an underscore.
        name = "cubic_spline" if name == "cubicspline" else name
        check_data(name in _RESAMPLINGS, self._path, f"a resampling of {', '.join(_RESAMPLINGS)}", f"{name!r:.40}")
        return name

    def _table(self, text: str) -> tuple[tuple[float, float], ...]:
        """Read values and what stands for them: `0:0,255:1`."""
        pairs = []
        for pair in text.split(","):
            if pair:
                value, meant = _numbers(pair.replace(":", ","), 2, self._path)
                pairs.append((value, meant))
        return tuple(pairs)

    def _number(self, text: str) -> float:
        (number,) = _numbers(text, 1, self._path)
        return number


def _mask_of(parts: Sequence[XML.Element], reader: _Reader, path: Path) -> Band | None:
    """Read the mask of a mosaic: the first band in its parts of this kind, all of which are checked."""
    bands: list[XML.Element] = []
    for part in parts:
        if part.tag == "MaskBand":
            bands += _known_parts(part, ("VRTRasterBand",), path)
    return reader.band(bands[0]) if bands else None


def _root(path: Path) -> XML.Element:
    try:
        root = XML.fromstring(read_bytes(path, most=_MOST_BYTES))
    except (XML.ParseError, ValueError, LookupError, RecursionError) as error:
        raise DataError(f"{path}: expected the XML text of a mosaic, got none that can be read ({error})") from None
    check_data(root.tag == "VRTDataset", path, "a mosaic, a VRTDataset", repr(root.tag[:40]))
    return root


def _known_parts(element: XML.Element, known: tuple[str, ...], path: Path) -> list[XML.Element]:
    """List the known parts of an element, without those that are not needed; others are refused."""
    # Other subclasses compute their pixels, or read them from files of any kind.
    subclasses = [value for name, value in element.attrib.items() if name.lower() == "subclass"]
    kind = subclasses[0] if subclasses else element.tag
    is_plain = kind in (element.tag, "VRTSourcedRasterBand")
    check_data(is_plain, path, "a mosaic of files", f"a part of the kind {kind!r:.60}")
    parts = [part for part in element if part.tag not in _LEFT_OUT]
    for part in parts:
        check_data(part.tag in known, path, "a mosaic of files", f"a part of the kind {part.tag!r:.60}")
    return parts


def _text(element: XML.Element) -> str:
    return (element.text or "").strip()


def _picture(path: Path, name: str) -> Path:
    """Find the file of a source by its name in a mosaic."""
    try:
        file = inside(path.parent, name).resolve()
    except DataError:
        raise DataError(f"{path}: expected sources in the folder of the mosaic or below, got {name!a:.200}") from None
    check_data(file.is_file(), path, "sources that are files", f"{name!a:.200}")
    is_picture = driver_of(file) is not None
    check_data(is_picture, path, "sources that are TIFF, JPEG 2000, PNG or JPEG files", f"{name!a:.200}")
    return file


def _system(element: XML.Element, path: Path) -> "CRS":
    """Read the reference system of a mosaic; other words than a number or WKT may be files and addresses."""
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    text = _text(element)
    number = re.fullmatch(r"EPSG:(\d{1,9})", text)
    is_wkt = re.fullmatch(r"[A-Z_]+\[.*", text, re.DOTALL) is not None
    is_known = number is not None or is_wkt
    check_data(is_known, path, "a reference system as EPSG:number or as WKT", f"{text!r:.80}")
    check_system(text, path)
    try:
        return CRS.from_wkt(text) if number is None else CRS.from_epsg(int(number[1]))
    except CRSError as error:
        raise DataError(f"{path}: expected a reference system that is known, got {text!r:.80} ({error})") from None


def _numbers(text: str | None, count: int, path: Path) -> tuple[float, ...]:
    """Read numbers with commas between them."""
    try:
        numbers = tuple(float(number) for number in (text or "").split(","))
    except ValueError:
        numbers = ()
    check_data(len(numbers) == count, path, f"{count} numbers", f"{text!r:.80}")
    return numbers


def _pixels(element: XML.Element, name: str, path: Path) -> float:
    """Read an attribute of an element that is a number of pixels."""
    (number,) = _numbers(element.attrib.get(name), 1, path)
    check_data(bool(np.isfinite(number)) and abs(number) < 2**31, path, f"a number of pixels as {name}", number)
    return number


def _rect(element: XML.Element, path: Path) -> Rect:
    x, y, width, height = (_pixels(element, name, path) for name in ("xOff", "yOff", "xSize", "ySize"))
    check_data(width > 0 and height > 0, path, f"a width and a height of {element.tag}", f"{width} × {height}")
    return x, y, width, height


def _cut_side(start: float, length: float, place: float, reach: float, most: int) -> tuple[float, float, float, float]:
    """Cut a side of a source to its file, and its place in proportion.

    Args:
        start: of the part that is shown, in pixels of the file.
        length: of that part.
        place: where it lies in the mosaic.
        reach: its length there.
        most: length of the file's side.

    Returns:
        The four numbers of what is in the file.
    """
    first = min(max(start, 0.0), float(most))
    end = min(max(start + length, 0.0), float(most))
    cut_length = end - first
    scale = reach / length
    cut_place = place + (first - start) * scale
    return first, cut_length, cut_place, cut_length * scale
