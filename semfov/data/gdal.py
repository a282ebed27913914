"""Opening of rasters by GDAL with the drivers that their names tell, and of mosaics whose files lie beside them.

GDAL chooses a driver by the content of a file, and some of its drivers send requests or read other files.
"""

import io
import re
from os import PathLike
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as XML

from semfov.errors import DataError, check_data
from semfov.io.files import inside, read_bytes, reading

_DRIVERS = {".tif": "GTiff", ".tiff": "GTiff", ".jp2": "JP2OpenJPEG", ".vrt": "VRT"}

MOST_SIDE = 2**20  # longest side in pixels of a picture that is read by windows
_BLOCKS = 64  # megabytes of decoded blocks that GDAL keeps; its default is a twentieth of the machine's memory
# Files beside a raster (.ovr, .aux.xml) may be rasters of any driver themselves, or name others. Threads of a mosaic
# would not know of that setting.
_SETTINGS = {"GDAL_CACHEMAX": _BLOCKS, "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "VRT_NUM_THREADS": "1"}

_MOST_BYTES = 2**26  # of the text of a mosaic
_SYSTEM = re.compile(r"(EPSG:\d+|[A-Z_]+\[.*)", re.DOTALL)  # others may be files and addresses
_SIGNATURES = {
    b"II*\0": ".tif",
    b"MM\0*": ".tif",
    b"II+\0": ".tif",
    b"MM\0+": ".tif",
    b"\0\0\0\x0cjP  ": ".jp2",
    b"\xff\x4f\xff\x51": ".jp2",
    b"\x89PNG": ".png",
    b"\xff\xd8\xff": ".jpg",
}
# Parts of a mosaic's text that are handed to GDAL, those that are left out, and no others.
_DATASET = "SRS", "GeoTransform", "OverviewList", "VRTRasterBand"
_BAND = "ColorInterp", "NoDataValue", "HideNoDataValue", "ColorTable"
_SOURCES = "SimpleSource", "ComplexSource", "AveragedSource"  # a filtered one without a kernel ends the process
_SOURCE = (
    *("SourceFilename", "SourceBand", "SourceProperties", "SrcRect", "DstRect", "NODATA", "UseMaskBand", "LUT"),
    *("ScaleOffset", "ScaleRatio", "ColorTableComponent", "Exponent", "SrcMin", "SrcMax", "DstMin", "DstMax"),
)
_LEFT_OUT = (
    *("Metadata", "GCPList", "MaskBand", "BlockXSize", "BlockYSize"),
    *("Description", "UnitType", "Offset", "Scale", "CategoryNames", "Histograms"),
)


def raster_settings() -> Any:
    """GDAL's settings for rasters of others, a context in which `open_raster` is called and windows are read."""
    import rasterio

    return rasterio.Env(**_SETTINGS)


def open_raster(path: str | PathLike[str]) -> Any:
    """A raster opened by the driver of its name, inside `raster_settings`; raises `DataError` for what is refused."""
    import rasterio

    path = Path(path)
    path.stat()  # GDAL has many messages for a file that is not there
    driver = _DRIVERS[path.suffix.lower()]
    source = io.BytesIO(_mosaic_text(path)) if driver == "VRT" else path.absolute()
    file = _without_others(rasterio.open(source, driver=driver), path)
    if max(file.width, file.height) > MOST_SIDE:
        got = f"{file.width} × {file.height}"
        file.close()
        raise DataError(f"{path}: expected at most {MOST_SIDE:,} pixels along a side, got {got}; divide it")
    return file


def _mosaic_text(path: Path) -> bytes:
    """GDAL's text of a mosaic, made anew of what is known in it; its sources are pictures in its folder or below."""
    try:
        root = XML.fromstring(read_bytes(path, most=_MOST_BYTES))
    except (XML.ParseError, ValueError, LookupError, RecursionError) as error:
        raise DataError(f"{path}: expected the XML text of a mosaic, got none that can be read ({error})") from None
    check_data(root.tag == "VRTDataset", path, "a mosaic, a VRTDataset", repr(root.tag[:40]))
    checked: dict[str, str] = {}
    for part in _kept(root, _DATASET, path):
        system = part.tag != "SRS" or _SYSTEM.fullmatch((part.text or "").strip())
        check_data(bool(system), path, "a reference system as EPSG:number or as WKT", f"{part.text!r:.80}")
        for source in _kept(part, (*_BAND, *_SOURCES), path) if part.tag == "VRTRasterBand" else ():
            for name in _kept(source, _SOURCE, path) if source.tag in _SOURCES else ():
                if name.tag == "SourceFilename":
                    text, relative = name.text or "", name.attrib.get("relativeToVRT") == "1"
                    if (given := f"{relative} {text}") not in checked:
                        checked[given] = _source(path, text if relative else str(Path(text).absolute()))
                    name.text, name.attrib, name[:] = checked[given], {"relativeToVRT": "0"}, []
    return XML.tostring(root)


def _kept(element: XML.Element, known: tuple[str, ...], path: Path) -> list[XML.Element]:
    """The known parts of an element, from which those that are not needed are taken; others are refused."""
    kind = next((value for name, value in element.attrib.items() if name.lower() == "subclass"), element.tag)
    plain, files = kind in (element.tag, "VRTSourcedRasterBand"), "a mosaic of files"
    check_data(plain, path, files, f"a part of the kind {kind!r:.60}")
    for part in [*element]:
        if part.tag in _LEFT_OUT:
            element.remove(part)
        else:
            check_data(part.tag in known, path, files, f"a part of the kind {part.tag!r:.60}")
    return [*element]


def _source(path: Path, name: str) -> str:
    """The absolute path of a source of a mosaic, which is a picture in its folder or below."""
    try:
        file = inside(path.parent, name).resolve()
    except DataError:
        raise DataError(f"{path}: expected sources in the folder of the mosaic or below, got {name!a:.200}") from None
    check_data(file.is_file() and "<" not in str(file), path, "sources that are files", f"{name!a:.200}")
    with reading(file), file.open("rb") as opened:
        head = opened.read(8)
    kind = next((kind for start, kind in _SIGNATURES.items() if head.startswith(start)), None)
    check_data(kind is not None, path, "sources that are TIFF, JPEG 2000, PNG or JPEG files", f"{name!a:.200}")
    if kind in _DRIVERS:
        import rasterio

        with rasterio.open(file, driver=_DRIVERS[kind]) as raster:
            _without_others(raster, file)
    return str(file)


def _without_others(file: Any, path: Path) -> Any:
    """The opened raster; refuses one that names another file, or an address, as its reduced copies."""
    if "OVERVIEW_FILE" in {key.upper() for key in file.tags(ns="OVERVIEWS")}:
        file.close()
        raise DataError(f"{path}: expected a raster with overviews of its own, got one that names another file")
    return file
