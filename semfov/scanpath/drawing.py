"""A registry of functions that draw scanpaths.

Imports run one way, and the rooms that draw scanpaths come after this one. They register their functions here, and
scanpaths call them by name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_drawing: dict[str, Callable[..., Any]] = {}


def draws(name: str, function: Callable[..., Any]) -> None:
    """Register a function that draws a scanpath; its first argument is the scanpath."""
    _drawing[name] = function


def drawn_by(name: str) -> Callable[..., Any]:
    """The function registered under this name."""
    return _drawing[name]
