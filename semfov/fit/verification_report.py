"""The report of a fitted verification: probabilities before and after closer looks, and decisions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.fit.verification_decisions import Ended
from semfov.fit.verification_fit import FittedVerification
from semfov.metrics.calibration import calibration_error
from semfov.metrics.presence import area_under_roc
from semfov.runs.tables import mean, share, table

SHOWN = (0.5, 0.6, 0.7, 0.8, 0.9)
"""Values of the threshold `confirm` in the table, besides the chosen one."""


def report(
    fitted: FittedVerification,
    pictures: str,
    how: str = "Each photograph is evaluated with a model fitted to other folds.",
) -> tuple[str, dict[str, float | None]]:
    """Evaluate the models in folds.

    Args:
        fitted: the models with their closer looks and searches.
        pictures: number and kind of the pictures.
        how: sentence on which pictures a model is evaluated.

    Returns:
        The report as Markdown, and its measures by name; None for an area that only one kind of searches leaves
        undefined.
    """
    examined, searches = fitted.examined, fitted.searches
    odds = torch.stack([fold(examined.features) for fold in fitted.folds])
    odds = odds[examined.fold, torch.arange(len(examined.fold))]
    figures: dict[str, float | None] = {}
    for name, logit, there in (
        ("cell", examined.features[:, 1], examined.right),
        ("place", odds[:, 0], examined.right),
        ("image", examined.features[:, 0], examined.present),
        ("presence", odds[:, 1], examined.present),
    ):
        figures[f"{name}_nll"] = float(F.binary_cross_entropy_with_logits(logit, there.to(logit)))
        figures[f"{name}_ece"] = float(calibration_error(logit.sigmoid(), there))
        figures[f"{name}_area"] = _area(logit, there)
    there = torch.tensor([each.present for each in searches])
    figures["area"] = _area(torch.tensor([each.presence for each in searches]), there)
    chances = [["", "NLL", "ECE", "area under ROC"]]
    for told, name in (
        ("at the place, before", "cell"),
        ("at the place, after", "place"),
        ("in the image, before", "image"),
        ("in the image, after", "presence"),
    ):
        chances.append([told, *(_shown(figures[f"{name}_{what}"]) for what in ("nll", "ece", "area"))])
    assert fitted.model.thresholds is not None
    chosen = fitted.model.thresholds.confirm
    decisions = [["confirm", "found, there", "found, not there", "place right", "looks, there", "looks, not there"]]
    decisions.append(["no closer looks", *_row(there.tolist(), [each.unverified for each in searches])])
    for confirm in sorted({*SHOWN, chosen}):
        mark = " (chosen)" if confirm == chosen else ""
        ended = [each.found(confirm) for each in searches]
        decisions.append([f"{confirm:.2f}{mark}", *_row(there.tolist(), ended)])
    return "\n".join(
        [
            f"{len(searches)} searches of {pictures}, {int(there.sum())} of them for a present class; "
            f"{len(examined.fold)} closer looks. {how}",
            "",
            "Probability of the target before and after a closer look:",
            "",
            *table(chances),
            "",
            f"Decisions in %, and mean numbers of looks, closer ones included. Without closer looks, the thresholds of "
            f"the target evidence decide. Area under the ROC of the final probability: {_shown(figures['area'])}.",
            "",
            *table(decisions),
            "",
        ]
    ), figures


def _area(score: Tensor, there: Tensor) -> float | None:
    return area_under_roc(score, there) if there.any() and not there.all() else None


def _shown(figure: float | None) -> str:
    return "-" if figure is None else f"{figure:.3f}"


def _row(present: Sequence[bool], ended: Sequence[Ended]) -> list[str]:
    """Hits, false alarms, right places and looks of decisions."""
    shares, places, looks = [], [], []
    for kind in (True, False):
        of_kind = [each for each, there in zip(ended, present, strict=True) if there == kind]
        found = [right for right, _ in of_kind if right is not None]
        shares.append(share(len(found), len(of_kind)))
        looks.append(mean([end for _, end in of_kind]))
        places += found
    return [*shares, share(sum(places), len(places)), *looks]
