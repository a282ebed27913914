"""Tables as CSV."""

import csv
import io
from collections.abc import Iterable, Sequence

_FORMULAS = ("=", "+", "-", "@")  # first characters of a formula in spreadsheets


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    r"""A table as CSV; the first row holds the headings, and text that a spreadsheet takes for a formula gets a quote.

    >>> csv_text([["picture", "x"], ["=1+1.jpg", -3.5]])
    "picture,x\n'=1+1.jpg,-3.5\n"
    """
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_plain(value) for value in row] for row in rows)
    return text.getvalue()


def _plain(value: object) -> object:
    if not isinstance(value, str) or len(value) < 2:
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}" if value.lstrip().startswith(_FORMULAS) else value
    return value
