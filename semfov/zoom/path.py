"""The record of a search or an exploration of a large picture."""

from dataclasses import dataclass
from typing import Literal

from semfov.decision import CloserLook, Decision
from semfov.zoom.drawing import path_html
from semfov.zoom.gist import FOUND
from semfov.zoom.glances import Glance
from semfov.zoom.lattice import Lattice
from semfov.zoom.objects import Objects

Ending = Literal["decision", "price", "passes", "windows"]
"""Why a path ended: the search decided, no look was worth its price in objects, the passes were used up, or no window
was left that can show the target."""


@dataclass(frozen=True, repr=False)
class ZoomPath:
    """The record of a search or an exploration of a large picture.

    In a notebook it shows the windows that were looked at; `semfov.viz.plot_zoom_path` draws them on the picture.

    Attributes:
        lattice: lattice of the picture.
        classes: names of the classes, background first.
        target: class that was searched for; None for all classes.
        glances: looks in their order, the overview first.
        values: value of each look when it was chosen; that of the overview is infinite. For a closer look it is the
            probability that the target is at the place.
        objects: objects that were found, merged from all looks.
        decision: decision of a search; None where all objects were to be found.
        ending: reason for the end; None if it is not known.
        closer: closer looks of a search, in their order; they are among the `glances`.

    >>> import torch
    >>> nothing = Objects(torch.zeros(0, 4), torch.zeros(0), torch.zeros(0).long(), torch.zeros(0).long())
    >>> path = ZoomPath(Lattice.over((2560, 1920), (416, 416)), ("background", "cup"), 1, (), (), nothing)
    >>> path.describe()
    '0 × cup in 0 passes'
    """

    lattice: Lattice
    classes: tuple[str, ...]
    target: int | None
    glances: tuple[Glance, ...]
    values: tuple[float, ...]
    objects: Objects
    decision: Decision | None = None
    ending: Ending | None = None
    closer: tuple[CloserLook, ...] = ()

    @property
    def passes(self) -> int:
        """Number of passes of the detector."""
        return len(self.glances)

    def describe(self) -> str:
        """Summarise the result.

        Returns:
            A line of text.
        """
        count = len(self.objects.above(FOUND))
        passes = f"{self.passes} pass{'es' if self.passes != 1 else ''}"
        if self.decision is not None and self.target is not None:
            outcome = f"{self.decision.outcome} ({self.decision.probability:.2f})"
            return f"{self.classes[self.target]}: {outcome} in {passes}"
        if self.target is None:
            return f"{count} object{'s' if count != 1 else ''} in {passes}"
        return f"{count} × {self.classes[self.target]} in {passes}"

    def why_it_ended(self) -> str:
        """Explain in one sentence why the search or exploration ended.

        Returns:
            The sentence; empty if the reason is not known.
        """
        if self.ending == "decision" and self.decision is not None and self.closer:
            return {
                "found": "A closer look confirmed the target.",
                "absent": "No closer look confirmed the target, and it is probably absent.",
                "undecided": "No closer look confirmed the target, but it is probably there.",
            }[self.decision.outcome]
        if self.ending == "decision" and self.decision is not None:
            return {
                "found": "The probability is high enough, and a detection shows the target.",
                "absent": "No remaining look is worth a pass, and the target is probably absent.",
                "undecided": "No remaining look is worth a pass, but the target is probably there.",
            }[self.decision.outcome]
        reasons = {
            "price": "No remaining look is expected to show enough new objects.",
            "passes": f"All {self.passes} passes were used." if self.passes != 1 else "The only pass was used.",
            "windows": "No remaining look can show the target.",
        }
        return reasons.get(self.ending or "", "")

    def told(self) -> str:
        """Summarise the result, and explain why the search or exploration ended.

        Returns:
            A line of text.
        """
        return f"{self.describe()}. {self.why_it_ended()}".rstrip()

    def shown(self, number: int) -> tuple[float, float, float, float]:
        """Part of the picture that a look showed.

        Args:
            number: number of the look; the overview is 0.

        Returns:
            `(x1, y1, x2, y2)` in picture pixels.
        """
        window, (width, height) = self.glances[number].window, self.lattice.size
        if window.within is not None:
            return window.within
        (x, y, magnification), (wide, high) = window.fixation, self.lattice.canvas
        across, down = wide / magnification / 2, high / magnification / 2
        x, y = x + 0.5, y + 0.5
        return max(x - across, 0.0), max(y - down, 0.0), min(x + across, float(width)), min(y + down, float(height))

    def __repr__(self) -> str:
        """The result, the windows and the objects."""
        looks = [f"({x:.0f}, {y:.0f}) × {m:.2f}" for x, y, m in (glance.window.fixation for glance in self.glances)]
        path = looks if len(looks) <= 6 else [*looks[:4], "…", looks[-1]]
        sure = self.objects.above(FOUND)
        named = [
            f"{self.classes[label]} {score:.2f}"
            for label, score in zip(sure.labels.tolist()[:5], sure.scores.tolist(), strict=False)
        ]
        more = ["…"] if len(sure) > 5 else []
        width, height = self.lattice.size
        return "\n".join(
            [
                f"ZoomPath: {self.told()}",
                f"  at (x, y) × magnification: {', '.join(path)} of {width} × {height} px",
                f"  objects: {', '.join([*named, *more]) or 'none'}",
            ]
        )

    def _repr_html_(self) -> str:
        """A drawing of the windows, numbered in their order, and of the objects."""
        windows = [self.shown(number) for number in range(self.passes)]
        return path_html(self.told(), self.lattice.size, windows, self.objects, self.classes)
