"""Acquisition functions: the value of fixating each cell, given the belief."""

from semfov.gaze.acquisition.accuracy import ExpectedAccuracy
from semfov.gaze.acquisition.closer_look import CloserLook
from semfov.gaze.acquisition.exploration import (
    KLDivergence,
    NegativeEntropy,
    ProbabilityOfImprovement,
    TwoPeaks,
    UpperConfidenceBound,
)
from semfov.gaze.acquisition.place import FovealHit, NeighbourhoodPosterior, PlaceInformation
from semfov.gaze.acquisition.search import PredictedTargetPosterior, TargetPosterior
from semfov.gaze.acquisition.static import Static, Uniform

__all__ = [
    "CloserLook",
    "ExpectedAccuracy",
    "FovealHit",
    "KLDivergence",
    "NegativeEntropy",
    "NeighbourhoodPosterior",
    "PlaceInformation",
    "PredictedTargetPosterior",
    "ProbabilityOfImprovement",
    "Static",
    "TargetPosterior",
    "TwoPeaks",
    "Uniform",
    "UpperConfidenceBound",
]
