"""Pictures in files that GDAL reads, by windows: cloud-optimised GeoTIFFs, mosaics of files (`.vrt`), JPEG 2000."""

import weakref
from collections.abc import Sequence
from functools import cached_property
from os import PathLike
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.gdal import open_raster, raster_settings
from semfov.data.images import opening
from semfov.data.reduction import FIRST, PixelBox, bytes_of
from semfov.data.tone import White, bytes_between
from semfov.data.windowed import LargePicture, chosen_bands, tone_of
from semfov.errors import DataError


class RasterPicture(LargePicture):
    """A raster, whose coarse windows are read from the overviews of the file, if it has some.

    Bands that the file calls red, green and blue are the channels, else the first three, or a single one as grey. One
    of neither 8 nor 16 bits needs `white`. Transparent and masked pixels are blended with white.
    """

    path: Path

    def __init__(
        self, path: str | PathLike[str], *, white: White | None = None, bands: int | Sequence[int] | None = None
    ) -> None:
        try:
            self._settings = raster_settings()
        except ImportError:
            raise DataError(f'{path}: expected rasterio for reading it; pip install "semfov[geo]"') from None
        self.path, self._lock = Path(path), Lock()  # GDAL's datasets are for one thread at a time
        with opening(self.path, "opened"), self._settings:
            self._file: Any = open_raster(self.path)
        weakref.finalize(self, self._file.close)
        meanings = [each.name for each in self._file.colorinterp]
        kinds = {*self._file.dtypes}
        if "palette" in meanings:
            raise DataError(f"{path}: expected grey, RGB or bands, got a palette; convert it (gdal_translate)")
        if not kinds <= {"uint8", "uint16"} and (white is None or any("complex" in kind for kind in kinds)):
            got = f"{', '.join(sorted(kinds))}; give white='auto', or the values that are black and white"
            raise DataError(f"{path}: expected bands of 8 or 16 bits, got {got}")
        named = tuple(meanings.index(name) + 1 for name in ("red", "green", "blue") if name in meanings)
        usual = named if len(named) == 3 else None
        self._bands = chosen_bands(self._file.count, bands, usual, self.path, alpha="alpha" in meanings)
        self.size = self._file.width, self._file.height
        self._has_overviews = bool(self._file.overviews(self._bands[0]))
        flags = {each.name for each in self._file.mask_flag_enums[self._bands[0] - 1]}
        self._masked = "per_dataset" in flags
        nodata = self._file.nodatavals[self._bands[0] - 1]
        self._tone = tone_of(
            self, white, lambda box: self._values(box, 1), nodata=nodata, wide="uint16" in kinds
        )  # fmt: skip
        if self._masked:
            self.nothing = 255, 255, 255
        elif nodata is not None:
            grey = int(bytes_between(np.full((1,), nodata, self._file.dtypes[self._bands[0] - 1]), self._tone)[0])
            self.nothing = grey, grey, grey

    @cached_property
    def _first(self) -> int:
        return FIRST if self._has_overviews else super()._first

    def pixels(self, box: PixelBox) -> NDArray[np.uint8]:
        return self._window(box, 1)

    def read(self, box: PixelBox, reduction: int = 1) -> Tensor:
        """Read a window; coarse ones from the overviews of the file, else as in other large pictures."""
        if reduction < FIRST or not self._has_overviews:
            return super().read(box, reduction)
        x1, y1, x2, y2 = self._inside(box)
        right, bottom = (min(-(-n // reduction) * reduction, m) for n, m in zip((x2, y2), self.size, strict=True))
        outwards = x1 // reduction * reduction, y1 // reduction * reduction, right, bottom
        return bytes_of(self._window(outwards, reduction))

    def _window(self, box: PixelBox, reduction: int) -> NDArray[np.uint8]:
        pixels = bytes_between(self._values(box, reduction), self._tone)
        if self._masked:
            share = self._values(box, reduction, mask=True).astype(np.uint16)
            pixels = ((pixels * share + 127) // 255 + (255 - share)).clip(max=255).astype(np.uint8)
        return np.repeat(pixels, 3, -1) if len(self._bands) == 1 else pixels

    def _values(self, box: PixelBox, reduction: int, *, mask: bool = False) -> NDArray[Any]:
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
