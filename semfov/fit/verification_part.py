"""The part of a model folder that verifies targets by closer looks, fitted to held-out photographs."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from semfov.belief.verification import TRUE_CELLS, Verification
from semfov.errors import DataError
from semfov.fit.detector_report import Difference
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.searches import SearchedPhotograph, SearchEnd, open_photographs
from semfov.fit.settings import VerificationConfig
from semfov.fit.thresholds import SUREST_OF_FEW
from semfov.fit.training import training_of
from semfov.fit.verification import VerificationInFolds, VerifiedSearch, fit_in_folds
from semfov.fit.verification_report import verification_report
from semfov.metrics.episodes import FloatArray
from semfov.observation.foveal import FovealObservationModel

# The shipped model that is the centre of the prior for other detectors: as in their fit, cells have true probabilities.
_SHIPPED = "yolox-nano"
_ABSENT = 200  # the threshold is chosen on about this many searches for absent classes
_MOST_ABSENT = 20  # and at most so many of them in a photograph


class VerificationFit(PartFit):
    """Fit the verification to held-out photographs: searches are surer of those that their model learned from."""

    settings: VerificationConfig

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        self.settings = inputs.settings(VerificationConfig, absent=inputs.absent)
        judged = len(inputs.judged)
        self.tasks = {"looking": judged, "verifying": 0.5 * judged}

    def fit(self) -> PartResult:
        """Fit in folds, and compare decisions with those of the same agent without closer looks."""
        model = self.inputs.model("search")
        if not isinstance(model, FovealObservationModel):
            return self.left_out("not fitted, since the agent does not use the model of searches")
        photographs = self._photographs()
        config = self._settings_for(len(photographs), model)
        prior = Verification.from_pretrained(_SHIPPED).requires_grad_(False)
        fitted = fit_in_folds(photographs, model, config, prior, SUREST_OF_FEW)
        verification = fitted.model
        verification.metadata = {
            **self.run.eye.settings(),
            TRUE_CELLS: model.true_cells,
            **training_of(config, self.run.scenes),
        }
        gain, why = _compare(fitted)
        return PartResult(
            self.write("verification", verification, gain.better, why),
            "Fitted to the held-out photographs only, close to the model that is shipped for YOLOX-nano. A "
            "decision scores 100 points if it finds the target at a right place, -100 points if it finds it at a wrong "
            "place or in a photograph without the target, and 0 points if it finds nothing. Searches for present and "
            "for absent classes have equal weight. The threshold was chosen on the same photographs.\n\n"
            + verification_report(fitted, f"{len(photographs)} photographs").text,
        )

    def _photographs(self) -> list[SearchedPhotograph]:
        """Draw searches of the held-out photographs, with spare ones for the choice of the threshold."""
        run = self.run
        judged = self.inputs.judged
        # A threshold with few false alarms needs many searches without the target.
        spare = min(_MOST_ABSENT, _ABSENT // len(judged))
        photographs = open_photographs(run, judged, self.settings, spare=spare)
        if len(photographs) < 2:
            raise DataError(
                "data: expected at least 2 held-out photographs with a class to search for, got "
                f"{len(photographs)}; give more photographs"
            )
        return photographs

    def _settings_for(self, photographs: int, model: FovealObservationModel) -> VerificationConfig:
        """Return the settings for so many photographs, and for a model of searches with its thresholds."""
        assert model.presence is not None
        thresholds = model.presence.thresholds
        assert thresholds is not None
        # A model of few photographs is less sure of its cells, and then a search must not give up as soon.
        stop_below = min(self.settings.stop_below, thresholds.stop_below)
        return replace(self.settings, folds=min(self.settings.folds, photographs), stop_below=stop_below)


def _compare(fitted: VerificationInFolds) -> tuple[Difference, str]:
    """Compare the scores of decisions with closer looks and without; the difference, and the sentence about it."""
    assert fitted.model.thresholds is not None
    confirm = fitted.model.thresholds.confirm
    searches = fitted.searches
    after = _scores(searches, [search.found(confirm) for search in searches])
    before = _scores(searches, [search.unverified for search in searches if search.unverified is not None])
    gain = Difference.of(after, before)
    return gain, (
        f"decisions score {100 * after.mean():.1f} points, {100 * before.mean():.1f} without closer looks; "
        f"{gain.in_words('points gained', 100)}"
    )


def _scores(searches: Sequence[VerifiedSearch], ends: Sequence[SearchEnd]) -> FloatArray:
    """Average the scores of decisions in each photograph, `(P,)`; present and absent classes have equal weight."""
    by_picture: dict[int, dict[bool, list[int]]] = {}
    for search, end in zip(searches, ends, strict=True):
        scores = by_picture.setdefault(search.picture, {}).setdefault(search.present, [])
        scores.append(_score(end))
    return np.array([_mean_of_means(kinds.values()) for kinds in by_picture.values()])


def _mean_of_means(kinds: Iterable[Sequence[int]]) -> float:
    """Average scores of several kinds, each of which has the same weight."""
    return float(np.mean([np.mean(scores) for scores in kinds]))


def _score(end: SearchEnd) -> int:
    """Score a decision: 1 for the right place, -1 for a wrong one, 0 if nothing is found."""
    if end.right is None:
        return 0
    return 1 if end.right else -1
