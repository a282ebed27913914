"""Tables in Markdown, and the figures in their cells."""

import math
from collections.abc import Sequence


def table(rows: list[list[str]]) -> list[str]:
    """Write a Markdown table with aligned columns; the first row holds the headings."""
    columns = zip(*rows, strict=True)
    widths = [max(map(len, column)) for column in columns]
    lines = []
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append(f"| {' | '.join(cells)} |")
    rules = ["-" * (width + 2) for width in widths]
    headings, *body = lines
    return [headings, f"|{'|'.join(rules)}|", *body]


def plus_minus(value: float, error: float, digits: int = 1, *, sign: str = "") -> str:
    """Write a value and its standard error, `12.3 ± 0.4`.

    Args:
        value: the value.
        error: its standard error; NaN for none.
        digits: decimal places.
        sign: `+` writes the sign of positive values, too.

    Returns:
        The text.
    """
    return f"{value:{sign}.{digits}f}" + (f" ± {error:.{digits}f}" if math.isfinite(error) else "")


def percent(value: float, error: float) -> str:
    """Write a share in percent with its standard error, if there is one."""
    return plus_minus(100 * value, 100 * error)


def share(count: int, total: int) -> str:
    """`count` in percent of `total`, or a dash where the total is 0."""
    return f"{100 * count / total:.1f}" if total else "-"


def mean_or_dash(values: Sequence[float], digits: int = 1) -> str:
    """Write the mean with `digits` decimal places, or a dash where there are no values."""
    return f"{sum(values) / len(values):.{digits}f}" if values else "-"
