"""Pictures that are read window by window: their base, and what their files have in common.

    picture ── strip by strip ──► largest copy ── halved ──► copy ── halved ──► …

A window that is resampled to far fewer pixels is read from a copy of the picture, reduced by a power of two. Copies are
in memory and made when they are first needed; where the file has reduced copies itself (overviews), these are read. In
a very large picture the largest copy is a coarse one, and finer windows are reduced strip by strip as they are read.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F
from torch.utils.dlpack import from_dlpack

from semfov.errors import check

Box = tuple[int, int, int, int]
"""A window: the pixels from `(x1, y1)` to before `(x2, y2)`."""

_STRIP = 1 << 23  # pixels that are read at once for a copy
_PIECE = 1 << 11  # columns of a strip of which it is asked whether they are stored

_FIRST = 4
"""Least factor by which a copy is reduced. All copies together take a twelfth of the memory of the picture."""

_LARGEST = 1 << 25  # most pixels of a copy, so that all copies together take at most 134 MB
_OVERSAMPLING = 1.5  # pixels that a reduced window keeps for each wanted pixel, so that antialiasing still works


def reduction_for(ratio: float, oversampling: float = _OVERSAMPLING) -> int:
    """Find the largest power of two by which a window may be reduced that is resampled afterwards.

    Args:
        ratio: pixels of the picture for one of the result, along a side.
        oversampling: pixels that the reduced window keeps for one of the result.

    Returns:
        The factor, at least 1.

    >>> reduction_for(2.9), reduction_for(3.0), reduction_for(6.0)
    (1, 2, 4)
    """
    reduction = 1
    while ratio >= 2 * oversampling * reduction:
        reduction *= 2
    return reduction


def resized(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Resample pixels with the antialiased bilinear filter.

    Args:
        pixels: bytes `(3, h, w)`.
        size: `(height, width)` of the result.

    Returns:
        Bytes `(1, 3, height, width)`.
    """
    height, width = pixels.shape[1:]
    # torch takes twice as long where the rows of a window are not adjacent in memory.
    canvas = pixels.permute(1, 2, 0).contiguous()
    if height > size[0]:
        canvas = _shortened(canvas, size[0])
    canvas = canvas.reshape(1, -1, width, 3).permute(0, 3, 1, 2)
    return canvas if canvas.shape[-2:] == size else F.interpolate(canvas, size, mode="bilinear", antialias=True)


def _shortened(canvas: Tensor, height: int) -> Tensor:
    """Resample the columns of bytes `(h, w, 3)` to a height, with the layout of `(height, w, 3)` in memory.

    torch shortens rows first. Columns first takes half of the time: that step is the faster one, and still faster if
    four bytes are a pixel.
    """
    channels = 3 if canvas.shape[1] % 4 else 4
    lines = canvas.view(1, len(canvas), -1, channels).permute(0, 3, 1, 2)
    shortened = F.interpolate(lines, (height, lines.shape[-1]), mode="bilinear", antialias=True)
    return shortened.permute(0, 2, 3, 1)


def _bytes_of(pixels: NDArray[np.uint8]) -> Tensor:
    """View bytes `(h, w, 3)` as `(3, h, w)`, without a copy where memory may be shared; not to be written to."""
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


def has_windows(path: str | PathLike[str]) -> bool:
    """Tell by its name whether a file is a TIFF or a raster, which are read by windows and have bands."""
    return Path(path).suffix.lower() in BY_WINDOWS


def check_no_bands(bands: ChosenBands) -> None:
    """Raise `InputError` for bands of a picture that is neither a TIFF nor a raster."""
    expected = "None but for TIFFs and rasters (choose the channels of an array yourself, array[..., [3, 2, 1]])"
    check(bands is None, "bands", expected, bands)


def check_bands(bands: ChosenBands) -> None:
    """Raise `InputError` unless the values are valid numbers of bands."""
    if bands is None:
        return
    numbers = [*bands] if isinstance(bands, tuple | list) else [bands]
    are_numbers = all(type(number) is int and number >= 1 for number in numbers)
    expected = "the number of a band, or three for red, green and blue, from 1"
    check(len(numbers) in (1, 3) and are_numbers, "bands", expected, bands)


def _strips(box: Box, reduction: int) -> list[Box]:
    """Cut a window of a reduced picture into strips whose pixels in the picture fit into memory at once."""
    x1, y1, x2, y2 = box
    rows = max(1, _STRIP // ((x2 - x1) * reduction) // reduction)
    return [(x1, top, x2, min(top + rows, y2)) for top in range(y1, y2, rows)]


class LargePicture(ABC):
    """Base of 8-bit pictures that are read window by window.

    Attributes:
        size: `(width, height)` in pixels.
        path: the file; None for a picture in memory.
        shown: `white` and `bands` with which the file was opened; None for neither.
        nothing: the colour in which pixels without data are shown; None where there are none, or nothing tells them.

    Private attributes: `_has_overviews` tells whether coarse windows are read from reduced copies in the file.
    `_copies` has the copies in memory that were made so far, by their reduction: that by `_of_largest_copy`, the
    largest, is made of the picture, and each other one of the copy that is twice as large.

    Invariant: the copy by r has `max(1, width // r)` × `max(1, height // r)` pixels, and once it is there, so are all
    larger ones. What the picture shows does not change while it is open, so that no copy is made twice.
    """

    size: tuple[int, int]
    path: Path | None = None
    shown: Mapping[str, Any] | None = None
    _has_overviews = False
    nothing: tuple[int, int, int] | None = None

    @abstractmethod
    def pixels(self, box: Box) -> NDArray[np.uint8]:
        """Read a window, in one thread at a time but not always the same one (`zoom.episode`).

        Args:
            box: a window inside the picture.

        Returns:
            `(h, w, 3)`.
        """

    def holds(self, box: Box) -> bool:
        """Tell whether anything of a window is stored: one colour is shown where nothing is."""
        return True

    def reduction(self, ratio: float, oversampling: float = _OVERSAMPLING) -> int:
        """Choose the factor by which windows are read that are resampled afterwards.

        Args:
            ratio: pixels of the picture for one of the result, along a side.
            oversampling: pixels that the reduced window keeps for one of the result.

        Returns:
            The factor, of which the edges of the windows are to be multiples.
        """
        reduction = reduction_for(ratio, oversampling) if self._is_large else 1
        return reduction if reduction >= _FIRST else 1

    def read(self, box: Box, reduction: int = 1) -> Tensor:
        """Read a window; coarse ones of large pictures are read from reduced copies.

        Args:
            box: a window inside the picture.
            reduction: factor by which the window is reduced if the picture has such a copy (`reduction`).

        Returns:
            Bytes `(3, h, w)`, which are not to be written to.

        Raises:
            InputError: the window reaches beyond the picture.
        """
        x1, y1, x2, y2 = box
        width, height = self.size
        inside = 0 <= x1 < x2 <= width and 0 <= y1 < y2 <= height
        check(inside, "box", f"a window inside {width} × {height} pixels", box)
        has_copies = self._has_overviews or self._is_large
        if has_copies and reduction >= _FIRST:
            return self._reduced(box, reduction)
        return _bytes_of(self._checked_pixels(box))

    def _checked_pixels(self, box: Box) -> NDArray[np.uint8]:
        """Read the pixels of a window; raises `InputError` where a reader gives others."""
        x1, y1, x2, y2 = box
        pixels = self.pixels(box)
        shape = y2 - y1, x2 - x1, 3
        is_window = pixels.dtype == np.uint8 and pixels.shape == shape
        check(is_window, "pixels", f"bytes of shape {shape}", f"{pixels.dtype} of {pixels.shape}")
        return pixels

    @property
    def _is_large(self) -> bool:
        return self.size[0] * self.size[1] > _LARGE

    @cached_property
    def _of_largest_copy(self) -> int:
        """Reduction of the largest copy, which has at most `_LARGEST` pixels."""
        reduction = _FIRST
        while self.size[0] * self.size[1] > _LARGEST * reduction**2:
            reduction *= 2
        return reduction

    def _reduced(self, box: Box, reduction: int) -> Tensor:
        """Cut a window out of a copy, or reduce it as it is read, `(3, h, w)`."""
        x1, y1, x2, y2 = box
        width, height = self._size_reduced(reduction)
        # The copy lacks what is left of the picture's sides, so that windows at its end have its last pixel.
        left = min(x1 // reduction, width - 1)
        top = min(y1 // reduction, height - 1)
        right = max(-(-x2 // reduction), left + 1)
        bottom = max(-(-y2 // reduction), top + 1)
        if reduction < self._of_largest_copy:
            return self._reduced_in_strips((left, top, min(right, width), min(bottom, height)), reduction)
        return self._copy(reduction)[:, top:bottom, left:right]

    @cached_property
    def _copies(self) -> dict[int, Tensor]:
        """Copies `(3, h, w)` by their reduction, channels last in memory."""
        return {}

    def _copy(self, reduction: int) -> Tensor:
        """Find or make a copy, without the rest of sides that are no multiples of the reduction."""
        if reduction in self._copies:
            return self._copies[reduction]
        if reduction == self._of_largest_copy:
            copy = self._reduced_in_strips((0, 0, *self._size_reduced(reduction)), reduction)
        else:
            larger = self._copy(reduction // 2)
            height, width = (max(1, length // 2) for length in larger.shape[1:])
            copy = resized(larger[:, : 2 * height, : 2 * width], (height, width))[0]
        self._copies[reduction] = copy
        return copy

    def _reduced_in_strips(self, box: Box, reduction: int) -> Tensor:
        """Read and reduce a window, `(3, h, w)`, strip by strip; what is not stored is not read.

        Args:
            box: the window in pixels of the reduced picture.
            reduction: the factor.

        Returns:
            Bytes, channels last in memory.
        """
        x1, y1, x2, y2 = box
        window = torch.empty(y2 - y1, x2 - x1, 3, dtype=torch.uint8)
        for block, stored in self._blocks(box, reduction):
            left, top, right, bottom = block
            # One pixel is the colour of all that is not stored.
            shown = block if stored else (left, top, left + 1, top + 1)
            window[top - y1 : bottom - y1, left - x1 : right - x1] = self._part(shown, reduction)
        return window.permute(2, 0, 1)

    def _blocks(self, box: Box, reduction: int) -> Iterator[tuple[Box, bool]]:
        """Divide a window of the reduced picture into blocks that fit into memory, and tell which of them are stored.

        Strips of which the same columns are stored are taken together: where these are few, more rows fit.
        """
        for runs, strips in groupby(_strips(box, reduction), lambda strip: self._runs(strip, reduction)):
            alike = [*strips]
            top = alike[0][1]
            bottom = alike[-1][3]
            for left, right, stored in runs:
                block = left, top, right, bottom
                for part in _strips(block, reduction) if stored else [block]:
                    yield part, stored

    def _size_reduced(self, reduction: int) -> tuple[int, int]:
        """`(width, height)` of the picture when it is reduced, without the rest of sides that are no multiples."""
        width, height = self.size
        return max(1, width // reduction), max(1, height // reduction)

    def _runs(self, box: Box, reduction: int) -> list[tuple[int, int, bool]]:
        """Find runs of columns of a strip of the reduced picture, `(left, right, stored)`, by whether they are."""
        x1, top, x2, bottom = box
        if not self.holds(self._around(box, reduction)):
            return [(x1, x2, False)]
        step = max(1, _PIECE // reduction)
        pieces = []
        for left in range(x1, x2, step):
            right = min(left + step, x2)
            stored = self.holds(self._around((left, top, right, bottom), reduction))
            pieces.append((left, right, stored))
        runs = []
        for stored, run in groupby(pieces, itemgetter(2)):
            columns = list(run)
            runs.append((columns[0][0], columns[-1][1], stored))
        return runs

    def _with_border(self, box: Box, reduction: int) -> Box:
        """Widen a part of the reduced picture by what the filter reaches, less than one pixel at each side."""
        x1, y1, x2, y2 = box
        width, height = self._size_reduced(reduction)
        return max(x1 - 1, 0), max(y1 - 1, 0), min(x2 + 1, width), min(y2 + 1, height)

    def _around(self, box: Box, reduction: int) -> Box:
        """Find the window of the picture of which a part of the reduced picture is made."""
        left, top, right, bottom = (side * reduction for side in self._with_border(box, reduction))
        width, height = self.size
        return left, top, min(right, width), min(bottom, height)

    def _part(self, box: Box, reduction: int) -> Tensor:
        """Make a part of the reduced picture, `(h, w, 3)`."""
        x1, y1, x2, y2 = box
        left, top, right, bottom = self._with_border(box, reduction)
        pixels = _bytes_of(self._checked_pixels(self._around(box, reduction)))
        with_border = resized(pixels, (bottom - top, right - left))[0]
        part = with_border[:, y1 - top : y2 - top, x1 - left : x2 - left]
        return part.permute(1, 2, 0)
