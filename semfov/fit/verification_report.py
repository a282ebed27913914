"""The report on a fitted verification: probabilities before and after closer looks, and decisions at thresholds."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.fit.searches import SearchEnd
from semfov.fit.verification import VerificationInFolds, VerifiedSearch
from semfov.metrics.calibration import calibration_error
from semfov.metrics.episodes import area_under_roc
from semfov.runs.tables import mean_or_dash, share, table

_THRESHOLDS = (0.5, 0.6, 0.7, 0.8, 0.9)  # values of the threshold `confirm` in the table, besides the chosen one

NO_PLACES = "None, since there are no places that hold the target, or none that do not.\n"
"""The report where no verification can be fitted."""


class VerificationReport(NamedTuple):
    """A report in Markdown, and its measures by name; None where only one kind was searched for."""

    text: str
    figures: dict[str, float | None]


def verification_report(fitted: VerificationInFolds, pictures: str) -> VerificationReport:
    """Evaluate the models of folds on their closer looks, and the decisions of the searches.

    Args:
        fitted: the model with its threshold, the models of folds, closer looks and searches.
        pictures: number and kind of the pictures, in words.

    Returns:
        The report.
    """
    assert fitted.model.thresholds is not None
    searches = fitted.searches
    chances, figures = _chances(fitted)
    figures["area"] = _area_of(searches)
    text = "\n".join(
        [
            f"{_numbers(searches, pictures)}; {len(fitted.closer_looks.fold)} closer looks. "
            "Each photograph is evaluated with a model fitted to other folds.",
            "",
            "Probability of the target before and after a closer look:",
            "",
            *table(chances),
            "",
            *_decisions_report(searches, fitted.model.thresholds.confirm),
        ]
    )
    return VerificationReport(text, figures)


def places_report(searches: Sequence[VerifiedSearch], confirm: float, pictures: str) -> list[str]:
    """Evaluate decisions by closer looks that no model of their own judges.

    Args:
        searches: searches with all their closer looks.
        confirm: the threshold that was chosen.
        pictures: number and kind of the pictures, in words.

    Returns:
        The report in Markdown, line by line.
    """
    return [f"{_numbers(searches, pictures)}.", "", *_decisions_report(searches, confirm)]


def _numbers(searches: Sequence[VerifiedSearch], pictures: str) -> str:
    """Say how many searches there are."""
    present = sum(search.present for search in searches)
    return f"{len(searches)} searches of {pictures}, {present} of them for a present class"


def _decisions_report(searches: Sequence[VerifiedSearch], confirm: float) -> list[str]:
    """Report the decisions, in lines of Markdown."""
    return [
        "Decisions in %, and mean numbers of looks, closer ones included. Area under the ROC of the final probability: "
        f"{_figure(_area_of(searches))}.",
        "",
        *table(_decisions(searches, confirm)),
        "",
    ]


def _chances(fitted: VerificationInFolds) -> tuple[list[list[str]], dict[str, float | None]]:
    """Measure the probabilities before and after closer looks: rows of a table, and the measures by name."""
    looks = fitted.closer_looks
    # The log odds after each closer look, by the model that was not fitted to its picture, `(N, 2)`, with those of the
    # class.
    by_fold = torch.stack([model(looks.features) for model in fitted.folds])
    after = by_fold[looks.fold, torch.arange(len(looks.fold))] + looks.known[:, None]
    before = looks.features[:, :2] + looks.known[:, None]
    figures: dict[str, float | None] = {}
    rows = [["", "NLL", "ECE", "area under ROC"]]
    for words, name, log_odds, answers in (
        ("at the place, before", "cell", before[:, 1], looks.right),
        ("at the place, after", "place", after[:, 0], looks.right),
        ("in the image, before", "image", before[:, 0], looks.present),
        ("in the image, after", "presence", after[:, 1], looks.present),
    ):
        measures = {
            "nll": float(F.binary_cross_entropy_with_logits(log_odds, answers.to(log_odds))),
            "ece": float(calibration_error(log_odds.sigmoid(), answers)),
            "area": _area(log_odds, answers),
        }
        figures |= {f"{name}_{measure}": value for measure, value in measures.items()}
        rows.append([words, *(_figure(value) for value in measures.values())])
    return rows, figures


def _decisions(searches: Sequence[VerifiedSearch], chosen: float) -> list[list[str]]:
    """Make rows of a table of the decisions, without closer looks and with them, at several thresholds."""
    present = [search.present for search in searches]
    head = ["confirm", "hit rate", "false-alarm rate", "place right", "looks, target present", "looks, target absent"]
    rows = [head]
    unverified = [search.unverified for search in searches if search.unverified is not None]
    if len(unverified) == len(searches):  # searches by windows have no decision without closer looks
        rows.append(["no closer looks", *_rates(present, unverified)])
    for confirm in sorted({*_THRESHOLDS, chosen}):
        mark = " (chosen)" if confirm == chosen else ""
        ends = [search.found(confirm) for search in searches]
        rows.append([f"{confirm:.2f}{mark}", *_rates(present, ends)])
    return rows


def _rates(present: Sequence[bool], ends: Sequence[SearchEnd]) -> list[str]:
    """Count hits, false alarms, right places and looks of decisions, as cells of a table."""
    shares = []
    verdicts: list[bool] = []
    looks = []
    for kind in (True, False):
        of_kind = [end for end, there in zip(ends, present, strict=True) if there == kind]
        found = [end.right for end in of_kind if end.right is not None]
        shares.append(share(len(found), len(of_kind)))
        looks.append(mean_or_dash([end.looks for end in of_kind]))
        verdicts += found
    return [*shares, share(sum(verdicts), len(verdicts)), *looks]


def _area_of(searches: Sequence[VerifiedSearch]) -> float | None:
    """Compute the area under the ROC of the final probabilities."""
    present = torch.tensor([search.present for search in searches])
    return _area(torch.tensor([search.presence for search in searches]), present)


def _area(score: Tensor, answers: Tensor) -> float | None:
    """Compute the area under the ROC; None if all answers are the same."""
    return area_under_roc(score, answers) if answers.any() and not answers.all() else None


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
