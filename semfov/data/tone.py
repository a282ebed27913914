"""The values of a picture that are shown as black and as white, for thermal cameras, reflectances and 12 bits."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from semfov.errors import check
from semfov.io.schema import is_number

White = float | tuple[float, float] | Literal["auto"]
"""The value that is white where 0 is black, the values that are black and white, or `auto` for percentiles."""

Values = NDArray[Any]
"""Numbers of a picture in the type of its file, of any shape."""

_PERCENTILES = 1.0, 99.0  # of the values, which are black and white for `auto`
ROWS_AT_ONCE = 64  # of a picture, whose values are converted: more leave the cache of the processor


def check_white(white: White | None) -> None:
    """Raise `InputError` unless the value is a valid `white`."""
    if isinstance(white, str | None) and white in (None, "auto"):
        return
    limits: Sequence[object] = white if isinstance(white, tuple | list) else (0.0, white)
    expected = "a value above 0, (black, white) with black < white, or 'auto'"
    check(_are_limits([_plain(limit) for limit in limits]), "white", expected, white)


def _are_limits(numbers: Sequence[Any]) -> bool:
    """Tell whether these are two finite numbers, of which the second is larger."""
    if len(numbers) != 2 or not all(map(is_number, numbers)):
        return False
    black, white = numbers
    return -np.inf < black < white < np.inf


def _plain(number: Any) -> Any:
    """Convert a number of NumPy or of a tensor, such as the largest value of a picture, to one of Python's."""
    return number.item() if getattr(number, "ndim", None) == 0 else number


def stated_limits(white: float | tuple[float, float]) -> tuple[float, float]:
    """Read the values that are black and white out of a `white` that states them.

    >>> stated_limits(4095), stated_limits((100, 200))
    ((0.0, 4095.0), (100.0, 200.0))
    """
    black, most = white if isinstance(white, tuple | list) else (0.0, white)
    return float(black), float(most)


def black_and_white(white: White, values: Values, nodata: float | None = None) -> tuple[float, float]:
    """Choose the values that are shown as black and as white.

    Args:
        white: checked by `check_white`.
        values: some values of the picture, of any shape, of which `auto` takes percentiles.
        nodata: the value of pixels without data, which percentiles leave out; None for none.

    Returns:
        The values that are black and white.
    """
    if not isinstance(white, str):
        return stated_limits(white)
    with_data = np.isfinite(values) & (values != (np.nan if nodata is None else nodata))
    shown = values[with_data].astype(np.float64)
    if not shown.size:
        return 0.0, 1.0
    black, most = np.percentile(shown, _PERCENTILES).tolist()
    return black, most if most > black else black + 1.0


def between(values: Values, tone: tuple[float, float]) -> NDArray[np.float32]:
    """Scale values so that black is 0 and white is 1, and clip them to [0, 1]; NaN becomes black."""
    black, white = tone
    share = (values.astype(np.float64) - black) / (white - black)
    return np.nan_to_num(share, nan=0.0).clip(0, 1).astype(np.float32)


def bytes_between(values: Values, tone: tuple[float, float] | None) -> NDArray[np.uint8]:
    """Convert values to bytes, a few rows at a time.

    Args:
        values: `(h, w, ...)`.
        tone: the values that are black and white; None for 0 and the largest of 8 or 16 bits.

    Returns:
        Bytes of the same shape; the values themselves where nothing changes.
    """
    if values.dtype == np.uint8 and tone is None:
        return values
    shown = np.empty(values.shape, np.uint8)
    for top in range(0, len(values), ROWS_AT_ONCE):
        rows = slice(top, top + ROWS_AT_ONCE)
        if tone is None:
            # Rounded to the nearest byte, in whole numbers.
            shown[rows] = (values[rows].astype(np.uint32) * 255 + 32767) // 65535
        else:
            shown[rows] = np.rint(between(values[rows], tone) * 255)
    return shown
