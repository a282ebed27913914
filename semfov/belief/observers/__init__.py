"""Observers: they turn looks into a belief.

A look is one fixation with the detections that are seen from there.
"""

from semfov.belief.observers.any_of import AnyBelief, AnyLook, AnyOf
from semfov.belief.observers.base import Look, Observer
from semfov.belief.observers.learned_map import LearnedMap, MapBelief, MapLook
from semfov.belief.observers.semantic import CellMemory, Semantic, SemanticLook
from semfov.belief.observers.target import Target, TargetBelief

__all__ = [
    "AnyBelief",
    "AnyLook",
    "AnyOf",
    "LearnedMap",
    "Look",
    "MapBelief",
    "MapLook",
    "CellMemory",
    "Observer",
    "Semantic",
    "SemanticLook",
    "Target",
    "TargetBelief",
]
