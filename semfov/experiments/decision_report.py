"""Measures and formatting that several tables of decisions share."""

from collections.abc import Mapping, Sequence

from torch import Tensor

from semfov.metrics.presence import area_under_roc, hits_at

SHARES = (0.01, 0.02, 0.05)
"""False alarm rates at which the tables give the hit rate."""


def telling(told: Mapping[str, Tensor], there: Tensor) -> list[list[str]]:
    """How well scores tell whether the target is present.

    Args:
        told: scores `(M,)` of the searches, by name.
        there: `(M,)` boolean, whether the target is present.

    Returns:
        A row for each name: area under the ROC curve, then hit rates in percent at the false alarm rates `SHARES`.
    """
    if not there.any() or there.all():
        return [["-"] * (1 + len(SHARES)) for _ in told]
    return [
        [f"{area_under_roc(score, there):.3f}", *(f"{100 * hits_at(score, there, share):.0f}" for share in SHARES)]
        for score in told.values()
    ]


def percent(count: int, total: int) -> str:
    """`count` in percent of `total`, or a dash where the total is 0."""
    return f"{100 * count / total:.1f}" if total else "-"


def mean(values: Sequence[float], digits: int = 1) -> str:
    """The mean with `digits` decimal places, or a dash where there are no values."""
    return f"{sum(values) / len(values):.{digits}f}" if values else "-"
