"""Observers: how looks become a belief, and which looks count."""

from semfov.belief.observers.base import Look, Observer
from semfov.belief.observers.context import Context, ContextBelief
from semfov.belief.observers.semantic import Memory, Semantic, SemanticLook
from semfov.belief.observers.target import Target, TargetBelief

__all__ = [
    "Context",
    "ContextBelief",
    "Look",
    "Memory",
    "Observer",
    "Semantic",
    "SemanticLook",
    "Target",
    "TargetBelief",
]
