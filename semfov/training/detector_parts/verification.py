"""The verification of targets by closer looks, compared with decisions by the target evidence alone."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from semfov.belief.target_evidence import TargetEvidence
from semfov.errors import DataError
from semfov.io.manifest import Part
from semfov.training.closer_looks import photographs
from semfov.training.detector_parts.evidence import SUREST_OF_FEW
from semfov.training.detector_parts.part import Fitted, PartFit
from semfov.training.detector_words import in_words
from semfov.training.held_out import Array, Difference
from semfov.training.outputs import training_of
from semfov.training.verification_decisions import Verified, value
from semfov.training.verification_fit import fit_and_verify, shipped_mean
from semfov.training.verification_report import report
from semfov.training.verification_settings import FitVerificationConfig

ABSENT = 200
"""The threshold is chosen on about this many searches for absent classes, at most 20 in a photograph."""


class VerificationFit(PartFit):
    """Fit the verification to held-out photographs, since the target evidence is surer on those it learned from.

    A few photographs cannot determine 16 parameters, so the fit keeps close to the mean of the shipped models.
    """

    name: ClassVar[str] = "verification"

    @property
    def settings(self) -> FitVerificationConfig:
        """The settings of the fit."""
        return self.config.verification(self.bench.components - 1)

    @property
    def tasks(self) -> dict[str, float]:
        """The tasks and their seconds."""
        judged = len(self.bench.judged)
        return {"looking": 2 * judged, "verifying": 3 * judged}

    def fit(self) -> Fitted:
        """Fit in folds, and compare the places that searches report with those before the closer looks."""
        config, run, judged = self.settings, self.run, self.bench.judged
        evidence = self.bench.model("evidence")
        if not isinstance(evidence, TargetEvidence):
            why = "not fitted, since the agent does not use the target evidence"
            return Fitted(Part(None, None, False, why), f"{why.capitalize()}.")
        seen = photographs(
            run.eye,
            run.scenes,
            judged,
            (config.columns, config.rows),
            classes=config.classes,
            absent=config.absent,
            max_area=config.max_target_area,
            seed=config.seed,
            spare=min(20, ABSENT // len(judged)),
            stored=run.detections,
        )
        if len(seen) < 2:
            raise DataError(
                f"data: expected at least 2 held-out photographs with a class to search for, got {len(seen)}; give "
                "more photographs"
            )
        assert evidence.thresholds is not None
        # Evidence from few photographs is less sure of its cells, and then a search must not give up as soon.
        give_up = min(config.give_up, evidence.thresholds.give_up)
        config = replace(config, folds=min(config.folds, len(seen)), give_up=give_up)
        fitted = fit_and_verify(seen, evidence, config, shipped_mean(), SUREST_OF_FEW)
        after, before = values(fitted.searches)
        gain = Difference.of(after, before)
        why = (
            f"the reported places are worth {100 * after.mean():.1f} points, {100 * before.mean():.1f} without closer "
            f"looks; {in_words(gain, 'points gained', 100)}"
        )
        fitted.model.metadata = {**run.eye.settings(), **training_of(config, run.scenes, "target_model", "fitted")}
        text = (
            "Fitted to the held-out photographs only, close to the mean of the shipped models. A right place that is "
            "reported with probability p is worth 100 (2p - p²) points, and a wrong one -100 p². This is the value of "
            "the decisions, averaged over all thresholds.\n\n"
        )
        return Fitted(self.write(fitted.model, gain.better, why), text + report(fitted, len(seen))[0])


def values(searches: list[Verified]) -> tuple[Array, Array]:
    """Average the values of the reported places in each photograph, after and before closer looks.

    Args:
        searches: the searches; those that only serve to choose thresholds are left out.

    Returns:
        Two arrays `(P,)`, with one value for each photograph.
    """
    pairs: dict[int, list[tuple[float, float]]] = {}
    for each in searches:
        if not each.spare:
            pairs.setdefault(each.photograph, []).append((value(each.best), value(each.unverified.place)))
    means = np.array([np.mean(each, axis=0) for each in pairs.values()])
    return means[:, 0], means[:, 1]
