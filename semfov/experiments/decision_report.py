"""What tables of decisions share."""

from collections.abc import Mapping, Sequence

from torch import Tensor

from semfov.metrics.presence import area_under_roc, hits_at

SHARES = (0.01, 0.02, 0.05)
"""Shares of false alarms at which hits are told."""


def telling(told: Mapping[str, Tensor], there: Tensor) -> list[list[str]]:
    """How well scores tell whether the target is there: area under the ROC curve, and hits at `SHARES` in %.

    Args:
        told: scores `(M,)`, by name.
        there: `(M,)`, whether it is.
    """
    if not there.any() or there.all():
        return [["-"] * (1 + len(SHARES)) for _ in told]
    return [
        [f"{area_under_roc(score, there):.3f}", *(f"{100 * hits_at(score, there, share):.0f}" for share in SHARES)]
        for score in told.values()
    ]


def percent(count: int, total: int) -> str:
    """A share in percent."""
    return f"{100 * count / total:.1f}" if total else "-"


def mean(values: Sequence[float], digits: int = 1) -> str:
    """A mean."""
    return f"{sum(values) / len(values):.{digits}f}" if values else "-"
