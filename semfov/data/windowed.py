"""Pictures that are read window by window: their base, and what their files have in common."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F
from torch.utils.dlpack import from_dlpack

from semfov.errors import check

_Box = tuple[int, int, int, int]

_STRIP = 1 << 23  # pixels that are read at once for a copy
_PIECE = 1 << 11  # columns of a strip of which it is asked whether they are stored

_FIRST = 4
"""Least factor by which a copy is reduced. All copies together take a twelfth of the memory of the picture."""

_LARGEST = 1 << 25  # most pixels of a copy, so that all copies together take at most 134 MB
_OVERSAMPLING = 1.5  # pixels that a reduced window keeps for each wanted pixel, so that antialiasing still works


def reduction_for(ratio: float, oversampling: float = _OVERSAMPLING) -> int:
    """Largest factor by which a window may be reduced that is resampled afterwards."""
    reduction = 1
    while ratio >= 2 * oversampling * reduction:
        reduction *= 2
    return reduction


def resized(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Bytes `(3, h, w)` resampled to a size `(h', w')` with the antialiased bilinear filter, `(1, 3, h', w')`."""
    height, width = pixels.shape[1:]
    # torch takes twice as long where the rows of a window are not adjacent in memory.
    canvas = pixels.permute(1, 2, 0).contiguous()
    if height > size[0]:
        # torch shortens rows first. Columns first takes half of the time: that step is the faster one, and still faster
        # if four bytes are a pixel.
        lines = canvas.view(1, height, -1, 3 if width % 4 else 4).permute(0, 3, 1, 2)
        canvas = F.interpolate(lines, (size[0], lines.shape[-1]), mode="bilinear", antialias=True).permute(0, 2, 3, 1)
    canvas = canvas.reshape(1, -1, width, 3).permute(0, 3, 1, 2)
    return canvas if canvas.shape[-2:] == size else F.interpolate(canvas, size, mode="bilinear", antialias=True)


def _bytes_of(pixels: NDArray[np.uint8]) -> Tensor:
    """Bytes `(h, w, 3)` as `(3, h, w)`, without a copy where memory may be shared; they are not to be written to."""
    try:
        # Other than `from_numpy`, it takes arrays that may not be written to.
        shared = from_dlpack(pixels if min(pixels.strides) >= 0 else pixels.copy())
    except BufferError:  # NumPy 1 lends only what may be written to
        shared = torch.from_numpy(pixels.copy())
    return shared.permute(2, 0, 1)


RASTERS = (".vrt", ".jp2")
"""Ends of the names of files that only GDAL reads by windows; TIFFs can also be read without it."""

ChosenBands = int | Sequence[int] | None
"""The number of a band of a TIFF or a raster, or three for red, green and blue, from 1; None for those of the file."""

BY_WINDOWS = (".tif", ".tiff", *RASTERS)
"""Ends of the names of files that may be read by windows, and whose bands can be chosen."""

_LARGE = 1 << 24  # pictures with more pixels have copies


class LargePicture(ABC):
    """Base of 8-bit pictures that are read window by window; size `(width, height)`."""

    size: tuple[int, int]
    path: Path | None = None
    shown: Mapping[str, Any] | None = None  # `white` and `bands` with which the file was opened; None for neither
    _has_overviews = False  # whether coarse windows are read from reduced copies in the file
    nothing: tuple[int, int, int] | None = None  # the colour in which pixels without data are shown, if a file has some

    @abstractmethod
    def pixels(self, box: _Box) -> NDArray[np.uint8]:
        """Read a window, in one thread at a time but not always the same one (`zoom.episode`); → `(h, w, 3)`."""

    def holds(self, box: _Box) -> bool:
        """Tell whether anything of a window is stored: one colour is shown where nothing is."""
        return True

    def reduction(self, ratio: float, oversampling: float = _OVERSAMPLING) -> int:
        """Factor by which windows are read that are resampled afterwards; their edges are to be multiples of it."""
        many = self.size[0] * self.size[1] > _LARGE
        reduction = reduction_for(ratio, oversampling) if many else 1
        return reduction if reduction >= self._first else 1

    def read(self, box: _Box, reduction: int = 1) -> Tensor:
        """Read a window, `(3, h, w)`; coarse ones of pictures of more than 16 million pixels from reduced copies."""
        (x1, y1, x2, y2), (width, height) = box, self.size
        inside = 0 <= x1 < x2 <= width and 0 <= y1 < y2 <= height
        check(inside, "box", f"a window inside {width} × {height} pixels", box)
        coarse = self._has_overviews or self.size[0] * self.size[1] > _LARGE
        return self._reduced(box, reduction) if coarse and reduction >= self._first else _bytes_of(self._given(box))

    def _given(self, box: _Box) -> NDArray[np.uint8]:
        """The pixels of a window; raises `InputError` where a reader gives others."""
        (x1, y1, x2, y2), pixels = box, self.pixels(box)
        fits = pixels.dtype == np.uint8 and pixels.shape == (y2 - y1, x2 - x1, 3)
        check(fits, "pixels", f"bytes of shape {(y2 - y1, x2 - x1, 3)}", f"{pixels.dtype} of {pixels.shape}")
        return pixels

    @cached_property
    def _first(self) -> int:
        """Least factor by which windows are read reduced, so that the largest copy has at most `_LARGEST` pixels."""
        first = _FIRST
        while not self._has_overviews and self.size[0] * self.size[1] > _LARGEST * first**2:
            first *= 2
        return first

    def _reduced(self, box: _Box, reduction: int) -> Tensor:
        """A window of a copy, `(3, h, w)`."""
        copy = self._copy(reduction)
        high, wide = copy.shape[1:]
        x1, y1, x2, y2 = box
        left, top = min(x1 // reduction, wide - 1), min(y1 // reduction, high - 1)
        return copy[:, top : max(-(-y2 // reduction), top + 1), left : max(-(-x2 // reduction), left + 1)]

    @cached_property
    def _copies(self) -> dict[int, Tensor]:
        """Copies `(3, h, w)` by their reduction, channels last in memory; each is made when it is first needed."""
        return {}

    def _copy(self, reduction: int) -> Tensor:
        """A copy, without what is left of sides that are no multiples of the reduction, less than one of its pixels."""
        if reduction not in self._copies:
            if reduction == self._first:
                self._copies[reduction] = self._largest()
            else:
                larger = self._copy(reduction // 2)
                high, wide = (max(1, length // 2) for length in larger.shape[1:])
                self._copies[reduction] = resized(larger[:, : 2 * high, : 2 * wide], (high, wide))[0]
        return self._copies[reduction]

    def _largest(self) -> Tensor:
        """The largest copy, made strip by strip; what is not stored is not read."""
        first = self._first
        wide, high = (max(1, length // first) for length in self.size)
        rows = max(1, _STRIP // self.size[0] // first)
        copy = torch.empty(high, wide, 3, dtype=torch.uint8)
        for top in range(0, high, rows):
            bottom = min(top + rows, high)
            for left, right, held in self._runs(top, bottom, wide, high):
                # One pixel is the colour of all that is not stored.
                end = (right, bottom) if held else (left + 1, top + 1)
                copy[top:bottom, left:right] = self._part((left, top, *end), (wide, high))
        return copy.permute(2, 0, 1)

    def _runs(self, top: int, bottom: int, wide: int, high: int) -> Iterator[tuple[int, int, bool]]:
        """First and end of the columns of a strip of the largest copy that are stored, and of those that are not."""
        step = max(1, _PIECE // self._first)
        lefts = range(0, wide, step)
        held = [self.holds(self._around((left, top, min(left + step, wide), bottom), (wide, high))) for left in lefts]
        for stored, run in groupby(zip(lefts, held, strict=True), lambda piece: piece[1]):
            pieces = [left for left, _ in run]
            yield pieces[0], min(pieces[-1] + step, wide), stored

    def _around(self, box: _Box, size: tuple[int, int]) -> _Box:
        """The window of a part of the largest copy, with what the filter reaches: less than one pixel of the copy."""
        (x1, y1, x2, y2), (wide, high), first = box, size, self._first
        right, bottom = min(x2 + 1, wide) * first, min(y2 + 1, high) * first
        return max(x1 - 1, 0) * first, max(y1 - 1, 0) * first, min(right, self.size[0]), min(bottom, self.size[1])

    def _part(self, box: _Box, size: tuple[int, int]) -> Tensor:
        """A part of the largest copy, `(h, w, 3)`."""
        (x1, y1, x2, y2), (wide, high) = box, size
        left, top, right, bottom = max(x1 - 1, 0), max(y1 - 1, 0), min(x2 + 1, wide), min(y2 + 1, high)
        pixels = _bytes_of(self._given(self._around(box, size)))
        part = resized(pixels, (bottom - top, right - left))[0, :, y1 - top : y2 - top, x1 - left : x2 - left]
        return part.permute(1, 2, 0)
