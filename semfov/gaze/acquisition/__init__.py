"""Acquisition functions: the value of fixating each cell next, given the belief."""

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
from semfov.gaze.acquisition.ideal import CorrectLocalisation, EntropyLimit
from semfov.gaze.acquisition.place import FovealHit, PlaceInformation
from semfov.gaze.acquisition.saliency_prior import SaliencyPrior
from semfov.gaze.acquisition.search import NeighbourhoodPosterior, PredictedTargetPosterior, TargetPosterior
from semfov.gaze.acquisition.static import Static, Uniform

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
