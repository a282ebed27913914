"""Observers: they turn looks into a belief.

A look is one fixation with the detections that are seen from there.
"""

from semfov.belief.observers.any_of import AnyOf
from semfov.belief.observers.base import Evidence, Observer
from semfov.belief.observers.semantic import CellMemory, Semantic
from semfov.belief.observers.semantic_map import SemanticMap
from semfov.belief.observers.semantic_search import SemanticSearch

__all__ = ["AnyOf", "CellMemory", "Evidence", "Observer", "Semantic", "SemanticMap", "SemanticSearch"]
