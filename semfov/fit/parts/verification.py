"""The verification of targets by closer looks, compared with decisions by the target evidence alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from semfov.belief.target_evidence import TargetEvidence
from semfov.errors import DataError
from semfov.fit.comparison import Difference
from semfov.fit.detector_report import in_words
from semfov.fit.outputs import training_of
from semfov.fit.parts.base import PartFit, PartResult
from semfov.fit.parts.evidence import SUREST_OF_FEW
from semfov.fit.searches import open_photographs
from semfov.fit.verification import (
    FitVerificationConfig,
    SearchEnd,
    VerifiedSearch,
    fit_in_folds,
    shipped_mean,
    verification_report,
)
from semfov.io.manifest import Part
from semfov.metrics.averages import FloatArray

ABSENT = 200
"""The threshold is chosen on about this many searches for absent classes, at most 20 in a photograph."""


class VerificationFit(PartFit):
    """Fit the verification to held-out photographs, since the target evidence is surer on those it learned from.

    A few photographs cannot determine 16 parameters, so the fit keeps close to shipped models (`shipped_mean`).
    """

    name: ClassVar[str] = "verification"

    @property
    def settings(self) -> FitVerificationConfig:
        """The settings of the fit."""
        return self.config.verification(self.inputs.components - 1)

    @property
    def tasks(self) -> dict[str, float]:
        """The tasks and their seconds."""
        judged = len(self.inputs.judged)
        return {"looking": judged, "verifying": 0.5 * judged}

    def fit(self) -> PartResult:
        """Fit in folds, and compare decisions with those of the same agent without closer looks."""
        config, run, judged = self.settings, self.run, self.inputs.judged
        evidence = self.inputs.model("evidence")
        if not isinstance(evidence, TargetEvidence):
            why = "not fitted, since the agent does not use the target evidence"
            return PartResult(Part(None, None, False, why), f"{why.capitalize()}.")
        photographs = open_photographs(
            run.eye,
            run.scenes,
            judged,
            (config.columns, config.rows),
            classes=config.classes,
            absent=config.absent,
            max_area=config.max_target_area,
            seed=config.seed,
            spare=min(20, ABSENT // len(judged)),
            everywhere=run.detections,
        )
        if len(photographs) < 2:
            raise DataError(
                "data: expected at least 2 held-out photographs with a class to search for, got "
                f"{len(photographs)}; give more photographs"
            )
        assert evidence.thresholds is not None
        # Evidence from few photographs is less sure of its cells, and then a search must not give up as soon.
        give_up = min(config.give_up, evidence.thresholds.give_up)
        config = replace(config, folds=min(config.folds, len(photographs)), give_up=give_up)
        fitted = fit_in_folds(photographs, evidence, config, shipped_mean(), SUREST_OF_FEW)
        assert fitted.model.thresholds is not None
        confirm = fitted.model.thresholds.confirm
        after = scores(fitted.searches, [each.found(confirm) for each in fitted.searches])
        before = scores(fitted.searches, [each.unverified for each in fitted.searches])
        gain = Difference.of(after, before)
        why = (
            f"decisions score {100 * after.mean():.1f} points, {100 * before.mean():.1f} without closer looks; "
            f"{in_words(gain, 'points gained', 100)}"
        )
        fitted.model.metadata = {**run.eye.settings(), **training_of(config, run.scenes, "target_model", "fitted")}
        text = (
            "Fitted to the held-out photographs only, close to the mean of the models shipped for other detectors. A "
            "decision scores 100 points if it finds the target at a right place, -100 points if it finds it at a wrong "
            "place or in a photograph without the target, and 0 points if it finds nothing. Searches for present and "
            "for absent classes have equal weight. The threshold was chosen on the same photographs.\n\n"
        )
        return PartResult(
            self.write(fitted.model, gain.better, why),
            text + verification_report(fitted, f"{len(photographs)} photographs")[0],
        )


def scores(searches: Sequence[VerifiedSearch], ends: Sequence[SearchEnd]) -> FloatArray:
    """Average the scores of decisions in each photograph, with equal weight of present and of absent classes.

    Args:
        searches: the searches.
        ends: their ends. A right place scores 1, a wrong place -1, and a search that finds nothing 0.

    Returns:
        `(P,)`, the mean score of each photograph.
    """
    by_picture: dict[int, dict[bool, list[int]]] = {}
    for each, (right, _) in zip(searches, ends, strict=True):
        score = 0 if right is None else 1 if right else -1
        by_picture.setdefault(each.picture, {}).setdefault(each.present, []).append(score)
    return np.array([np.mean([np.mean(kind) for kind in kinds.values()]) for kinds in by_picture.values()])
