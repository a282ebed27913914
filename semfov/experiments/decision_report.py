"""How well scores tell whether a target is present, as rows of tables."""

from collections.abc import Mapping

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
