"""Mosaics of files (GDAL's VRT), composed from the pixels of their files.

GDAL's own reader of mosaics opens whatever is named, by any driver. Here a source is a picture in the folder of the
mosaic or below, read by the driver of its kind, and what a mosaic may say is listed (`semfov.data.vrt_text`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, floor
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import numpy as np
from numpy.typing import NDArray

from semfov.data.gdal import Dataset, WindowOptions, driver_of, open_file
from semfov.data.tone import Values
from semfov.data.vrt_text import Band, Source, read_mosaic
from semfov.data.windowed import Box
from semfov.errors import DataError

if TYPE_CHECKING:
    from rasterio.enums import Resampling

_DRIVERS = {".tif": "GTiff", ".tiff": "GTiff", ".jp2": "JP2OpenJPEG"}
_ROUNDING = 1e-6  # of a pixel
_OPEN = 64  # files of a mosaic that are open at once


@dataclass(frozen=True)
class _Side:
    """What a canvas shows of a source, along one of its sides.

    Attributes:
        covered: pixels of the canvas whose middles lie in the source.
        inner: those of them that lie in it with all they show; all of them where there are none.
        start: of what the inner ones show, in pixels of the source.
        length: of what they show.
    """

    covered: range
    inner: range
    start: float
    length: float

    @classmethod
    def of(cls, source: Source, axis: int, origin: float, scale: float, pixels: int) -> "_Side":
        """Find what a canvas shows of a source.

        Args:
            source: the source.
            axis: 0 for x, 1 for y.
            origin: of the canvas, in pixels of the mosaic.
            scale: pixels of the canvas for one of the mosaic.
            pixels: of the canvas along this side.

        Returns:
            What it shows.
        """
        place = source.place[axis]
        reach = source.place[2 + axis]
        window_start = source.window[axis]
        window_length = source.window[2 + axis]
        canvas_start = (place - origin) * scale
        canvas_end = (place + reach - origin) * scale
        # A pixel whose middle lies in the source is covered.
        first_covered = max(ceil(canvas_start - 0.5), 0)
        end_covered = min(ceil(canvas_end - 0.5), pixels)
        covered = range(first_covered, end_covered)
        first_inner = max(ceil(canvas_start - _ROUNDING), 0)
        end_inner = min(floor(canvas_end + _ROUNDING), pixels)
        inner = range(first_inner, end_inner) or covered

        def in_source(pixel: int) -> float:
            """Find the place in the source where a pixel of the canvas begins."""
            return window_start + (origin + pixel / scale - place) * window_length / reach

        # Without what rounding adds.
        start = max(in_source(inner.start), window_start)
        end = min(in_source(inner.stop), window_start + window_length)
        return cls(covered, inner, start, end - start)

    @property
    def border(self) -> tuple[int, int]:
        """How many covered pixels lie before and behind the inner ones."""
        return self.inner.start - self.covered.start, self.covered.stop - self.inner.stop


class Mosaic:
    """A mosaic of files with the attributes of a raster that rasterio opens; use it inside `raster_settings`.

    Private attributes: `_open` opens a file, and keeps some open; `_bands` and `_mask` are what the text says of them;
    `_has_overviews` tells of each file whether it has reduced copies.
    """

    def __init__(self, path: Path) -> None:
        from rasterio.control import GroundControlPoint
        from rasterio.crs import CRS
        from rasterio.enums import ColorInterp, MaskFlags
        from rasterio.transform import Affine

        self._open = lru_cache(_OPEN)(_open_source)
        text = read_mosaic(path, self._open)
        self._bands = text.bands
        self._mask = text.mask
        self._has_overviews = text.has_overviews

        self.width, self.height = text.size
        self.count = len(text.bands)
        self.dtypes = tuple(band.kind for band in text.bands)
        self.nodatavals = tuple(None if band.hides_nodata else band.nodata for band in text.bands)
        meanings = ColorInterp.__members__
        self.colorinterp = tuple(meanings.get(band.meaning, ColorInterp.undefined) for band in text.bands)
        is_masked = self._mask is not None or ColorInterp.alpha in self.colorinterp
        flag = MaskFlags.per_dataset if is_masked else MaskFlags.all_valid
        self.mask_flag_enums: tuple[Sequence[MaskFlags], ...] = ([flag],) * self.count
        self.crs = text.system
        self.transform = Affine.identity()
        if text.transform is not None:
            self.transform = Affine.from_gdal(*text.transform)
        # A mosaic has no ground control points here.
        self.gcps: tuple[Sequence[GroundControlPoint], CRS | None] = (), None

    def __enter__(self) -> "Mosaic":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._open.cache_clear()

    def overviews(self, band: int) -> list[int]:
        """List factors of reduced copies: some where all files of a band have them and their values have averages."""
        sources = self._bands[band - 1].sources
        are_reduced = all(self._has_overviews[source.path] and not source.discrete for source in sources)
        # The factor does not matter: only whether there are some is asked.
        return [2] if sources and are_reduced else []

    def holds(self, box: Box) -> bool:
        """Tell whether a source lies in a window."""
        return any(len(_touching(band.places, box)) > 0 for band in self._bands)

    def read(self, bands: Sequence[int], **options: Unpack[WindowOptions]) -> Values:
        """Read a window of some bands.

        Args:
            bands: their numbers, from 1.
            **options: of rasterio: the `window`, the last two sizes of the `out_shape` of the result, and a
                `resampling` for a window that is reduced.

        Returns:
            `(C, h, w)`.
        """
        height, width = options["out_shape"][-2:]
        kind = np.result_type(*(self.dtypes[band - 1] for band in bands))
        values = np.empty((len(bands), height, width), kind)
        for row, band in enumerate(bands):
            values[row] = self._composed(self._bands[band - 1], options)
        return values

    def read_masks(self, bands: Sequence[int], **options: Unpack[WindowOptions]) -> Values:
        """Read a window of the mask, which is one for all bands; arguments and result are those of `read`."""
        # Asked for only where `mask_flag_enums` tells of a mask or an alpha.
        band = self._mask or next(band for band in self._bands if band.meaning == "alpha")
        mask = self._composed(band, options)
        return np.broadcast_to(mask, (len(bands), *mask.shape))

    def _composed(self, band: Band, options: WindowOptions) -> Values:
        """Compose a band in a window, where a source covers the earlier ones.

        Args:
            band: the band.
            options: the window, and the shape that it is read in.

        Returns:
            `(h, w)`.
        """
        window = options["window"]
        height, width = options["out_shape"][-2:]
        canvas = _empty_canvas(band, (height, width))
        x_scale = width / window.width
        y_scale = height / window.height
        is_reduced = max(x_scale, y_scale) < 1
        resampling = options["resampling"] if is_reduced else None
        left = window.col_off
        top = window.row_off
        box = left, top, left + window.width, top + window.height
        for number in _touching(band.places, box):
            source = band.sources[number]
            columns = _Side.of(source, 0, left, x_scale, width)
            rows = _Side.of(source, 1, top, y_scale, height)
            # A source that is narrower than a pixel of the canvas may hold no middle of one.
            if not columns.covered or not rows.covered:
                continue
            values, present = self._values(source, columns, rows, resampling)
            # A view, so that what is copied to it is written to the canvas.
            part = canvas[rows.covered.start : rows.covered.stop, columns.covered.start : columns.covered.stop]
            np.copyto(part, _as_kind(values, band.kind), where=present)
        return canvas

    def _values(
        self, source: Source, columns: _Side, rows: _Side, reduction: "Resampling | None"
    ) -> tuple[Values, NDArray[np.bool_]]:
        """Read the values of the covered part of a source, and where pixels are there.

        Args:
            source: the source.
            columns: what is shown of its width.
            rows: what is shown of its height.
            reduction: resampling of a window that is reduced; None for that of the source.

        Returns:
            Values `(h, w)`, and where they are there, `(h, w)`.
        """
        from rasterio.enums import Resampling
        from rasterio.windows import Window

        resampling = reduction or Resampling[source.resampling]
        if source.discrete:
            resampling = Resampling.nearest  # the average of two numbers of a table of colours is another colour
        options: WindowOptions = {
            "window": Window(columns.start, rows.start, columns.length, rows.length),
            "out_shape": (len(rows.inner), len(columns.inner)),
            "resampling": resampling,
        }
        file = self._open(source.path)
        read = file.read_masks if source.of_mask else file.read
        stored = read(source.band, **options)  # (h, w), of the inner pixels alone
        present = _presence(source, file, stored, options)
        values = _converted(source, file, stored)
        borders = rows.border, columns.border
        if borders != ((0, 0), (0, 0)):
            # What lies at the edge of the source shows what is beside it.
            values = np.pad(values, borders, "edge")
            present = np.pad(present, borders, "edge")
        return values, present


def _presence(source: Source, file: Dataset, stored: Values, options: WindowOptions) -> NDArray[np.bool_]:
    """Find where the pixels of a source are there, `(h, w)`."""
    if source.masked:
        return np.asarray(file.read_masks(source.band, **options) > 0)
    if source.nodata is None:
        return np.ones(stored.shape, np.bool_)
    # NaN equals no number, itself included.
    present = ~np.isnan(stored) if np.isnan(source.nodata) else stored != source.nodata
    return np.asarray(present)


def _converted(source: Source, file: Dataset, values: Values) -> Values:
    """Convert the values of a source's file to those of the mosaic: by a table of colours, a curve, and a scale."""
    if source.component:
        colours = file.colormap(source.band)
        component = [colours.get(number, (0, 0, 0, 255))[source.component - 1] for number in range(256)]
        values = np.array(component)[values.astype(np.uint8)]  # numbers of a table are bytes
    if source.table:
        stored, shown = zip(*source.table, strict=True)
        values = np.interp(values, stored, shown)
    if (source.ratio, source.offset) != (1.0, 0.0):
        values = values * source.ratio + source.offset
    return values


def _empty_canvas(band: Band, shape: tuple[int, ...]) -> Values:
    """Make the canvas of a band that no source covers."""
    background = 0 if band.nodata is None else _as_kind(np.array(band.nodata), band.kind)
    return np.full(shape, background, band.kind)


def open_raster(path: str | PathLike[str]) -> Mosaic | Dataset:
    """Open a mosaic, or a raster by the driver of its name, inside `raster_settings`."""
    path = Path(path)
    kind = path.suffix.lower()
    return Mosaic(path) if kind == ".vrt" else open_file(path, _DRIVERS[kind])


def _open_source(file: Path) -> Dataset:
    """Open the file of a source by the driver of its content."""
    driver = driver_of(file)
    if driver is None:
        raise DataError(f"{file}: expected a TIFF, JPEG 2000, PNG or JPEG file, got another")
    return open_file(file, driver)


def _touching(places: NDArray[np.float64], box: tuple[float, float, float, float]) -> NDArray[np.intp]:
    """List the numbers of the places that meet a window."""
    x1, y1, x2, y2 = box
    left, top, right, bottom = places.T
    meets_columns = (left < x2) & (right > x1)
    meets_rows = (top < y2) & (bottom > y1)
    return np.flatnonzero(meets_columns & meets_rows)


def _as_kind(values: Values, kind: str) -> Values:
    """Convert values to another type, rounded and limited to its range as GDAL does."""
    if values.dtype == kind:
        return values
    if np.dtype(kind).kind not in "ui":
        return values.astype(kind)
    limits = np.iinfo(kind)
    rounded = np.floor(values + 0.5) if values.dtype.kind == "f" else values
    return np.nan_to_num(rounded).clip(limits.min, limits.max).astype(kind)
