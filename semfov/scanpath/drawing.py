"""Who draws scanpaths: rooms that know of them, so these enter what they draw, and scanpaths ask for it by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_drawing: dict[str, Callable[..., Any]] = {}


def draws(name: str, function: Callable[..., Any]) -> None:
    """Enter what draws a scanpath: called with it, and with what the caller gave."""
    _drawing[name] = function


def drawn_by(name: str) -> Callable[..., Any]:
    """What was entered by this name."""
    return _drawing[name]
