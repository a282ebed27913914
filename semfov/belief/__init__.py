"""Beliefs about the scene: a grid of cells, what looks say of them, and how that is fused."""

from semfov.belief import fusion, observers
from semfov.belief.belief import Belief, DirichletBelief
from semfov.belief.context import ContextPrior
from semfov.belief.fusion import fuse
from semfov.belief.grid import Footprint, Grid
from semfov.belief.likelihood import Observation, likelihoods
from semfov.belief.map_evidence import MapEvidence
from semfov.belief.target_evidence import TargetEvidence

__all__ = [
    "Belief",
    "ContextPrior",
    "DirichletBelief",
    "Footprint",
    "Grid",
    "MapEvidence",
    "Observation",
    "TargetEvidence",
    "fuse",
    "fusion",
    "likelihoods",
    "observers",
]
