"""Acquisition functions: the value of fixating each cell next, given the belief."""

from typing import TYPE_CHECKING

from semfov.gaze.acquisition.accuracy import ExpectedAccuracy, ExpectedGain
from semfov.gaze.acquisition.base import FUNCTIONS, AcquisitionFunction
from semfov.gaze.acquisition.closer_look import CloserLook
from semfov.gaze.acquisition.exploration import (
    BayesianSurprise,
    KLDivergence,
    NegativeEntropy,
    ProbabilityOfImprovement,
    TwoPeaks,
    UpperConfidenceBound,
)
from semfov.gaze.acquisition.place import FovealHit, PlaceInformation
from semfov.gaze.acquisition.saliency_prior import SaliencyPrior
from semfov.gaze.acquisition.search import NeighbourhoodPosterior, PredictedTargetPosterior, TargetPosterior
from semfov.gaze.acquisition.static import Static, Uniform

if TYPE_CHECKING:
    from semfov.baselines.ideal import CorrectLocalisation, EntropyLimit

__all__ = [
    "FUNCTIONS",
    "AcquisitionFunction",
    "BayesianSurprise",
    "CloserLook",
    "CorrectLocalisation",
    "EntropyLimit",
    "ExpectedAccuracy",
    "ExpectedGain",
    "FovealHit",
    "KLDivergence",
    "NegativeEntropy",
    "NeighbourhoodPosterior",
    "PlaceInformation",
    "PredictedTargetPosterior",
    "ProbabilityOfImprovement",
    "SaliencyPrior",
    "Static",
    "TargetPosterior",
    "TwoPeaks",
    "Uniform",
    "UpperConfidenceBound",
]


def __getattr__(name: str) -> object:
    """Import a baseline when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import semfov.baselines.ideal

    return getattr(semfov.baselines.ideal, name)
