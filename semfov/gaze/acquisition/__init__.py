"""Acquisition functions: the value of fixating each cell, given the belief."""

from semfov.gaze.acquisition.search import PredictedTargetPosterior, TargetPosterior
from semfov.gaze.acquisition.static import Static, Uniform

__all__ = ["PredictedTargetPosterior", "Static", "TargetPosterior", "Uniform"]
