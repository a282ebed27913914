"""How a detector's scores depend on the class and on the distance to the fovea.

The room has the Dirichlet distribution, sufficient statistics that merge, and the foveal observation model.
"""

from semfov.observation import dirichlet
from semfov.observation.calibration import fit_discriminative
from semfov.observation.folded import FoldedObservationModel
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.matching import match
from semfov.observation.misses import MissCounts
from semfov.observation.presence import Presence
from semfov.observation.separation import visibility
from semfov.observation.statistics import DirichletStatistics
from semfov.observation.thresholds import Thresholds

__all__ = [
    "DirichletStatistics",
    "FoldedObservationModel",
    "FovealObservationModel",
    "MissCounts",
    "Presence",
    "Thresholds",
    "dirichlet",
    "fit_discriminative",
    "match",
    "visibility",
]
