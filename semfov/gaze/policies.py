"""The named policies: which acquisition function looks for a target, and which explores a scene."""

from collections.abc import Callable
from typing import Protocol, TypeVar

from torch import Tensor, nn

from semfov.belief.grid import Grid
from semfov.errors import InputError, lookup
from semfov.gaze.acquisition.accuracy import ExpectedAccuracy, SightedModel
from semfov.gaze.acquisition.closer_look import CloserLook
from semfov.gaze.acquisition.exploration import (
    KLDivergence,
    NegativeEntropy,
    ProbabilityOfImprovement,
    TwoPeaks,
    UpperConfidenceBound,
)
from semfov.gaze.acquisition.lookahead import LevelledModel, Lookahead
from semfov.gaze.acquisition.place import FovealHit, MissModel, NeighbourhoodPosterior, PlaceInformation
from semfov.gaze.acquisition.search import FovealModel, PredictedTargetPosterior, TargetPosterior
from semfov.gaze.acquisition.static import Uniform

Model = TypeVar("Model")

Policy = Callable[[int | Tensor | None, Grid], nn.Module]
"""Makes the acquisition function for a component of the belief (an index, or one for each episode) on a grid.

The component is None where a scene is explored and nothing is searched for.
"""

SEARCH_POLICIES = (
    "random",
    "non-predictive",
    "predictive",
    "neighbourhood",
    "foveal-hit",
    "place-information",
)

_LOOKAHEADS: dict[str, type[Lookahead]] = {
    "kl": KLDivergence,
    "negative-entropy": NegativeEntropy,
    "two-peaks": TwoPeaks,
    "upper-confidence-bound": UpperConfidenceBound,
    "probability-of-improvement": ProbabilityOfImprovement,
}

EXPLORATION_POLICIES = ("random", *_LOOKAHEADS, "expected-accuracy", "closer-look")


class SearchModel(FovealModel, MissModel, Protocol):
    """What all search policies together need of an observation model (`semfov.FovealObservationModel`)."""


class ExplorationModel(LevelledModel, SightedModel, Protocol):
    """What all exploration policies together need of an observation model (`semfov.FovealObservationModel`)."""


def search_policy(name: str, model: SearchModel | None = None, *, calibrated: bool = False) -> Policy:
    """A search policy by its name in the literature.

    Args:
        name: `random`, `non-predictive` (`TargetPosterior`), `predictive` (`PredictedTargetPosterior`),
            `neighbourhood` (`NeighbourhoodPosterior`), `foveal-hit` (`FovealHit`) or `place-information`
            (`PlaceInformation`).
        model: the observation model; `predictive` needs one, the last two need one with miss rates.
        calibrated: whether predicted scores are calibrated, as an agent does that calibrates what it sees.

    Raises:
        InputError: the name is unknown, or the model is missing.

    >>> search_policy("non-predictive")(3, Grid(10, 10, (640, 480)))
    TargetPosterior()
    """
    lookup(name, SEARCH_POLICIES, "search policy")
    if name == "random":
        return lambda target, grid: Uniform()
    if name == "non-predictive":
        return lambda target, grid: TargetPosterior(_known(target, name))
    if name == "neighbourhood":
        return lambda target, grid: NeighbourhoodPosterior(_known(target, name), grid)
    expecting = _needed(model, name)
    if name == "foveal-hit":
        return lambda target, grid: FovealHit(_known(target, name), expecting, grid)
    if name == "place-information":
        return lambda target, grid: PlaceInformation(_known(target, name), expecting, grid)
    return lambda target, grid: PredictedTargetPosterior(_known(target, name), expecting, calibrated=calibrated)


def exploration_policy(
    name: str, model: ExplorationModel | None = None, *, calibrated: bool = False, fovea: float = 100 / 640
) -> Policy:
    """An exploration policy by its name; it has no use for a target.

    Args:
        name: `random`, `kl` (`KLDivergence`), `negative-entropy` (`NegativeEntropy`), `two-peaks` (`TwoPeaks`),
            `upper-confidence-bound` (`UpperConfidenceBound`), `probability-of-improvement`
            (`ProbabilityOfImprovement`), `expected-accuracy` (`ExpectedAccuracy`) or `closer-look` (`CloserLook`).
        model: the observation model; every policy but `random` and `closer-look` needs one, `expected-accuracy` with
            miss rates.
        calibrated: whether expected scores are calibrated, as an agent does that calibrates what it sees.
        fovea: width σ of the fovea in longer sides of the image, for `closer-look`.

    Raises:
        InputError: the name is unknown, or the model is missing.

    >>> from semfov import FovealObservationModel
    >>> policy = exploration_policy("kl", FovealObservationModel.identity(["cup"], [0.2, 0.4]))
    >>> type(policy(None, Grid(10, 10, (640, 480)))).__name__
    'KLDivergence'
    """
    lookup(name, EXPLORATION_POLICIES, "exploration policy")
    if name == "random":
        return lambda target, grid: Uniform()
    if name == "closer-look":
        return lambda target, grid: CloserLook(grid, fovea)
    expecting = _needed(model, name)
    if name == "expected-accuracy":
        return lambda target, grid: ExpectedAccuracy(expecting, grid)
    acquisition = _LOOKAHEADS[name]
    return lambda target, grid: acquisition(expecting, grid, calibrated=calibrated)


def _needed(model: Model | None, name: str) -> Model:
    if model is None:
        raise InputError(f"policy {name!r}: expected an observation model for the scores to expect, got none")
    return model


def _known(target: int | Tensor | None, name: str) -> int | Tensor:
    if target is None:
        raise InputError(f"policy {name!r}: expected a target to search for, got none (see `exploration_policy`)")
    return target
