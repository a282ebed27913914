"""Beliefs about the scene: a grid of Dirichlet distributions and the rules that update it."""

from semfov.belief import fusion
from semfov.belief.belief import Belief, DirichletBelief
from semfov.belief.context import ContextPrior
from semfov.belief.context_observer import ContextObserver
from semfov.belief.evidence import Evidence, Observation, weigh
from semfov.belief.grid import Footprint, Grid
from semfov.belief.observer import Memory, Observer, SemanticObserver
from semfov.belief.semantic_map import SemanticMap
from semfov.belief.target_evidence import TargetEvidence
from semfov.belief.target_observer import TargetObserver
from semfov.belief.update import fuse

__all__ = [
    "Belief",
    "ContextObserver",
    "ContextPrior",
    "DirichletBelief",
    "Evidence",
    "Footprint",
    "Grid",
    "Memory",
    "Observation",
    "Observer",
    "SemanticMap",
    "SemanticObserver",
    "TargetEvidence",
    "TargetObserver",
    "fuse",
    "fusion",
    "weigh",
]
