"""The place of a picture on earth, from a GeoTIFF or another raster that GDAL reads."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semfov.data.gdal import check_system, raster_settings
from semfov.data.images import quiet_decoders
from semfov.data.vrt import open_raster
from semfov.data.windowed import RASTERS
from semfov.errors import DataError, needing
from semfov.io.files import check_regular

PlaceOnEarth = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Longitude and latitude `(N, 2)` of points `(N, 2)` in pixels."""

_GEO_TEXTS = 34737  # tag of the texts of a GeoTIFF, of which some programs make a reference system


def georeference(source: str) -> Callable[[NDArray[np.float64]], NDArray[np.float64]] | None:
    """The map from pixels of a GeoTIFF, or of another raster, to longitude and latitude; → `(N, 2)`."""
    kind = Path(source).suffix.lower()
    if kind not in RASTERS and not (kind in (".tif", ".tiff") and _is_referenced(source)):
        return None
    with needing("rasterio", f"source: {source}", '"semfov[geo]"'):
        import rasterio.transform
        from rasterio.warp import transform

    try:
        with quiet_decoders, raster_settings():
            picture = open_raster(source)
        with picture:
            system, affine = picture.crs, picture.transform
            points, system_of_points = picture.gcps
            if affine.is_identity and points:
                system, affine = system_of_points, rasterio.transform.from_gcps(points)
    except (rasterio.errors.RasterioError, OSError) as error:
        raise DataError(f"{source}: expected a readable GeoTIFF, got: {error}") from None
    if system is None or affine.is_identity:  # a system alone does not say where the picture lies
        return None
    try:
        x, y = transform(system, "EPSG:4326", [affine.c], [affine.f])
    except Exception:  # a system of its own, such as that of a building site, has no place on earth; of any error
        return None
    if not np.isfinite([*x, *y]).all():
        return None

    def place(points: NDArray[np.float64]) -> NDArray[np.float64]:
        column, row = points.T
        x = affine.a * column + affine.b * row + affine.c
        y = affine.d * column + affine.e * row + affine.f
        return np.stack(transform(system, "EPSG:4326", x, y)[:2], -1)

    return place


_STEPS = 4  # along a side of a box, each shorter than half the way round the globe


def box_on_earth(
    corners: NDArray[np.float64], place: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> dict[str, Any]:
    """The GeoJSON geometry of a box with corners `(4, 2)` in pixels, which `place` puts on earth."""
    share = np.arange(_STEPS)[:, None] / _STEPS
    sides = corners[:, None] + (np.roll(corners, -1, 0) - corners)[:, None] * share
    return polygon_on_earth(place(sides.reshape(-1, 2)), _STEPS)


def polygon_on_earth(ring: NDArray[np.float64], every: int = 1) -> dict[str, Any]:
    """The GeoJSON geometry of a ring of longitudes and latitudes `(N, 2)`, cut at the antimeridian (RFC 7946, 3.1.9).

    Its corners are some of the places, `every` one from the first on.

    >>> polygon_on_earth(np.array([[200.0, 1], [201, 1], [201, 2], [200, 2]]))["coordinates"][0][0]
    [-160.0, 1.0]
    """
    # A step from one corner to the next is the shorter way round the globe.
    steps = np.diff(ring[:, 0])
    east = ring[0, 0] + np.concatenate([[0.0], np.cumsum((steps + 180) % 360 - 180)])
    corners = np.stack([east - 360 * np.floor((east.min() + 180) / 360), ring[:, 1]], -1)[::every]
    area = np.sum(corners[:, 0] * np.roll(corners[:, 1], -1) - np.roll(corners[:, 0], -1) * corners[:, 1])
    corners = corners if area >= 0 else corners[::-1]  # outer rings are counterclockwise
    if corners[:, 0].max() <= 180:
        return {"type": "Polygon", "coordinates": [_closed(corners)]}
    parts = _cut(corners, 1.0), _cut(corners, -1.0) - [360.0, 0.0]
    return {"type": "MultiPolygon", "coordinates": [[_closed(part)] for part in parts]}


def _closed(corners: NDArray[np.float64]) -> list[list[float]]:
    """A ring of GeoJSON, whose last corner is the first one."""
    rounded = corners.round(8).tolist()  # a millimetre
    return [*rounded, rounded[0]]


def _cut(corners: NDArray[np.float64], side: float) -> NDArray[np.float64]:
    """The part of a ring that lies west (1) or east (-1) of the antimeridian."""
    kept: list[NDArray[np.float64]] = []
    for here, following in zip(corners, np.roll(corners, -1, 0), strict=True):
        before, after = side * (180.0 - here[0]), side * (180.0 - following[0])
        if before >= 0:
            kept.append(here)
        if before * after < 0:
            share = before / (before - after)
            kept.append(np.array([180.0, here[1] + (following[1] - here[1]) * share]))
    return np.array(kept)


def _is_referenced(source: str) -> bool:
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    check_regular(source)
    try:
        with quiet_decoders, Path(source).open("rb") as file:
            head = file.read(8)
            # The head of a BigTIFF is twice as long.
            tags = ImageFileDirectory_v2(head + file.read(8) if head[2:3] == b"+" or head[3:4] == b"+" else head)
            file.seek(tags.next)
            tags.load(file)
            check_system(str(tags.get(_GEO_TEXTS, "")), source)
            return 34735 in tags  # the directory of GeoKeys, which every GeoTIFF has (OGC GeoTIFF 1.1, section 7.1.2)
    except (OSError, SyntaxError, struct.error) as error:
        raise DataError(f"{source}: expected a readable TIFF, got: {error}") from None
