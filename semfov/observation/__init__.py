"""How a detector's scores depend on the class and on the distance to the fovea.

The room has the Dirichlet distribution, sufficient statistics that merge, and the foveal observation model.
"""

from semfov.observation import dirichlet
from semfov.observation.calibration import fit_discriminative
from semfov.observation.foveal import FoldedObservationModel, FovealObservationModel
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
