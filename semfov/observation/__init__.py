"""How scores depend on class and distance to the fovea: Dirichlets, their statistics, and the foveal model."""

from semfov.observation import dirichlet
from semfov.observation.calibration import fit_discriminative
from semfov.observation.folded import FoldedObservationModel
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.matching import match
from semfov.observation.misses import MissCounts
from semfov.observation.separation import visibility
from semfov.observation.statistics import DirichletStatistics

__all__ = [
    "DirichletStatistics",
    "FoldedObservationModel",
    "FovealObservationModel",
    "MissCounts",
    "dirichlet",
    "fit_discriminative",
    "match",
    "visibility",
]
