"""What the reports of fitted models have in common: words, tables and plots."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from semfov.metrics.episodes import FloatArray, standard_error
from semfov.runs.tables import percent, plus_minus, table


class Difference(NamedTuple):
    """The difference between a measure of the agent with a fitted part and without it, paired over photographs.

    Attributes:
        mean: mean of the paired differences; positive where the fitted part is better.
        error: its standard error.
        photographs: number of photographs.
    """

    mean: float
    error: float
    photographs: int

    @classmethod
    def of(cls, fitted: FloatArray, raw: FloatArray) -> "Difference":
        """Compute the paired difference of two measures `(P,)`, with one value for each photograph."""
        paired = np.asarray(fitted, dtype=np.float64) - np.asarray(raw, dtype=np.float64)
        return cls(float(paired.mean()), float(standard_error(paired)), len(paired))

    @property
    def better(self) -> bool:
        """Whether the mean is positive and greater than its standard error."""
        return math.isfinite(self.error) and self.mean > 0 and self.mean > self.error

    def in_words(self, unit: str, scale: float = 1.0) -> str:
        """Write the difference times `scale`, with its unit, its standard error and its number of photographs."""
        digits = 1 if scale > 1 else 3
        difference = plus_minus(scale * self.mean, scale * self.error, digits, sign="+")
        plural = "s" if self.photographs != 1 else ""
        return f"{difference} {unit} on {self.photographs} held-out photograph{plural}"


def mean_percent(values: FloatArray) -> str:
    """Format the mean of shares `(P,)` in percent, with its standard error."""
    return percent(float(values.mean()), float(standard_error(values)))


def section(text: str, rows: list[list[str]]) -> str:
    """Return a paragraph of Markdown, followed by a table if there are rows."""
    if not rows:
        return f"{text}\n"
    return "\n".join([text, "", *table(rows), ""])


def curves_table(head: list[str], curves: Mapping[str, FloatArray], numbers: Sequence[int]) -> list[list[str]]:
    """Make rows of the means of curves over photographs, in percent with their standard errors.

    Args:
        head: the first row.
        curves: `(P, shifts+1)` by name.
        numbers: the columns of a curve to show.

    Returns:
        The head, and a row for each curve.
    """
    rows = [head]
    for name, curve in curves.items():
        rows.append([name, *(mean_percent(curve[:, n]) for n in numbers)])
    return rows


def curves_figure(curves: Mapping[str, FloatArray]) -> Any:
    """Plot the means of curves of searches `(P, shifts+1)` over photographs, with their standard errors."""
    from semfov.viz import plot_curves

    means = {name: curve.mean(0) for name, curve in curves.items()}
    errors = {name: standard_error(curve) for name, curve in curves.items()}
    title = f"Held-out photographs ({len(curves['raw'])})"
    return plot_curves(means, errors, label="targets found (%)", title=title, most=102)
