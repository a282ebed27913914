"""Decoded pictures, which are converted to pixels a few rows at a time to save memory."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semfov.data.tone import ROWS_AT_ONCE, Values, White, between, black_and_white


@dataclass(frozen=True)
class Decoded:
    """A decoded picture.

    Attributes:
        shape: `(H, W)`.
        rows: makes the values of some rows, `(h, W, C)`; of one channel, or of two with an alpha, they are grey.
        most: the value that is white, of the channels where nothing else is said, and of an alpha.
        has_alpha: whether the last channel is an alpha.
        transparent: the values of a pixel that is transparent; None for none.
        white_is_zero: whether 0 is white.
    """

    shape: tuple[int, int]
    rows: Callable[[slice], Values]
    most: float
    has_alpha: bool = False
    transparent: object = None
    white_is_zero: bool = False

    def extremes(self) -> tuple[float, float]:
        """Find the least and the greatest value of the colours, without an alpha; NaN where there is one."""
        least = np.inf
        greatest = -np.inf
        for rows in self._parts():
            shades = self._shades(self.rows(rows))
            least = np.minimum(least, shades.min())
            greatest = np.maximum(greatest, shades.max())
        return float(least), float(greatest)

    def floats(self, white: White | None) -> NDArray[np.float32]:
        """Make pixels `(3, H, W)` in [0, 1]; `white` is as for `semfov.read_image`."""
        pixels = np.empty((3, *self.shape), np.float32)
        limits = self._limits(white)
        for rows in self._parts():
            pixels[:, rows] = np.moveaxis(self._shown(self.rows(rows), limits), -1, 0)
        return pixels

    def bytes(self, white: White | None) -> NDArray[np.uint8]:
        """Make bytes `(H, W, 3)`; `white` is as for `semfov.read_image`."""
        pixels = np.empty((*self.shape, 3), np.uint8)
        limits = self._limits(white)
        for rows in self._parts():
            values = self.rows(rows)
            pixels[rows] = values if self._are_bytes(values, limits) else np.rint(self._shown(values, limits) * 255)
        return pixels

    def _parts(self) -> list[slice]:
        """List the rows that are converted at once."""
        height = self.shape[0]
        return [slice(top, min(top + ROWS_AT_ONCE, height)) for top in range(0, height, ROWS_AT_ONCE)]

    def _shades(self, values: Values) -> Values:
        """Leave out an alpha."""
        return values[..., :-1] if self.has_alpha else values

    def _limits(self, white: White | None) -> tuple[float, float]:
        """Choose the values that are black and white."""
        if white is None:
            return self._full_range
        # Percentiles are those of all values.
        seen = slice(0, self.shape[0]) if isinstance(white, str) else slice(0, 1)
        return black_and_white(white, self._shades(self.rows(seen)))

    def _are_bytes(self, values: Values, limits: tuple[float, float]) -> bool:
        """Tell whether values are bytes, of which 0 is black and the largest one is white."""
        return values.dtype == np.uint8 and limits == self._full_range

    def _shown(self, values: Values, limits: tuple[float, float]) -> NDArray[np.float32]:
        """Convert values to [0, 1], over white, `(h, W, 3)` or `(h, W, 1)`."""
        pixels = self._over_white(self._scaled(values, limits), values)
        return 1 - pixels if self.white_is_zero else pixels

    def _scaled(self, values: Values, limits: tuple[float, float]) -> NDArray[np.float32]:
        """Scale the colours to [0, 1], without the alpha."""
        shades = self._shades(values)
        if self._are_bytes(values, limits):
            return np.divide(shades, np.float32(self.most), dtype=np.float32)  # takes a tenth of the time
        return between(shades, limits)

    def _over_white(self, pixels: NDArray[np.float32], values: Values) -> NDArray[np.float32]:
        """Blend pixels in [0, 1] with white by the alpha in their values, or where these are transparent."""
        if self.has_alpha:
            # Where black and white are stated, they are those of the colours, and not of the alpha.
            alpha = between(values[..., -1:], self._full_range)
            return pixels * alpha + (1 - alpha)
        if self.transparent is None:
            return pixels
        is_transparent = (values == np.array(self.transparent)).all(-1, keepdims=True)
        return np.where(is_transparent, np.float32(1), pixels)

    @property
    def _full_range(self) -> tuple[float, float]:
        """The values that are black and white where nothing is said, and of an alpha."""
        return 0.0, float(self.most)
