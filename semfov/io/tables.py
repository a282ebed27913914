"""Tables as CSV."""

import csv
import io
import math
from collections.abc import Iterable, Sequence
from typing import overload

_FORMULAS = ("=", "+", "-", "@")  # first characters of a formula in spreadsheets


def pixels(value: float) -> float:
    """Round a place in a table.

    Args:
        value: in pixels or degrees.

    Returns:
        The place, to a hundredth.
    """
    return round(value, 2)


@overload
def digits(value: float) -> float: ...


@overload
def digits(value: float | None) -> float | None: ...


def digits(value: float | None) -> float | None:
    """Round a number in a table, such as a probability, to four digits.

    Args:
        value: the number; None for none.

    Returns:
        The number, or None.

    >>> digits(0.123456789), digits(8.803147466096561e-06)
    (0.1235, 8.803e-06)
    """
    return None if value is None else float(f"{value:.4g}")


def share(value: float | None) -> float | None:
    """Round a probability from which others are computed to six places; near 0 or 1 four digits of the rest stay.

    Args:
        value: the probability, above 0 and below 1; None for none.

    Returns:
        The probability, above 0 and below 1, or None.

    >>> share(0.123456789), share(2.34567e-7), share(1 - 2.34567e-7)
    (0.123457, 2.346e-07, 0.9999997654)
    """
    if value is None:
        return None
    rarer = min(value, 1 - value)
    digits_of_rarer = 3 - math.floor(math.log10(rarer)) if 0 < rarer < 1 else 0
    return round(value, max(6, digits_of_rarer))


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    r"""Write a table as CSV; text that a spreadsheet takes for a formula gets a quote.

    Args:
        rows: the first one holds the headings.

    Returns:
        The text.

    >>> csv_text([["picture", "x"], ["=1+1.jpg", -3.5]])
    "picture,x\n'=1+1.jpg,-3.5\n"
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for row in rows:
        writer.writerow([_plain(value) for value in row])
    return text.getvalue()


def _plain(value: object) -> object:
    """Put a quote before text that is a formula; numbers as text are none."""
    if not isinstance(value, str) or len(value) < 2:
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}" if value.lstrip().startswith(_FORMULAS) else value
    return value
