"""A registry of functions that draw records, or compare them.

Imports run one way, and the rooms that draw and compare records come after this one. They register their functions
here, and records call them by name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_drawing: dict[tuple[str, type], Callable[..., Any]] = {}


def draws(name: str, kind: type, function: Callable[..., Any]) -> None:
    """Register a function that draws records of a kind; its first argument is the record."""
    _drawing[name, kind] = function


def drawing_of(name: str, kind: type) -> Callable[..., Any]:
    """The function registered under this name for a kind of records, or for its nearest base class."""
    return next(_drawing[name, each] for each in kind.__mro__ if (name, each) in _drawing)
