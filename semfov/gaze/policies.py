"""The named policies: which acquisition function looks for a target, and which explores a scene."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import InputError, lookup
from semfov.gaze.acquisition.accuracy import ExpectedAccuracy, SightedModel
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.closer_look import CloserLook
from semfov.gaze.acquisition.exploration import (
    BayesianSurprise,
    KLDivergence,
    NegativeEntropy,
    ProbabilityOfImprovement,
    TwoPeaks,
    UpperConfidenceBound,
)
from semfov.gaze.acquisition.lookahead import LevelledModel, Lookahead
from semfov.gaze.acquisition.place import FovealHit, MissModel, PlaceInformation
from semfov.gaze.acquisition.search import NeighbourhoodPosterior, PredictedTargetPosterior, TargetPosterior
from semfov.gaze.acquisition.static import Uniform

Model = TypeVar("Model")

Policy = Callable[[int | Tensor | None, Grid], AcquisitionFunction]
"""Makes the acquisition function for a target (a class, or one for each episode) on a grid.

The target is None where a scene is explored and nothing is searched for.
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
    "surprise": BayesianSurprise,
    "negative-entropy": NegativeEntropy,
    "two-peaks": TwoPeaks,
    "upper-confidence-bound": UpperConfidenceBound,
    "probability-of-improvement": ProbabilityOfImprovement,
}

EXPLORATION_POLICIES = ("random", *_LOOKAHEADS, "expected-accuracy", "closer-look")


class SearchModel(LevelledModel, MissModel, Protocol):
    """What all search policies together need of an observation model (`semfov.FovealObservationModel`)."""


class ExplorationModel(LevelledModel, SightedModel, Protocol):
    """What all exploration policies together need of an observation model (`semfov.FovealObservationModel`)."""


def search_policy(name: str, model: SearchModel | None = None) -> Policy:
    """A search policy by its name; `random`, `non-predictive` and `predictive` are published, the others are ours.

    Args:
        name: `random`, `non-predictive` (`TargetPosterior`), `predictive` (`PredictedTargetPosterior`),
            `neighbourhood` (`NeighbourhoodPosterior`), `foveal-hit` (`FovealHit`) or `place-information`
            (`PlaceInformation`).
        model: the observation model; `predictive` and `neighbourhood` need one, the last two one with miss rates.

    Raises:
        InputError: the name is unknown, or the model is missing.

    >>> search_policy("non-predictive")(3, Grid(10, 10, (640, 480)))
    TargetPosterior()
    """
    lookup(name, SEARCH_POLICIES, "search policy")
    if name not in ("random", "non-predictive"):
        _needed(model, name)
    return _SearchPolicy(name, model)


def exploration_policy(
    name: str, model: ExplorationModel | None = None, *, fovea: float = 100 / 640, prior: float = 0.5
) -> Policy:
    """An exploration policy by its name; it has no use for a target.

    Args:
        name: `random`, `kl` (`KLDivergence`), `negative-entropy` (`NegativeEntropy`), `two-peaks` (`TwoPeaks`),
            `surprise` (`BayesianSurprise`), `upper-confidence-bound` (`UpperConfidenceBound`),
            `probability-of-improvement` (`ProbabilityOfImprovement`), `expected-accuracy` (`ExpectedAccuracy`) or
            `closer-look` (`CloserLook`).
        model: the observation model; every policy but `random` and `closer-look` needs one, `expected-accuracy` with
            miss rates.
        fovea: width σ of the fovea in longer sides of the image, for `closer-look`.
        prior: Dirichlet parameter of every class before the first look, for `kl`.

    Raises:
        InputError: the name is unknown, or the model is missing.

    >>> from semfov import FovealObservationModel
    >>> policy = exploration_policy("kl", FovealObservationModel.identity(["cup"], [0.2, 0.4]))
    >>> type(policy(None, Grid(10, 10, (640, 480)))).__name__
    'KLDivergence'
    """
    lookup(name, EXPLORATION_POLICIES, "exploration policy")
    if name not in ("random", "closer-look"):
        _needed(model, name)
    return _ExplorationPolicy(name, model, fovea, prior)


@dataclass(frozen=True)
class _SearchPolicy:
    """What `search_policy` returns: it can be pickled, and a copy of it has a copy of the model."""

    name: str
    model: SearchModel | None

    def __call__(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        if self.name == "random":
            return Uniform()
        wanted = _known(target, self.name)
        if self.name == "non-predictive":
            return TargetPosterior(wanted)
        model = _needed(self.model, self.name)
        if self.name == "neighbourhood":
            return NeighbourhoodPosterior(wanted, model, grid)
        if self.name == "foveal-hit":
            return FovealHit(wanted, model, grid)
        if self.name == "place-information":
            return PlaceInformation(wanted, model, grid)
        return PredictedTargetPosterior(wanted, model)


@dataclass(frozen=True)
class _ExplorationPolicy:
    """What `exploration_policy` returns."""

    name: str
    model: ExplorationModel | None
    fovea: float
    prior: float

    def __call__(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        if self.name == "random":
            return Uniform()
        if self.name == "closer-look":
            return CloserLook(grid, self.fovea)
        model = _needed(self.model, self.name)
        if self.name == "expected-accuracy":
            return ExpectedAccuracy(model, grid)
        if self.name == "kl":
            return KLDivergence(model, grid, prior=self.prior)
        return _LOOKAHEADS[self.name](model, grid)


def _needed(model: Model | None, name: str) -> Model:
    if model is None:
        raise InputError(f"policy {name!r}: expected an observation model for the scores to expect, got none")
    return model


def _known(target: int | Tensor | None, name: str) -> int | Tensor:
    if target is None:
        raise InputError(f"policy {name!r}: expected a target to search for, got none (see `exploration_policy`)")
    return target
