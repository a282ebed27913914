"""Mosaics of files, GDAL's VRT, composed here of what their files show.

GDAL's own reader of mosaics opens whatever is named, by any driver. Here a source is a picture in the folder of the
mosaic or below, read by the driver of its kind, and what a mosaic may say is listed.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, floor
from os import PathLike
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree as XML

import numpy as np
from numpy.typing import NDArray

from semfov.data.gdal import check_size, check_system, driver_of, open_file
from semfov.errors import DataError, check_data
from semfov.io.files import inside, read_bytes

_Rect = tuple[float, float, float, float]  # x, y, width, height

_DRIVERS = {".tif": "GTiff", ".tiff": "GTiff", ".jp2": "JP2OpenJPEG"}
_MOST_BYTES = 2**26  # of the text of a mosaic
_MOST_SOURCES = 2**15  # of all bands, each of which takes a fraction of a millisecond
_MOST_LAYERS = 16  # sources that lie one over another
_ROUNDING = 1e-6  # of a pixel
_OPEN = 64  # files of a mosaic that are open at once
_TYPES = {
    "Byte": "uint8",
    **{name: name.lower() for name in ("Int8", "UInt16", "Int16", "UInt32", "Int32", "Float32", "Float64")},
}
# Parts of a mosaic's text that are read, those that are left out, and no others.
_DATASET = "SRS", "GeoTransform", "VRTRasterBand", "MaskBand"
_BAND = "ColorInterp", "NoDataValue", "HideNoDataValue", "ColorTable"
_SOURCES = "SimpleSource", "ComplexSource", "AveragedSource"
_SOURCE = (
    *("SourceFilename", "SourceBand", "SourceProperties", "SrcRect", "DstRect"),
    *("NODATA", "UseMaskBand", "LUT", "ScaleOffset", "ScaleRatio", "ColorTableComponent"),
)
_LEFT_OUT = (
    *("Metadata", "GCPList", "OverviewList", "BlockXSize", "BlockYSize"),
    *("Description", "UnitType", "Offset", "Scale", "CategoryNames", "Histograms"),
)


@dataclass(frozen=True)
class _Source:
    """A part of a file and its place in a band."""

    path: Path
    band: int
    mask: bool  # whether the band's mask is taken in its place
    seen: _Rect  # part of the file
    place: _Rect  # where it lies in the mosaic
    resampling: str
    nodata: float | None  # value of pixels that are not there
    masked: bool  # whether pixels outside the file's mask are not there
    component: int  # of the file's table of colours, from 1; 0 for none
    ratio: float
    offset: float
    table: tuple[tuple[float, float], ...]  # values and what stands for them
    apart: bool  # whether averages of its values would mix what is there with what is not, or the numbers of colours


@dataclass(frozen=True)
class _Band:
    kind: str  # dtype
    meaning: str
    nodata: float | None
    hidden: bool  # whether the value without data is nobody's concern
    sources: tuple[_Source, ...]
    places: NDArray[np.float64]  # of the sources, `(N, 4)`: x1, y1, x2, y2


@dataclass(frozen=True)
class _Side:
    """What a canvas shows of a source, along one of its sides."""

    covered: range  # pixels of the canvas whose middles lie in the source
    whole: range  # those of them that lie in it with all they show, or all where there are none
    start: float  # in the source's own pixels, of what these show
    length: float

    @staticmethod
    def of(source: _Source, axis: int, origin: float, scale: float, most: int) -> "_Side":
        place, reach = source.place[axis], source.place[2 + axis]
        first, end = (place - origin) * scale, (place + reach - origin) * scale
        covered = range(max(ceil(first - 0.5), 0), min(ceil(end - 0.5), most))
        whole = range(max(ceil(first - _ROUNDING), 0), min(floor(end + _ROUNDING), most))
        whole = whole or covered
        low, high = (source.seen[axis] + (origin + pixel / scale - place) * source.seen[2 + axis] / reach
                     for pixel in (whole.start, whole.stop))  # fmt: skip
        low, high = max(low, source.seen[axis]), min(high, source.seen[axis] + source.seen[2 + axis])
        return _Side(covered, whole, low, high - low)


class Mosaic:
    """A mosaic of files with the attributes of a raster that rasterio opens; use it inside `raster_settings`."""

    def __init__(self, path: Path) -> None:
        from rasterio.enums import ColorInterp, MaskFlags
        from rasterio.transform import Affine

        self._path = path
        self._file = lru_cache(_OPEN)(_open_source)
        root = _root(path)
        parts = _kept(root, _DATASET, path)
        count = sum(part.tag in _SOURCES for part in root.iter())
        check_data(count <= _MOST_SOURCES, path, f"at most {_MOST_SOURCES:,} sources", f"{count:,}; join files first")
        self.width, self.height = (int(_number(root, name, path)) for name in ("rasterXSize", "rasterYSize"))
        check_data(min(self.width, self.height) > 0, path, "a width and a height", f"{self.width} × {self.height}")
        self._files: dict[str, Path] = {}
        self._has_overviews: dict[Path, bool] = {}
        self._bands = [self._band(part) for part in parts if part.tag == "VRTRasterBand"]
        masks = [band for part in parts if part.tag == "MaskBand" for band in _kept(part, ("VRTRasterBand",), path)]
        self._mask = self._band(masks[0]) if masks else None
        check_data(bool(self._bands), path, "at least one band", "none")
        held = path.stat().st_size + sum(file.stat().st_size for file in set(self._files.values()))
        check_size((self.width, self.height), held, path)

        self.count = len(self._bands)
        self.dtypes = tuple(band.kind for band in self._bands)
        self.nodatavals = tuple(None if band.hidden else band.nodata for band in self._bands)
        known = ColorInterp.__members__
        self.colorinterp = tuple(known.get(band.meaning, ColorInterp.undefined) for band in self._bands)
        masked = self._mask is not None or ColorInterp.alpha in self.colorinterp
        self.mask_flag_enums = ([MaskFlags.per_dataset if masked else MaskFlags.all_valid],) * self.count
        self.crs = next((_system(part, path) for part in parts if part.tag == "SRS"), None)
        numbers = next((_numbers(part.text, 6, path) for part in parts if part.tag == "GeoTransform"), None)
        self.transform = Affine.identity() if numbers is None else Affine.from_gdal(*numbers)
        self.gcps: tuple[list[Any], None] = [], None

    def __enter__(self) -> "Mosaic":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._file.cache_clear()

    def overviews(self, band: int) -> list[int]:
        """Factors of reduced copies: some where all files of a band have them and their values have averages."""
        sources = self._bands[band - 1].sources
        return [2] if sources and all(self._has_overviews[each.path] and not each.apart for each in sources) else []

    def holds(self, box: tuple[int, int, int, int]) -> bool:
        """Whether a source lies in a window."""
        return any(len(_touching(band.places, box)) > 0 for band in self._bands)

    def read(self, bands: Sequence[int], *, window: Any, out_shape: tuple[int, ...], resampling: Any) -> NDArray[Any]:
        """Read a window of some bands, `(C, h, w)`."""
        shape = out_shape[-2], out_shape[-1]
        kind = np.result_type(*(self.dtypes[band - 1] for band in bands))
        found = np.empty((len(bands), *shape), kind)
        for row, band in enumerate(bands):
            found[row] = self._composed(self._bands[band - 1], window, shape, resampling)
        return found

    def read_masks(
        self, bands: Sequence[int], *, window: Any, out_shape: tuple[int, ...], resampling: Any
    ) -> NDArray[Any]:
        """Read a window of the mask, which is one for all bands, `(C, h, w)`."""
        alphas = (band for band in self._bands if band.meaning == "alpha")
        band = next(alphas, None) if self._mask is None else self._mask
        assert band is not None, "asked for where flags tell of a mask"
        mask = self._composed(band, window, (out_shape[-2], out_shape[-1]), resampling)
        return np.broadcast_to(mask, (len(bands), *mask.shape))

    def _composed(self, band: _Band, window: Any, shape: tuple[int, int], resampling: Any) -> NDArray[Any]:
        """Values of a band in a window, where a source covers the earlier ones, resampled to a shape."""
        canvas = np.full(shape, 0 if band.nodata is None else _as_kind(np.array(band.nodata), band.kind), band.kind)
        box = window.col_off, window.row_off, window.col_off + window.width, window.row_off + window.height
        scales = shape[1] / window.width, shape[0] / window.height
        for number in _touching(band.places, box):
            source = band.sources[number]
            across = _Side.of(source, 0, box[0], scales[0], shape[1])
            down = _Side.of(source, 1, box[1], scales[1], shape[0])
            if across.covered and down.covered:
                values, there = self._values(source, across, down, resampling if max(scales) < 1 else None)
                part = slice(down.covered.start, down.covered.stop), slice(across.covered.start, across.covered.stop)
                values = _as_kind(values, band.kind)
                canvas[part] = values if there is None else np.where(there, values, canvas[part])
        return canvas

    def _values(
        self, source: _Source, across: "_Side", down: "_Side", by: Any
    ) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Values of a part of a source, and where they are there (None: all over); `by` is a reduction's resampling."""
        from rasterio.enums import Resampling
        from rasterio.windows import Window

        file = self._file(source.path)
        given = {
            "window": Window(across.start, down.start, across.length, down.length),
            "out_shape": (len(down.whole), len(across.whole)),
            "resampling": Resampling.nearest if source.apart else (by or Resampling[source.resampling]),
        }
        values = file.read_masks(source.band, **given) if source.mask else file.read(source.band, **given)
        there: NDArray[np.bool_] | None = None
        if source.nodata is not None:
            there = ~np.isnan(values) if np.isnan(source.nodata) else values != source.nodata
        if source.masked:
            there = file.read_masks(source.band, **given) > 0
        if source.component:
            colours = file.colormap(source.band)
            parts = [colours.get(value, (0, 0, 0, 255))[source.component - 1] for value in range(256)]
            values = np.array(parts)[values.astype(np.uint8)]
        if source.table:
            known, meant = zip(*source.table, strict=True)
            values = np.interp(values, known, meant)
        if (source.ratio, source.offset) != (1.0, 0.0):
            values = values * source.ratio + source.offset
        edges = _edges(down), _edges(across)
        if edges == ((0, 0), (0, 0)):
            return values, there
        return np.pad(values, edges, "edge"), None if there is None else np.pad(there, edges, "edge")

    def _band(self, part: XML.Element) -> _Band:
        path, parts = self._path, _kept(part, (*_BAND, *_SOURCES), self._path)
        kind = part.attrib.get("dataType", "Byte")
        check_data(kind in _TYPES, path, f"bands of {', '.join(_TYPES)}", f"{kind!r:.40}")
        texts = {each.tag: (each.text or "").strip() for each in parts if each.tag in _BAND}
        (nodata,) = _numbers(texts["NoDataValue"], 1, path) if "NoDataValue" in texts else (None,)
        sources = tuple(self._source(each) for each in parts if each.tag in _SOURCES)
        places = np.array([source.place for source in sources], np.float64).reshape(-1, 4)
        places[:, 2:] += places[:, :2]
        layers = float(np.prod(places[:, 2:] - places[:, :2], 1).sum()) / (self.width * self.height)
        got = f"as much as {layers:,.0f} times"
        check_data(layers <= _MOST_LAYERS, path, f"sources that cover it at most {_MOST_LAYERS} times", got)
        hidden = texts.get("HideNoDataValue", "0") not in ("0", "")
        return _Band(_TYPES[kind], texts.get("ColorInterp", "").lower(), nodata, hidden, sources, places)

    def _source(self, part: XML.Element) -> _Source:
        path, found = self._path, {each.tag: each for each in _kept(part, _SOURCE, self._path)}
        texts = {name: (each.text or "").strip() for name, each in found.items()}
        check_data("SourceFilename" in found, path, "sources with the names of files", "one without")
        file = self._checked(found["SourceFilename"])
        raster = self._file(file)
        word, _, number = texts.get("SourceBand", "1").rpartition(",")
        fits = word in ("", "mask") and number.isdecimal() and 1 <= int(number) <= raster.count
        check_data(fits, path, f"a band of {file.name} from 1 to {raster.count}", f"{texts.get('SourceBand')!r:.40}")
        both = ("SrcRect" in found) == ("DstRect" in found)
        check_data(both, path, "both SrcRect and DstRect of a source, or neither", "one of them")
        whole = 0.0, 0.0, float(raster.width), float(raster.height)
        seen, place = (_rect(found[name], path) if name in found else whole for name in ("SrcRect", "DstRect"))
        seen, place = _cut(seen, place, raster.width, raster.height)
        resampling = "average" if part.tag == "AveragedSource" else part.attrib.get("resampling", "nearest")
        known = "nearest", "bilinear", "cubic", "cubic_spline", "lanczos", "average", "mode"
        resampling = "cubic_spline" if resampling == "cubicspline" else resampling
        check_data(resampling in known, path, f"a resampling of {', '.join(known)}", f"{resampling!r:.40}")
        component = texts.get("ColorTableComponent", "0")
        check_data(component in ("0", "1", "2", "3", "4"), path, "a component from 1 to 4", f"{component!r:.40}")
        nodata = _numbers(texts["NODATA"], 1, path)[0] if "NODATA" in texts else None
        masked = texts.get("UseMaskBand", "").lower() in ("1", "true", "yes")
        told = nodata is None or nodata == raster.nodatavals[int(number) - 1]  # GDAL leaves these out of averages
        pairs = [_numbers(pair.replace(":", ","), 2, path) for pair in texts.get("LUT", "").split(",") if pair]
        return _Source(
            file,
            int(number),
            word == "mask",
            seen,
            place,
            resampling,
            nodata,
            masked,
            int(component),
            _numbers(texts.get("ScaleRatio", "1"), 1, path)[0],
            _numbers(texts.get("ScaleOffset", "0"), 1, path)[0],
            tuple((value, meant) for value, meant in pairs),
            not told or masked or component != "0" or bool(pairs),
        )

    def _checked(self, name: XML.Element) -> Path:
        """The path of a source, which is a picture in the folder of the mosaic or below."""
        text = name.text or ""
        given = text if name.attrib.get("relativeToVRT") == "1" else str(Path(text).absolute())
        if given not in self._files:
            self._files[given] = file = _picture(self._path, given)
            self._has_overviews[file] = bool(self._file(file).overviews(1))
        return self._files[given]


def open_raster(path: str | PathLike[str]) -> Any:
    """A mosaic, or a raster opened by the driver of its name, inside `raster_settings`."""
    path = Path(path)
    kind = path.suffix.lower()
    return Mosaic(path) if kind == ".vrt" else open_file(path, _DRIVERS[kind])


def _root(path: Path) -> XML.Element:
    try:
        root = XML.fromstring(read_bytes(path, most=_MOST_BYTES))
    except (XML.ParseError, ValueError, LookupError, RecursionError) as error:
        raise DataError(f"{path}: expected the XML text of a mosaic, got none that can be read ({error})") from None
    check_data(root.tag == "VRTDataset", path, "a mosaic, a VRTDataset", repr(root.tag[:40]))
    return root


def _kept(element: XML.Element, known: tuple[str, ...], path: Path) -> list[XML.Element]:
    """The known parts of an element, without those that are not needed; others are refused."""
    kind = next((value for name, value in element.attrib.items() if name.lower() == "subclass"), element.tag)
    check_data(
        kind in (element.tag, "VRTSourcedRasterBand"), path, "a mosaic of files", f"a part of the kind {kind!r:.60}"
    )
    parts = [part for part in element if part.tag not in _LEFT_OUT]
    for part in parts:
        check_data(part.tag in known, path, "a mosaic of files", f"a part of the kind {part.tag!r:.60}")
    return parts


def _picture(path: Path, name: str) -> Path:
    """The file of a source by the name in a mosaic."""
    try:
        file = inside(path.parent, name).resolve()
    except DataError:
        raise DataError(f"{path}: expected sources in the folder of the mosaic or below, got {name!a:.200}") from None
    check_data(file.is_file(), path, "sources that are files", f"{name!a:.200}")
    check_data(
        driver_of(file) is not None, path, "sources that are TIFF, JPEG 2000, PNG or JPEG files", f"{name!a:.200}"
    )
    return file


def _open_source(file: Path) -> Any:
    driver = driver_of(file)
    check_data(driver is not None, file, "a TIFF, JPEG 2000, PNG or JPEG file", "another")
    return open_file(file, cast(str, driver))


def _system(part: XML.Element, path: Path) -> Any:
    """The reference system of a mosaic; other words than a number or WKT may be files and addresses."""
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    text = (part.text or "").strip()
    number = re.fullmatch(r"EPSG:(\d{1,9})", text)
    written = re.fullmatch(r"[A-Z_]+\[.*", text, re.DOTALL)
    check_data(bool(number or written), path, "a reference system as EPSG:number or as WKT", f"{text!r:.80}")
    check_system(text, path)
    try:
        return CRS.from_epsg(int(number[1])) if number else CRS.from_wkt(text)
    except CRSError as error:
        raise DataError(f"{path}: expected a reference system that is known, got {text!r:.80} ({error})") from None


def _numbers(text: str | None, count: int, path: Path) -> tuple[float, ...]:
    try:
        numbers = tuple(float(each) for each in (text or "").split(","))
    except ValueError:
        numbers = ()
    check_data(len(numbers) == count, path, f"{count} numbers", f"{text!r:.80}")
    return numbers


def _number(element: XML.Element, name: str, path: Path) -> float:
    (number,) = _numbers(element.attrib.get(name), 1, path)
    check_data(bool(np.isfinite(number)) and abs(number) < 2**31, path, f"a number of pixels as {name}", number)
    return number


def _rect(element: XML.Element, path: Path) -> _Rect:
    x, y, width, height = (_number(element, name, path) for name in ("xOff", "yOff", "xSize", "ySize"))
    check_data(width > 0 and height > 0, path, f"a width and a height of {element.tag}", f"{width} × {height}")
    return x, y, width, height


def _cut(seen: _Rect, place: _Rect, width: int, height: int) -> tuple[_Rect, _Rect]:
    """The part of a file that is in it, and its place."""
    x, wide, left, across = _cut_side(seen[0], seen[2], place[0], place[2], width)
    y, high, top, down = _cut_side(seen[1], seen[3], place[1], place[3], height)
    return (x, y, wide, high), (left, top, across, down)


def _cut_side(start: float, length: float, place: float, reach: float, most: int) -> tuple[float, float, float, float]:
    first = min(max(start, 0.0), float(most))
    end = min(max(start + length, 0.0), float(most))
    scale = reach / length
    return first, end - first, place + (first - start) * scale, (end - first) * scale


def _touching(places: NDArray[np.float64], box: tuple[float, float, float, float]) -> NDArray[np.intp]:
    """Numbers of the places that meet a window."""
    x1, y1, x2, y2 = box
    meets = (places[:, 0] < x2) & (places[:, 2] > x1) & (places[:, 1] < y2) & (places[:, 3] > y1)
    return np.flatnonzero(meets)


def _edges(side: _Side) -> tuple[int, int]:
    """How many covered pixels lie before and behind those that lie in a source with all they show."""
    return side.whole.start - side.covered.start, side.covered.stop - side.whole.stop


def _as_kind(values: NDArray[Any], kind: str) -> NDArray[Any]:
    """Values in another type, rounded and limited to its range as GDAL does."""
    if values.dtype == kind:
        return values
    if np.dtype(kind).kind not in "ui":
        return values.astype(kind)
    limits = np.iinfo(kind)
    whole = np.floor(values + 0.5) if values.dtype.kind == "f" else values
    return np.nan_to_num(whole).clip(limits.min, limits.max).astype(kind)
