"""The place of a picture on earth, from a GeoTIFF or another raster that GDAL reads."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from semfov.data.images import quiet_decoders
from semfov.data.windowed import RASTERS
from semfov.errors import DataError, needing
from semfov.io.files import check_regular
from semfov.paths.look import shorter_way

PlaceOnEarth = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Longitude and latitude `(N, 2)` of points `(N, 2)` in pixels."""

_Ring = list[list[float]]  # longitude and latitude, or x and y, of its corners, of which the last is the first again


class Geometry(TypedDict):
    """Geometry of GeoJSON: one polygon, or several."""

    type: Literal["Polygon", "MultiPolygon"]
    coordinates: list[_Ring] | list[list[_Ring]]


# Tags of a GeoTIFF (OGC GeoTIFF 1.1, section 7.1): the directory of its keys, which each has, and the texts, of which
# some programs make a reference system.
_GEO_KEYS = 34735
_GEO_TEXTS = 34737


def georeference(source: str) -> PlaceOnEarth | None:
    """Find where the pixels of a picture lie on earth.

    Args:
        source: file of the picture.

    Returns:
        The map from pixels to longitude and latitude; None for a picture without a place on earth.

    Raises:
        InputError: the picture has a georeference, and rasterio is not installed.
        DataError: the file cannot be read.
    """
    if not _may_have_place(source):
        return None
    with needing("rasterio", f"source: {source}", '"semfov[geo]"'):
        from rasterio import warp

    system, affine = _system_and_transform(source)
    if system is None or affine.is_identity:  # a system alone does not say where the picture lies
        return None

    def place(points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert pixels to longitude and latitude."""
        column, row = points.T
        x = affine.a * column + affine.b * row + affine.c
        y = affine.d * column + affine.e * row + affine.f
        longitude, latitude = warp.transform(system, "EPSG:4326", x, y)[:2]
        return np.stack([longitude, latitude], -1)

    try:
        corner = warp.transform(system, "EPSG:4326", [affine.c], [affine.f])
    except Exception:  # a system of its own, such as that of a building site, has no place on earth; of any error
        return None
    return place if np.isfinite(corner).all() else None


def _may_have_place(source: str) -> bool:
    """Tell whether a file is a GeoTIFF, or by its name another raster that can have a place on earth."""
    suffix = Path(source).suffix.lower()
    if suffix in RASTERS:
        return True
    return suffix in (".tif", ".tiff") and _is_referenced(source)


def _system_and_transform(source: str) -> tuple[Any, Any]:
    """Read the reference system of a raster, None for none, and its affine transform, fitted to points if it has these.

    Raises:
        DataError: the file cannot be read.
    """
    import rasterio.transform

    from semfov.data.gdal import raster_settings
    from semfov.data.vrt import open_raster

    try:
        with quiet_decoders, raster_settings():
            picture = open_raster(source)
        with picture:
            points, system_of_points = picture.gcps
            if picture.transform.is_identity and points:
                return system_of_points, rasterio.transform.from_gcps(points)
            return picture.crs, picture.transform
    except (rasterio.errors.RasterioError, OSError) as error:
        raise DataError(f"{source}: expected a readable GeoTIFF, got: {error}") from None


_STEPS = 4  # along a side of a box, each shorter than half the way round the globe


def box_on_earth(corners: NDArray[np.float64], place: PlaceOnEarth) -> Geometry:
    """Make the GeoJSON geometry of a box.

    Args:
        corners: `(4, 2)`, in pixels, in their order around the box.
        place: where pixels lie on earth.

    Returns:
        A polygon, or two where the box crosses the antimeridian.
    """
    # A side of the box in pixels is a curve on earth, which its corners alone would cut short.
    share = np.arange(_STEPS)[:, None] / _STEPS  # (steps, 1)
    to_next = np.roll(corners, -1, 0) - corners  # (4, 2)
    sides = corners[:, None] + to_next[:, None] * share  # (4, steps, 2)
    return polygon_on_earth(place(sides.reshape(-1, 2)), _STEPS)


def polygon_on_earth(ring: NDArray[np.float64], every: int = 1) -> Geometry:
    """Make the GeoJSON geometry of a ring, cut at the antimeridian (RFC 7946, 3.1.9).

    Args:
        ring: `(N, 2)`, longitudes and latitudes.
        every: one of how many places is a corner, from the first on.

    Returns:
        A polygon, or two where the ring crosses the antimeridian, or goes round a pole.

    >>> polygon_on_earth(np.array([[200.0, 1], [201, 1], [201, 2], [200, 2]]))["coordinates"][0][0]
    [-160.0, 1.0]
    """
    longitude = _unwrapped(ring[:, 0])  # (N + 1,)
    latitude = ring[:, 1]  # (N,)
    # Back at the first corner, the longitude differs by a whole turn if a pole lies inside.
    if abs(longitude[-1] - longitude[0]) > 180:
        corners = _with_pole(longitude, latitude)
    else:
        corners = np.stack([longitude[:-1], latitude], -1)[::every]
    # The westernmost corner from -180 to 180 degrees; the others may lie beyond the antimeridian.
    westernmost = corners[:, 0].min()
    corners[:, 0] -= 360 * np.floor((westernmost + 180) / 360)
    if _signed_area(corners) < 0:
        corners = corners[::-1]  # outer rings are counterclockwise
    if corners[:, 0].max() <= 180:
        return {"type": "Polygon", "coordinates": [_closed(corners)]}
    west = _cut(corners, 1.0)
    east = _cut(corners, -1.0) - [360.0, 0.0]
    return {"type": "MultiPolygon", "coordinates": [[_closed(west)], [_closed(east)]]}


def _unwrapped(longitudes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Follow the longitudes of a ring of N corners without a jump of 360 degrees, back to the first one, `(N + 1,)`."""
    steps = shorter_way(np.diff(longitudes, append=longitudes[0]), 360)
    return longitudes[0] + np.concatenate([[0.0], np.cumsum(steps)])


def _signed_area(corners: NDArray[np.float64]) -> float:
    """Compute twice the area of a ring `(N, 2)`, positive if it goes counterclockwise."""
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _with_pole(east: NDArray[np.float64], north: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lead a ring that goes round a pole to the pole and back, `(N + 3, 2)`; `east` ends once round the globe."""
    pole = np.copysign(90.0, north.mean())
    longitudes = [*east, east[-1], east[0]]
    latitudes = [*north, north[0], pole, pole]
    return np.stack([longitudes, latitudes], -1)


def _closed(corners: NDArray[np.float64]) -> list[list[float]]:
    """Close a ring of GeoJSON, whose last corner is the first one."""
    rounded = corners.round(8).tolist()  # a millimetre
    return [*rounded, rounded[0]]


def _cut(corners: NDArray[np.float64], side: float) -> NDArray[np.float64]:
    """Cut the part of a ring `(N, 2)` that lies west (1) or east (-1) of the antimeridian."""
    part: list[NDArray[np.float64]] = []
    # Distances to the antimeridian in degrees, positive on the wanted side.
    distances = side * (180.0 - corners[:, 0])
    next_corners = np.roll(corners, -1, 0)
    next_distances = np.roll(distances, -1)
    for corner, next_corner, distance, next_distance in zip(
        corners, next_corners, distances, next_distances, strict=True
    ):
        if distance >= 0:
            part.append(corner)
        if distance * next_distance < 0:
            share = distance / (distance - next_distance)
            latitude = corner[1] + (next_corner[1] - corner[1]) * share
            part.append(np.array([180.0, latitude]))
    return np.array(part)


def _is_referenced(source: str) -> bool:
    """Tell whether a TIFF is a GeoTIFF; refuse a reference system that names a file."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    from semfov.data.gdal import check_system

    check_regular(source)
    try:
        with quiet_decoders, Path(source).open("rb") as file:
            head = file.read(8)
            if b"+" in head[2:4]:  # 43, the version of a BigTIFF, whose head is twice as long
                head += file.read(8)
            tags = ImageFileDirectory_v2(head)
            file.seek(tags.next)
            tags.load(file)
            check_system(str(tags.get(_GEO_TEXTS, "")), source)
            return _GEO_KEYS in tags
    except (OSError, SyntaxError, struct.error) as error:
        raise DataError(f"{source}: expected a readable TIFF, got: {error}") from None
