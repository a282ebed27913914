"""What the reports of fitted models have in common: words, tables and plots."""

import math
from typing import Any, NamedTuple

import numpy as np

from semfov.gaze.acquisition.base import Task
from semfov.metrics.episodes import FloatArray, standard_error
from semfov.runs.tables import percent, plus_minus, table


class Difference(NamedTuple):
    """The difference between a measure with fitted models and with raw scores, paired over photographs."""

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
        """The difference times `scale`, with its unit, its standard error and its number of photographs."""
        shown = plus_minus(scale * self.mean, scale * self.error, 1 if scale > 1 else 3, sign="+")
        return f"{shown} {unit} on {self.photographs} held-out photograph{'s' if self.photographs != 1 else ''}"


def mean_percent(values: FloatArray) -> str:
    """Format the mean of shares `(P,)` in percent, with its standard error."""
    return percent(float(values.mean()), float(standard_error(values)))


def section(text: str, rows: list[list[str]]) -> str:
    """Return a paragraph of Markdown, followed by a table if there are rows."""
    return "\n".join([text, "", *(table(rows) if rows else []), *([""] if rows else [])])


def curves_figure(curves: dict[str, FloatArray], task: Task) -> Any:
    """Plot the means of curves `(P, shifts+1)` over photographs, with their standard errors."""
    from semfov.viz import plot_curves

    means = {name: curve.mean(0) for name, curve in curves.items()}
    errors = {name: standard_error(curve) for name, curve in curves.items()}
    title = f"Held-out photographs ({len(curves['raw'])})"
    searched = task == "search"
    label, most = ("targets found (%)", 102) if searched else ("cells with the right class (%)", None)
    return plot_curves(means, errors, label=label, title=title, most=most)
