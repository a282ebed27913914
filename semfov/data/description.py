"""Description of the values in a picture's file, the same for all libraries that read it.

    tifffile's page, or GDAL's dataset ──► Description ──► bands that are shown
                                                      └──► Display ──► bytes of pixels, over white

`semfov.data.tiff` and `semfov.data.rasters` each fill in a `Description`. Which bands are shown, which values are black
and white, and how what is transparent lies on white paper is decided here, for both.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semfov.data.images import warn_of_range
from semfov.data.tone import Values, White, black_and_white, bytes_between, stated_limits
from semfov.data.windowed import Box, ChosenBands
from semfov.errors import check

_SAMPLES = 5  # windows in a row, and in a column, in which the values of a picture are looked at
_SAMPLE_SIDE = 64  # pixels


@dataclass(frozen=True)
class Description:
    """Description of the values in a file that is read by windows.

    Attributes:
        path: the file.
        size: `(width, height)` in pixels.
        count: number of bands, an alpha among them.
        colours: numbers of the bands of red, green and blue, from 1; None where the file does not name them.
        alpha: number of the band that is an alpha; None without one.
        premultiplied: whether colours are multiplied by the alpha already.
        white_is_zero: whether 0 is white.
        bits: of a value without a sign, as the file states them: 8, 16, or a number between, such as 12; None for
            numbers of other kinds.
    """

    path: Path
    size: tuple[int, int]
    count: int
    colours: tuple[int, ...] | None
    alpha: int | None
    premultiplied: bool
    white_is_zero: bool
    bits: int | None

    def shown_bands(self, bands: ChosenBands) -> list[int]:
        """Choose the bands that are shown, with a warning where nothing tells which.

        Args:
            bands: the bands that a user chooses; None for those that the file names.

        Returns:
            One number, for grey, or three, from 1.

        Raises:
            InputError: the file has no such band.
        """
        if bands is not None:
            numbers = [bands] if isinstance(bands, int) else [*bands]
            check(max(numbers) <= self.count, "bands", f"numbers from 1 to {self.count} for {self.path}", bands)
            return numbers
        if self.colours is not None:
            return [*self.colours]
        without_alpha = self.count - (self.alpha is not None)
        numbers = [1]
        words = "1 is shown as grey"
        if without_alpha >= 3:
            numbers = [1, 2, 3]
            words = "1, 2 and 3 are shown as red, green and blue"
        # One band is grey and three are colours; of other numbers nobody knows.
        if without_alpha not in (1, 3):
            text = f"image {self.path}: of {self.count} bands without names {words}; choose by bands="
            warnings.warn(text, stacklevel=2)
        return numbers

    def display(self, white: White | None, read: Callable[[Box], Values], nodata: float | None) -> "Display":
        """Choose how values are shown, with a warning where a picture of 16 bits uses few of them.

        Args:
            white: as for `semfov.read_image`.
            read: reads the values of the colours in a window, `(h, w, C)`.
            nodata: the value of pixels without data, which percentiles leave out.

        Returns:
            How values become bytes.
        """
        return Display(self._limits(white, read, nodata), self.white_is_zero, self.premultiplied)

    def _limits(
        self, white: White | None, read: Callable[[Box], Values], nodata: float | None
    ) -> tuple[float, float] | None:
        """Choose the values that are black and white; None for those of 8 or 16 bits."""
        if isinstance(white, str):
            values = np.concatenate([read(box).ravel() for box in self._sample_boxes()])
            return black_and_white(white, values, nodata)
        if white is not None:
            return stated_limits(white)
        if self.bits in (None, 8):
            return None
        largest = 2**self.bits - 1
        if self.bits > 8:
            self._warn_of_range(read, largest)
        return None if self.bits == 16 else (0.0, float(largest))

    def _warn_of_range(self, read: Callable[[Box], Values], largest: int) -> None:
        """Warn of values that take little of the range up to the `largest`."""
        samples = []
        # What cannot be decoded is refused where it is read.
        with suppress(Exception):
            samples = [read(box) for box in self._sample_boxes()]
        if samples:
            least = min(float(sample.min()) for sample in samples)
            most = max(float(sample.max()) for sample in samples)
            warn_of_range(least, most, self.path, largest)

    def _sample_boxes(self) -> list[Box]:
        """Find windows that are spread evenly over the picture."""
        width, height = self.size
        boxes = []
        for row, column in product(range(_SAMPLES), repeat=2):
            # In the middle of a cell, of which `_SAMPLES` fill a side.
            left = width * (1 + 2 * column) // (2 * _SAMPLES)
            top = height * (1 + 2 * row) // (2 * _SAMPLES)
            boxes.append((left, top, min(left + _SAMPLE_SIDE, width), min(top + _SAMPLE_SIDE, height)))
        return boxes


@dataclass(frozen=True)
class Display:
    """Rule that converts the values of a file to bytes for display.

    Attributes:
        limits: the values that are black and white; None for those of 8 or 16 bits.
        white_is_zero: whether 0 is white.
        premultiplied: whether colours are multiplied by their alpha already.
    """

    limits: tuple[float, float] | None
    white_is_zero: bool
    premultiplied: bool

    def colours(self, values: Values) -> NDArray[np.uint8]:
        """Convert the values of colours, of any shape, to bytes."""
        pixels = bytes_between(values, self.limits)
        return 255 - pixels if self.white_is_zero else pixels

    def over_white(self, colours: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Blend colours `(h, w, C)` with white paper where their alpha `(h, w, 1)` is below 255."""
        # In 16 bits, as the product of two bytes needs them; 127 rounds.
        opacity = alpha.astype(np.uint16)
        shown = colours if self.premultiplied else (colours * opacity + 127) // 255
        return np.minimum(shown + (255 - opacity), 255).astype(np.uint8)


def named_colours(numbers: Mapping[str, int]) -> tuple[int, ...] | None:
    """Find the bands of red, green and blue by the names of bands; None unless a file names all three."""
    colours: Sequence[str] = ("red", "green", "blue")
    if not all(name in numbers for name in colours):
        return None
    return tuple(numbers[name] for name in colours)


def as_rgb(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Repeat the one channel of grey pixels `(h, w, 1)`; colours stay as they are."""
    return np.repeat(pixels, 3, -1) if pixels.shape[-1] == 1 else pixels
