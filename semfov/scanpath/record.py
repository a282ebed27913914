"""The record of an episode: where the gaze went, what was seen and what was believed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal, Self

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.decision import Decision
from semfov.detection.detections import Detections
from semfov.errors import InputError
from semfov.scanpath.drawing import drawn_by
from semfov.scanpath.files import read_fields, write_fields
from semfov.scanpath.stimulus import Stimulus

if TYPE_CHECKING:
    from pathlib import Path

    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Ending = Literal["box", "decision", "price", "shifts", "cells"]
"""Why an episode ended: the gaze was on a given box, the search decided, no look was worth its price, all gaze shifts
were made, or every cell was fixated."""


@dataclass(frozen=True)
class Scanpath:
    """Fixations of one episode in order, with what was seen and believed at each.

    In a notebook it shows itself as a page to step through. `plot`, `animate`, `to_frame` and `save` make pictures, a
    film, a table and a file of it.

    Attributes:
        grid: the cells of the image.
        classes: names of the classes, background first, in the order of the belief's components.
        target: index of the class that was searched for; None for exploration.
        cells: `(n,)`, fixated cells.
        fixations: `(n, 2)`, their centres as points `(x, y)`.
        detections: what was seen from each fixation, batches of one.
        probabilities: `(n, X·Y, K+1)`, that each cell holds each class, after each look; the first is background. Of a
            learned map they are marginal: several classes can share a cell, and they need not sum to 1.
        values: `(n, X·Y)`, acquisition values that the next fixation was chosen by.
        found: whether the search ended on its target.
        posterior: `(n, X·Y)`, probability of the target in each cell as the search believed it after each look; None
            for exploration.
        presence: `(n,)`, probability that the image holds the target, after each look; None for exploration.
        decision: what the search decided; None for exploration, and where the protocol ended it on a given box.
        ending: why it ended; None where that is not known.
        seconds: what each look took, by stage (`semfov.episode.STAGES`).
        stimulus: the photograph, and what the eye's views of it are made of; None where it was not kept.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup")
        scanpath.plot().savefig("scanpath.png")
        scanpath.save("scanpath.safetensors")
    """

    grid: Grid
    classes: tuple[str, ...]
    target: int | None
    cells: Tensor
    fixations: Tensor
    detections: tuple[Detections, ...]
    probabilities: Tensor
    values: Tensor
    found: bool
    posterior: Tensor | None = None
    presence: Tensor | None = None
    decision: Decision | None = None
    ending: Ending | None = None
    seconds: tuple[Mapping[str, float], ...] = ()
    stimulus: Stimulus | None = None

    def __len__(self) -> int:
        """Number of fixations, the start included."""
        return len(self.cells)

    @property
    def shifts(self) -> int:
        """Number of gaze shifts (saccades): fixations after the start."""
        return len(self) - 1

    def as_fixations(self, picture: str, subject: str = "semfov") -> Fixations:
        """The fixations alone, as people's are kept, for `semfov.data.fixations` to write and metrics to compare.

        Args:
            picture: its name.
            subject: who looked.
        """
        width, height = (int(side) for side in self.grid.extent)
        return Fixations(
            picture,
            subject,
            self.fixations.detach().double().cpu().numpy(),
            (width, height),
            target=None if self.target is None else self.classes[self.target],
            found=None if self.target is None else self.found,
        )

    @property
    def image(self) -> Tensor | None:
        """The photograph that was looked at, `(3, h, w)` in [0, 1], as far as it was kept."""
        return None if self.stimulus is None else self.stimulus.image

    def views(self) -> list[Tensor]:
        """What the eye was shown at each fixation: the foveated photograph, `(3, h, w)` each.

        Raises:
            InputError: the photograph was not kept.
        """
        if self.stimulus is None:
            raise InputError("scanpath: expected one with its stimulus (the agents' have one), got one without")
        return self.stimulus.views(self.fixations)

    def __repr__(self) -> str:
        """What came of it, where the gaze went, and what was seen last."""
        grid, cells = self.grid, [self._place(cell) for cell in self.cells.tolist()]
        path = cells if len(cells) <= 8 else [*cells[:6], "…", cells[-1]]
        width, height = grid.extent.tolist()
        of = f"{grid.columns} × {grid.rows} cells over {width:.0f} × {height:.0f} px"
        return "\n".join(
            [
                f"Scanpath: {describe(self)}. {why_it_ended(self)}".rstrip(),
                f"  at (column, row): {' '.join(path)} of {of}",
                f"  seen last: {self._seen(len(self) - 1)}",
            ]
        )

    def _repr_html_(self) -> str:
        """A page to step through, in a frame of its own."""
        return str(drawn_by("notebook")(self))

    def plot(self, ax: Axes | None = None, **options: Any) -> Figure:
        """Draw the fixations on the photograph (`semfov.viz.plot_scanpath`).

        Args:
            ax: axes to draw in; None makes a figure.
            options: of `semfov.viz.plot_scanpath`.

        Raises:
            InputError: there is no photograph, neither kept nor given as `image=`.
        """
        figure: Figure = drawn_by("plot")(self, ax=ax, **options)
        return figure

    def animate(self, path: str | PathLike[str] | None = None, **options: Any) -> Path | Any:
        """Draw the episode as a film, one frame for each fixation.

        Args:
            path: of a GIF to write; None gives the film to be shown in a notebook.
            options: `seconds` that a frame stays, `hold` that the last stays longer, and `boxes` `(M, 4)` where the
                target really is.

        Returns:
            The path, or an object that a notebook shows as a film.

        Raises:
            InputError: the photograph was not kept.
        """
        return drawn_by("animate")(self, path, **options)

    def rows(self) -> list[dict[str, Any]]:
        """What was done, a row of plain values for each fixation.

        `probability` is that of the target in the fixated cell, `highest` the greatest of all cells, and `presence`
        that the image holds the target; None where nothing was searched for. `seen` is the most confident detection,
        with its `score`, of `detections` in all.
        """
        belief = self.posterior
        if belief is None and self.target is not None:
            belief = self.probabilities[..., self.target]
        rows = []
        for number, (cell, (x, y)) in enumerate(zip(self.cells.tolist(), self.fixations.tolist(), strict=True)):
            seen = self.detections[number]
            row, column = divmod(cell, self.grid.columns)
            some = int(seen.count.sum()) > 0
            rows.append(
                {
                    "fixation": number,
                    "cell": cell,
                    "column": column,
                    "row": row,
                    "x": x,
                    "y": y,
                    "probability": None if belief is None else float(belief[number, cell]),
                    "highest": None if belief is None else float(belief[number].max()),
                    "highest_cell": None if belief is None else int(belief[number].argmax()),
                    "presence": None if self.presence is None else float(self.presence[number]),
                    "detections": int(seen.count.sum()),
                    "seen": self.classes[int(seen.labels.flatten()[0])] if some else None,
                    "score": float(seen.confidence.flatten()[0]) if some else None,
                    "seconds": sum(self.seconds[number].values()) if self.seconds else None,
                }
            )
        return rows

    def to_frame(self) -> pandas.DataFrame:
        """`rows` as a pandas table.

        Raises:
            InputError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise InputError("pandas: expected the package, got none; pip install pandas, or take rows()") from None
        return pandas.DataFrame(self.rows())

    def save(self, path: str | PathLike[str]) -> None:
        """Write everything to one safetensors file, the photograph too where it was kept, whole or not at all.

        Raises:
            DataError: the file cannot be written.
        """
        write_fields(path, vars(self))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """The scanpath that `save` wrote; nothing in the file is executed.

        Raises:
            DataError: the file is missing, damaged or no scanpath.
        """
        return cls(**read_fields(path))

    def _place(self, cell: int) -> str:
        row, column = divmod(cell, self.grid.columns)
        return f"({column}, {row})"

    def _seen(self, fixation: int, most: int = 3) -> str:
        """The most confident detections of a look, in words."""
        seen = self.detections[fixation]
        pairs = list(zip(seen.labels.flatten().tolist(), seen.confidence.flatten().tolist(), strict=True))
        count = int(seen.count.sum())
        named = [f"{self.classes[label]} {score:.2f}" for label, score in pairs[: min(count, most)]]
        return ", ".join(named) + (f" and {count - most} more" if count > most else "") if named else "nothing"


def why_it_ended(scanpath: Scanpath) -> str:
    """Why an episode ended, in a sentence; nothing where that is not known."""
    if scanpath.ending == "decision" and scanpath.decision is not None:
        return {
            "found": "The target is probable enough, and was looked at closely enough.",
            "absent": "No cell is left that is worth a look, and the target is rather not there.",
            "undecided": "No cell is left that is worth a look, but the target rather is there.",
        }[scanpath.decision.outcome]
    reasons = {
        "box": "The gaze is on a box of the target.",
        "price": "No look is expected to name enough more cells right.",
        "shifts": f"All {scanpath.shifts} gaze shifts were made.",
        "cells": "Every cell was fixated.",
    }
    return reasons.get(scanpath.ending or "", "")


def describe(scanpath: Scanpath) -> str:
    """What came of an episode, in a line."""
    shifts = f"{scanpath.shifts} gaze shift{'s' if scanpath.shifts != 1 else ''}"
    if scanpath.target is None:
        return f"explored with {shifts}"
    name, decision = scanpath.classes[scanpath.target], scanpath.decision
    if decision is None:
        return f"“{name}” {'found after' if scanpath.found else 'not found in'} {shifts}"
    sure = f"probability {decision.probability:.2f}"
    if decision.outcome == "found":
        return f"“{name}” found after {shifts} ({sure})"
    return f"“{name}” {'not there' if decision.outcome == 'absent' else 'undecided'} after {shifts} ({sure})"
