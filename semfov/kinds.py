"""The kinds of look (fovea, windows, head), with their names and how they are drawn."""

from dataclasses import dataclass
from typing import Literal

KindName = Literal["fovea", "windows", "head"]
"""Name of a kind of look: fixations of a photograph, windows of a picture, views of a scene."""

Drawing = Literal["scanpath", "views", "belief", "belief_bars", "animation"]
"""Figure that can be drawn of an episode."""

Quality = Literal["quick", "best"]
"""How a picture is looked at to predict where people look: once, or in six views."""


@dataclass(frozen=True)
class LookKind:
    """A kind of look, as settings, records, pages and figures tell it from others.

    Its episodes are those of a `semfov.agents.kinds.KindOfLook`.

    Attributes:
        name: its name, as `how=` has it.
        looks_by: what looks at a picture, in words.
        drawings: figures that can be drawn of its records.
        path: whether fixations follow each other in a path, which figures draw; others are numbered outlines.
        grid: whether the eye looks at the cells of a grid over the picture, which figures draw.
        turns: whether a head turns: looks are then views, and objects have directions.
        fine: whether looks are sharper than the reduced picture that a record keeps.
    """

    name: KindName
    looks_by: str
    drawings: tuple[Drawing, ...] = ("scanpath", "animation")
    path: bool = True
    grid: bool = False
    turns: bool = False
    fine: bool = False


FOVEA = LookKind("fovea", "a fovea", ("scanpath", "views", "belief", "belief_bars", "animation"), grid=True)
WINDOWS = LookKind("windows", "windows", path=False, fine=True)
HEAD = LookKind("head", "a head that turns", turns=True)
