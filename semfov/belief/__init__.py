"""Beliefs about the scene: a grid of cells, the evidence of each look about them, and the fusion of looks.

A look is one fixation with the detections that are seen from there.
"""

from semfov.belief import fusion, observers
from semfov.belief.belief import Belief, DirichletBelief
from semfov.belief.fusion import fuse
from semfov.belief.grid import Footprint, Grid
from semfov.belief.likelihood import Observation, likelihoods
from semfov.belief.verification import Verification

__all__ = [
    "Belief",
    "DirichletBelief",
    "Footprint",
    "Grid",
    "Observation",
    "Verification",
    "fuse",
    "fusion",
    "likelihoods",
    "observers",
]
