"""Kinds of look, as pages and figures tell their records apart."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class LookKind:
    """Kind of the looks of a record.

    Attributes:
        how: its name, as methods of an agent take it.
        path: whether fixations follow each other in a path, which figures draw; others are numbered outlines.
        grid: whether the eye looks at the cells of a grid over the picture, which figures draw.
        turns: whether a head turns: looks are then views, and objects have directions.
        fine: whether looks are sharper than the reduced picture that a record keeps.
    """

    how: Literal["fovea", "windows", "head"]
    path: bool = True
    grid: bool = False
    turns: bool = False
    fine: bool = False


FOVEA = LookKind("fovea", grid=True)
WINDOWS = LookKind("windows", path=False, fine=True)
HEAD = LookKind("head", turns=True)
