"""The values of a picture that are shown as black and as white, for thermal cameras, reflectances and 12 bits."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from semfov.errors import check
from semfov.io.schema import is_number

White = float | tuple[float, float] | Literal["auto"]
"""The value that is white where 0 is black, the values that are black and white, or `auto` for percentiles."""

_PERCENTILES = 1.0, 99.0  # of the values, which are black and white for `auto`
_ROWS = 64  # of a picture that are converted at once: more leave the cache of the processor


def check_white(white: White | None) -> None:
    """Raise `InputError` for what is no white."""
    if white is None or (isinstance(white, str) and white == "auto"):
        return
    pair: Sequence[Any] = white if isinstance(white, tuple | list) else (0.0, white)
    # Numbers of NumPy and of a tensor, such as the largest of a picture, are numbers, too.
    plain = [each.item() if getattr(each, "ndim", None) == 0 else each for each in pair]
    fits = len(plain) == 2 and all(is_number(each) and np.isfinite(each) for each in plain) and plain[0] < plain[1]
    check(fits, "white", "a value above 0, (black, white) with black < white, or 'auto'", white)


def black_and_white(white: White, values: NDArray[Any], nodata: float | None = None) -> tuple[float, float]:
    """The values that are shown as black and as white, by percentiles of some values of the picture for `auto`."""
    if not isinstance(white, str):
        pair = white if isinstance(white, tuple | list) else (0.0, white)
        return float(pair[0]), float(pair[1])
    there = values[np.isfinite(values) & (values != (np.nan if nodata is None else nodata))]
    if not there.size:
        return 0.0, 1.0
    low, high = (float(each) for each in np.percentile(there.astype(np.float64), _PERCENTILES))
    return low, high if high > low else low + 1.0


def between(values: NDArray[Any], tone: tuple[float, float]) -> NDArray[np.float32]:
    """Values from 0, black, to 1, white; NaN is black."""
    low, high = tone
    share = (values.astype(np.float64) - low) / (high - low)
    return np.nan_to_num(share, nan=0.0).clip(0, 1).astype(np.float32)


def bytes_between(values: NDArray[Any], tone: tuple[float, float] | None) -> NDArray[np.uint8]:
    """Bytes of values `(h, w, ...)`, a few rows at a time; without a tone white is the largest of 8 or 16 bits."""
    if values.dtype == np.uint8 and tone is None:
        return values
    shown = np.empty(values.shape, np.uint8)
    for top in range(0, len(values), _ROWS):
        rows = slice(top, top + _ROWS)
        if tone is None:
            shown[rows] = (values[rows].astype(np.uint32) * 255 + 32767) // 65535
        else:
            shown[rows] = np.rint(between(values[rows], tone) * 255)
    return shown
