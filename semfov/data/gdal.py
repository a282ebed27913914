"""Opening of rasters with the one GDAL driver for their format, which reads no other files.

GDAL would choose a driver by the content of a file, and some of its drivers send requests or read other files.
"""

import math
import re
from collections.abc import Sequence
from contextlib import AbstractContextManager
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self, TypedDict, Unpack

import numpy as np

from semfov.data.images import check_proportion
from semfov.data.signatures import kind_of
from semfov.data.tone import Values
from semfov.errors import DataError, check_data

if TYPE_CHECKING:
    from rasterio.control import GroundControlPoint
    from rasterio.crs import CRS
    from rasterio.enums import ColorInterp, MaskFlags, Resampling
    from rasterio.transform import Affine
    from rasterio.windows import Window

MOST_SIDE = 2**20  # longest side in pixels of a picture that is read by windows
_MOST_BLOCK = 2**28  # bytes of a tile or a strip, which GDAL decodes as a whole
_MOST_BANDS = 2**12
_BLOCKS = 64  # megabytes of decoded blocks that GDAL keeps; its default is a twentieth of the machine's memory
# Files beside a raster (.ovr, .aux.xml, .msk) may be rasters of any driver themselves, or name others.
_SETTINGS = {"GDAL_CACHEMAX": _BLOCKS, "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR"}
_PATH = re.compile(r"""["=@,]\s*(/|~|\.{1,2}[/\\]|[A-Za-z]+:[/\\])""")
"""The beginning of a path in the words of a reference system."""

_DRIVERS = {"TIFF": "GTiff", "JPEG2000": "JP2OpenJPEG", "PNG": "PNG", "JPEG": "JPEG"}
"""Drivers by the kinds of files that they read (`kind_of`)."""


Bands = int | Sequence[int]
"""The number of a band from 1, which is read as `(h, w)`, or several, as `(C, h, w)`."""


class WindowOptions(TypedDict):
    """The arguments by which a window of a raster is read: where, in which shape, and how it is resampled."""

    window: "Window"
    out_shape: tuple[int, ...]
    resampling: "Resampling"


class Raster(Protocol):
    """Protocol of a raster: a dataset of rasterio, or a mosaic (`semfov.data.vrt.Mosaic`).

    Attributes:
        width, height: in pixels.
        count: number of bands.
        dtypes: of the bands.
        nodatavals: values of pixels without data, of each band; None for none.
        colorinterp: rasterio's meaning of each band.
        mask_flag_enums: rasterio's flags of the mask of each band.
        crs, transform, gcps: where the raster lies, as rasterio has it.
    """

    width: int
    height: int
    count: int
    dtypes: tuple[str, ...]
    nodatavals: tuple[float | None, ...]
    colorinterp: tuple["ColorInterp", ...]
    mask_flag_enums: tuple[Sequence["MaskFlags"], ...]
    crs: "CRS | None"
    transform: "Affine"
    gcps: tuple[Sequence["GroundControlPoint"], "CRS | None"]

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def close(self) -> None: ...

    def overviews(self, band: int) -> list[int]: ...

    def read(self, bands: Sequence[int], **options: Unpack[WindowOptions]) -> Values: ...

    def read_masks(self, bands: Sequence[int], **options: Unpack[WindowOptions]) -> Values: ...


class Dataset(Raster, Protocol):
    """Protocol of the further attributes that are read from a dataset of rasterio."""

    driver: str
    block_shapes: list[tuple[int, int]]

    def read(self, bands: Bands, **options: Unpack[WindowOptions]) -> Values: ...

    def read_masks(self, bands: Bands, **options: Unpack[WindowOptions]) -> Values: ...

    def colormap(self, band: int) -> dict[int, tuple[int, int, int, int]]: ...

    def tags(self, *, ns: str, bidx: int = 0) -> dict[str, str]: ...

    def get_tag_item(self, name: str, namespace: str, *, bidx: int) -> str | None: ...


def raster_settings() -> AbstractContextManager[object]:
    """Make a context with GDAL's settings for rasters of others, in which rasters are opened and windows are read."""
    import rasterio

    settings: AbstractContextManager[object] = rasterio.Env(**_SETTINGS)
    return settings


def driver_of(path: Path) -> str | None:
    """Return the only driver that may read a file, by its first bytes; None if it is no picture."""
    kind, _ = kind_of(path)
    return _DRIVERS.get(kind)


def open_file(path: str | PathLike[str], driver: str) -> Dataset:
    """Open a raster by one driver, inside `raster_settings`.

    Args:
        path: the file.
        driver: name of GDAL's driver.

    Returns:
        The dataset of rasterio.

    Raises:
        DataError: the raster is too large, or names other files.
    """
    import rasterio

    path = Path(path)
    held = path.stat().st_size  # GDAL has many messages for a file that is not there
    file: Dataset = rasterio.open(path.absolute(), driver=driver)
    try:
        _check_opened(file, held, path)
    except DataError:
        file.close()
        raise
    return file


def _check_opened(file: Dataset, held: int, path: Path) -> None:
    """Raise `DataError` for a dataset out of proportion to the `held` bytes of its file, or with files beside it."""
    check_size((file.width, file.height), held, path)
    check_data(file.count <= _MOST_BANDS, path, f"at most {_MOST_BANDS:,} bands", file.count)
    names = {key.upper() for key in file.tags(ns="OVERVIEWS")}
    expected = "a raster with overviews of its own"
    check_data("OVERVIEW_FILE" not in names, path, expected, "one that names another file")
    pixels = max(math.prod(shape) for shape in file.block_shapes)
    bytes_a_pixel = file.count * np.dtype(file.dtypes[0]).itemsize
    block = pixels * bytes_a_pixel
    got = f"{block:,}; convert it to a tiled TIFF"
    check_data(block <= _MOST_BLOCK, path, f"tiles of at most {_MOST_BLOCK:,} bytes", got)


def check_system(words: str, name: object) -> None:
    """Raise `DataError` for a reference system that names a file, such as a grid, which PROJ would open."""
    check_data(not _PATH.search(words), name, "a reference system that names no file", f"{words!r:.200}")


def check_size(size: tuple[int, int], held: int, path: Path) -> None:
    """Raise `DataError` for a raster of `(width, height)` with a longer side, or more pixels, than its bytes hold."""
    got = f"{size[0]} × {size[1]}; divide it"
    check_data(max(size) <= MOST_SIDE, path, f"at most {MOST_SIDE:,} pixels along a side", got)
    check_proportion(size, held, path)
