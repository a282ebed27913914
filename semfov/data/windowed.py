"""Pictures that are read window by window: their base, and what their files have in common."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.images import warn_of_range
from semfov.data.reduction import OVERSAMPLING, PixelBox, ReducedCopies, bytes_of, first_for, reduction_for
from semfov.data.tone import White, black_and_white, sample_windows
from semfov.errors import check

RASTERS = (".vrt", ".jp2")
"""Ends of the names of files that only GDAL reads by windows; TIFFs can also be read without it."""

ChosenBands = int | Sequence[int] | None
"""The number of a band of a TIFF or a raster, or three for red, green and blue, from 1; None for those of the file."""

TILED = (".tif", ".tiff")
BY_WINDOWS = (*TILED, *RASTERS)
"""Ends of the names of files that may be read by windows, and whose bands can be chosen."""

_LARGE = 1 << 24
"""Pictures with more pixels have copies."""


class LargePicture(ABC):
    """Base of 8-bit pictures that are read window by window; size `(width, height)`."""

    size: tuple[int, int]
    path: Path | None = None
    shown: Mapping[str, Any] | None = None  # `white` and `bands` with which the file was opened; None for neither
    nothing: tuple[int, int, int] | None = None  # the colour in which pixels without data are shown, if a file has some

    @abstractmethod
    def pixels(self, box: PixelBox) -> NDArray[np.uint8]:
        """Read a window; → `(h, w, 3)`."""

    def reduction(self, ratio: float, oversampling: float = OVERSAMPLING) -> int:
        """Factor by which windows are read that are resampled afterwards; their edges are to be multiples of it."""
        many = self.size[0] * self.size[1] > _LARGE
        reduction = reduction_for(ratio, oversampling) if many else 1
        return reduction if reduction >= self._first else 1

    def read(self, box: PixelBox, reduction: int = 1) -> Tensor:
        """Read a window; coarse windows of pictures of more than 16 million pixels are read from reduced copies.

        The copies are made strip by strip, when one is first needed. So no more than a strip of 8 million pixels (25
        MB) is in memory at full resolution. They are kept, and take a twelfth of the memory of the whole picture, and
        at most 134 MB: copies of pictures of more than 537 million pixels begin at a coarser one.

        Shapes: → `(3, h, w)`.
        """
        self._inside(box)
        if reduction < self._first or self.size[0] * self.size[1] <= _LARGE:
            return bytes_of(self.pixels(box))
        return self._copies.window(box, reduction)

    def _inside(self, box: PixelBox) -> PixelBox:
        """The box; raises `InputError` where it is empty or not inside the picture."""
        x1, y1, x2, y2 = box
        width, height = self.size
        inside = 0 <= x1 < x2 <= width and 0 <= y1 < y2 <= height
        check(inside, "box", f"a window inside {width} × {height} pixels", box)
        return box

    @cached_property
    def _first(self) -> int:
        """Least factor by which windows are read reduced."""
        return first_for(self.size)

    @cached_property
    def _copies(self) -> ReducedCopies:
        return ReducedCopies(self.size, self.pixels)


def chosen_bands(
    count: int, bands: ChosenBands, usual: tuple[int, ...] | None, path: Path, *, alpha: bool = False
) -> list[int]:
    """The bands that are shown, one or three, from 1; `usual` has those that a file with `count` bands names."""
    if bands is not None:
        numbers = [*bands] if isinstance(bands, tuple | list) else [cast(int, bands)]
        check(max(numbers) <= count, "bands", f"numbers from 1 to {count} for {path}", bands)
        return numbers
    if usual is not None:
        return [*usual]
    colours = count - alpha
    shown = [1, 2, 3] if colours >= 3 else [1]
    if colours not in (1, 3):
        words = "1 is shown as grey" if len(shown) == 1 else "1, 2 and 3 are shown as red, green and blue"
        warnings.warn(f"image {path}: of {count} bands without names {words}; choose by bands=", stacklevel=2)
    return shown


def tone_of(
    picture: LargePicture,
    white: White | None,
    values: Callable[[PixelBox], NDArray[Any]],
    *,
    nodata: float | None,
    wide: bool,
) -> tuple[float, float] | None:
    """The values that are black and white in a file; None by its type, with a warning where few of 16 bits are used."""
    if white is None and not wide:
        return None
    assert picture.path is not None
    if white is not None and not isinstance(white, str):
        return black_and_white(white, np.zeros(0))
    seen = []
    # What cannot be decoded is refused where it is read.
    with nullcontext() if white else suppress(Exception):
        seen = [values(box).ravel() for box in sample_windows(picture.size)]
    if white is not None:
        return black_and_white(white, np.concatenate(seen), nodata)
    if seen:
        warn_of_range(float(min(each.min() for each in seen)), float(max(each.max() for each in seen)), picture.path)
    return None
