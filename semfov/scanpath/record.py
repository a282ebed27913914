"""The record of an episode: fixations, detections, beliefs and the decision."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal, Self

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.decision import CloserLook, Decision
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
"""Reason for the end of an episode: the gaze was on a given box, the search decided, no look was worth its price, all
gaze shifts were made, or every cell was fixated."""


@dataclass(frozen=True)
class Scanpath:
    """Fixations of one episode in order, with the detections and the belief at each of them.

    A notebook shows a scanpath as an interactive page. `plot`, `animate`, `to_frame` and `save` make a picture, an
    animation, a table and a file.

    Attributes:
        grid: the cells of the image.
        classes: names of the classes, background first, in the order of the belief's components.
        target: class index 1..K that was searched for; None for exploration.
        cells: `(n,)`, fixated cells.
        fixations: `(n, 2)`, centres of the fixated cells as `(x, y)` in pixels.
        detections: detections from each fixation, batches of one.
        probabilities: `(n, X·Y, K+1)`, probability that each cell holds each class after each look, background first.
            A learned map gives marginal probabilities: several classes can share a cell, so they need not sum to 1.
        values: `(n, X·Y)`, values of the acquisition function, by which the next fixation was chosen.
        found: whether the search found its target.
        posterior: `(n, X·Y)`, probability of the target in each cell after each look, by the belief of the search; None
            for exploration.
        presence: `(n,)`, probability that the image holds the target after each look; None for exploration.
        decision: decision of the search; None for exploration, and for a search that ended on a given box.
        closer: closer looks of a search, in order (`semfov.decision.Verifier`).
        ending: reason for the end; None if it is not known.
        seconds: time of each look by stage (`semfov.episode.STAGES`).
        stimulus: the photograph, and the data for the foveated views of it; None if it was not kept.

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
    closer: tuple[CloserLook, ...] = ()
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
        """The fixations in the format of human data, to write with `semfov.data.fixations` or to compare by metrics.

        Args:
            picture: name of the picture.
            subject: name of the observer.

        Returns:
            The fixations, with the target of a search and whether it was found.
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
        """The photograph, `(3, h, w)` in [0, 1]; None if it was not kept."""
        return None if self.stimulus is None else self.stimulus.image

    def views(self) -> list[Tensor]:
        """The foveated photograph at each fixation.

        Returns:
            One view `(3, h, w)` in [0, 1] for each fixation.

        Raises:
            InputError: the photograph was not kept.
        """
        if self.stimulus is None:
            raise InputError("scanpath: expected one with its stimulus, as an agent makes it, got one without")
        return self.stimulus.views(self.fixations)

    def __repr__(self) -> str:
        """The outcome, the fixated cells and the detections of the last look."""
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
        """The interactive page, in a frame."""
        return str(drawn_by("notebook")(self))

    def plot(self, ax: Axes | None = None, **options: Any) -> Figure:
        """Draw the fixations on the photograph (`semfov.viz.plot_scanpath`).

        Args:
            ax: axes to draw in; None makes a new figure.
            options: options of `semfov.viz.plot_scanpath`.

        Returns:
            The figure.

        Raises:
            InputError: the photograph was not kept, and none is given as `image=`.
        """
        figure: Figure = drawn_by("plot")(self, ax=ax, **options)
        return figure

    def animate(self, path: str | PathLike[str] | None = None, **options: Any) -> Path | Any:
        """Draw the episode as an animation, one frame for each fixation.

        Args:
            path: path of the GIF to write; None returns the animation for a notebook.
            options: `seconds`, the duration of a frame; `hold`, the additional duration of the last frame; and `boxes`
                `(M, 4)`, the true boxes of the target.

        Returns:
            The path, or an object that a notebook shows as an animation.

        Raises:
            InputError: the photograph was not kept.
        """
        return drawn_by("animate")(self, path, **options)

    def rows(self) -> list[dict[str, Any]]:
        """The episode as a table of plain values, one row for each fixation.

        `probability` is the probability of the target in the fixated cell, `highest` the largest one of all cells, and
        `presence` the probability that the image holds the target; all are None for exploration. `detections` is the
        number of detections, `seen` the class of the most confident one, and `score` its confidence.

        Returns:
            One dictionary for each fixation.
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
        """The table of `rows` as a pandas data frame.

        Returns:
            One row for each fixation.

        Raises:
            InputError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise InputError(
                "pandas: expected the package to be installed, got none; run pip install pandas, or use rows()"
            ) from None
        return pandas.DataFrame(self.rows())

    def save(self, path: str | PathLike[str]) -> None:
        """Write the scanpath to a safetensors file, with the photograph if it was kept; atomically.

        Args:
            path: the file.

        Raises:
            DataError: the file cannot be written.
        """
        write_fields(path, vars(self))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Load a scanpath that `save` wrote; nothing in the file is executed.

        Args:
            path: the file.

        Returns:
            The scanpath.

        Raises:
            DataError: the file is missing or damaged, or holds no scanpath.
        """
        return cls(**read_fields(path))

    def _place(self, cell: int) -> str:
        row, column = divmod(cell, self.grid.columns)
        return f"({column}, {row})"

    def _seen(self, fixation: int, most: int = 3) -> str:
        """The most confident detections of a look, as text."""
        seen = self.detections[fixation]
        pairs = list(zip(seen.labels.flatten().tolist(), seen.confidence.flatten().tolist(), strict=True))
        count = int(seen.count.sum())
        named = [f"{self.classes[label]} {score:.2f}" for label, score in pairs[: min(count, most)]]
        return ", ".join(named) + (f" and {count - most} more" if count > most else "") if named else "nothing"


def why_it_ended(scanpath: Scanpath) -> str:
    """Explain in one sentence why an episode ended.

    Args:
        scanpath: the episode.

    Returns:
        The sentence; empty if the reason is not known.

    >>> import torch
    >>> grid, none = Grid(2, 1, (10, 10)), torch.zeros(2, 2)
    >>> path = Scanpath(grid, ("background", "cup"), 1, torch.arange(2), none, (), none, none, True, ending="box")
    >>> why_it_ended(path)
    'The gaze is on a box of the target.'
    """
    if scanpath.closer and scanpath.found:
        return "A closer look confirmed the target."
    if scanpath.ending == "decision" and scanpath.decision is not None:
        if scanpath.closer and scanpath.decision.outcome == "undecided":
            return "No closer look confirmed the target, but it is probably there."
        return {
            "found": "The target is probable enough, and was looked at closely enough.",
            "absent": "No remaining cell is worth a look, and the target is probably absent.",
            "undecided": "No remaining cell is worth a look, but the target is probably there.",
        }[scanpath.decision.outcome]
    reasons = {
        "box": "The gaze is on a box of the target.",
        "price": "No look is expected to classify enough more cells correctly.",
        "shifts": f"All {scanpath.shifts} gaze shifts were made.",
        "cells": "Every cell was fixated.",
    }
    return reasons.get(scanpath.ending or "", "")


def describe(scanpath: Scanpath) -> str:
    """Describe the outcome of an episode in one line.

    Args:
        scanpath: the episode.

    Returns:
        The line.

    >>> import torch
    >>> grid, none = Grid(2, 1, (10, 10)), torch.zeros(2, 2)
    >>> describe(Scanpath(grid, ("background", "cup"), 1, torch.arange(2), none, (), none, none, found=True))
    '“cup” found after 1 gaze shift'
    """
    shifts = f"{scanpath.shifts} gaze shift{'s' if scanpath.shifts != 1 else ''}"
    if scanpath.target is None:
        return f"explored with {shifts}"
    name, decision = scanpath.classes[scanpath.target], scanpath.decision
    if decision is None:
        return f"“{name}” {'found after' if scanpath.found else 'not found in'} {shifts}"
    sure = f"probability {decision.probability:.2f}"
    if decision.place is not None:
        sure += f", {decision.place:.2f} at this place"
    if scanpath.closer:
        shifts += f" and {len(scanpath.closer)} closer look{'s' if len(scanpath.closer) != 1 else ''}"
    if decision.outcome == "found":
        return f"“{name}” found after {shifts} ({sure})"
    return f"“{name}” {'not there' if decision.outcome == 'absent' else 'undecided'} after {shifts} ({sure})"
