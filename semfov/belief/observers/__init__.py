"""Observers: they turn looks into a belief.

A look is one fixation with the detections that are seen from there.
"""

from semfov.belief.observers.any_of import AnyOf
from semfov.belief.observers.base import Look, Observer
from semfov.belief.observers.learned_map import LearnedMap
from semfov.belief.observers.semantic import Association, CellMemory, Semantic
from semfov.belief.observers.target import Target

__all__ = ["AnyOf", "Association", "LearnedMap", "Look", "CellMemory", "Observer", "Semantic", "Target"]
