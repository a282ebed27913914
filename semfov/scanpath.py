"""The record of an episode: where the gaze went, what was seen and what was believed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Literal, get_args

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Observer
from semfov.data.fixations import Fixations
from semfov.decision import Decision, Outcome
from semfov.detection.detections import Detections
from semfov.episode import Step
from semfov.errors import DataError, InputError, check
from semfov.io.schema import Anything, Array, Field, Maybe, Number, Object, Schema, Text
from semfov.io.storage import read, write

Ending = Literal["box", "decision", "price", "shifts", "cells"]
"""Why an episode ended: the gaze was on a given box, the search decided, no look was worth its price, all gaze shifts
were made, or every cell was fixated."""

_KIND = "scanpath"
_COUNT = Number(low=0)
_FILE = Schema(
    {
        "cells": Field(("n",), torch.int64, low=0),
        "fixations": Field(("n", 2)),
        "boxes": Field(("M", 4)),
        "scores": Field(("M", "C"), low=0, high=1),
        "count": Field(("n",), torch.int64, low=0),
        "probabilities": Field(("n", "X·Y", "C"), low=0),
        "values": Field(("n", "X·Y")),
        "posterior": Field(("n", "X·Y"), low=0, optional=True),
        "presence": Field(("n",), low=0, optional=True),
        "box": Field((4,), optional=True),
    },
    {
        "classes": Array(Text(), "C", least=2, distinct=True),
        "grid": Array(Number(low=1), 4),
        "target": Maybe(_COUNT),
        "found": Anything(),
        "ending": Maybe(Text(get_args(Ending))),
        "decision": Maybe(
            Object({"outcome": Text(get_args(Outcome)), "probability": Number(0, 1), "cell": Maybe(_COUNT)})
        ),
        "seconds": Array(Object(others=_COUNT)),
    },
)


@dataclass(frozen=True)
class Scanpath:
    """Fixations of one episode in order, with what was seen and believed at each.

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

    def __len__(self) -> int:
        """Number of fixations, the start included."""
        return len(self.cells)

    @property
    def shifts(self) -> int:
        """Number of gaze shifts (saccades): fixations after the start."""
        return len(self) - 1

    def save(self, path: str | PathLike[str]) -> None:
        """Write the whole record to one file (safetensors), atomically and with a checksum.

        Raises:
            DataError: the file cannot be written.
        """
        count = torch.tensor([int(seen.mask.sum()) for seen in self.detections])
        tensors = {
            "cells": self.cells,
            "fixations": self.fixations,
            "boxes": torch.cat([seen.boxes[seen.mask] for seen in self.detections]),
            "scores": torch.cat([seen.scores[seen.mask] for seen in self.detections]),
            "count": count,
            "probabilities": self.probabilities,
            "values": self.values,
        }
        more = {"posterior": self.posterior, "presence": self.presence}
        tensors |= {name: tensor for name, tensor in more.items() if tensor is not None}
        decided = None
        if self.decision is not None:
            decided = {name: getattr(self.decision, name) for name in ("outcome", "probability", "cell")}
            if self.decision.box is not None:
                tensors["box"] = self.decision.box
        record = {
            "kind": _KIND,
            "grid": [self.grid.columns, self.grid.rows, *(int(side) for side in self.grid.extent)],
            "classes": list(self.classes),
            "target": self.target,
            "found": self.found,
            "ending": self.ending,
            "decision": decided,
            "seconds": [dict(each) for each in self.seconds],
        }
        write(path, tensors, record)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Scanpath:
        """A scanpath that `save` wrote.

        Raises:
            DataError: the file is missing, damaged, or holds something else.
        """
        tensors, record = read(path, _KIND)
        try:
            _FILE.check(tensors, {name: value for name, value in record.items() if name != "kind"})
            check(isinstance(record["found"], bool), "found", "true or false", record["found"])
            columns, rows, width, height = record["grid"]
            check(int(tensors["count"].sum()) == len(tensors["boxes"]), "count", "as many as boxes", "others")
            grid = Grid(columns, rows, (width, height))
            check(len(grid) == tensors["values"].shape[1], "grid", "as many cells as values", len(grid))
        except InputError as error:
            raise DataError(f"{path}: {error}") from None
        decided = record["decision"]
        ends = tensors["count"].cumsum(0).tolist()
        seen = [slice(end - many, end) for end, many in zip(ends, tensors["count"].tolist(), strict=True)]
        return cls(
            grid=grid,
            classes=tuple(record["classes"]),
            target=record["target"],
            cells=tensors["cells"],
            fixations=tensors["fixations"],
            detections=tuple(_view(tensors["boxes"][part], tensors["scores"][part]) for part in seen),
            probabilities=tensors["probabilities"],
            values=tensors["values"],
            found=record["found"],
            posterior=tensors.get("posterior"),
            presence=tensors.get("presence"),
            decision=None if decided is None else Decision(**decided, box=tensors.get("box")),
            ending=record["ending"],
            seconds=tuple(record["seconds"]),
        )

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


def _view(boxes: Tensor, scores: Tensor) -> Detections:
    return Detections(boxes[None], scores[None], torch.ones(1, len(boxes), dtype=torch.bool))


def trace(
    steps: Iterable[Step], grid: Grid, classes: tuple[str, ...], target: int | None, beside: Observer | None
) -> Scanpath:
    """The scanpath of one episode.

    Args:
        steps: of the episode, from `semfov.episode.rollout`.
        grid: the cells.
        classes: names of the classes, background first.
        target: class that is searched for; None for exploration.
        beside: observer that keeps a map of all classes; None where the episode's own belief is one.
    """
    cells, fixations, detections, maps, values, present, anywhere, seconds = [], [], [], [], [], [], [], []
    known: Belief | None = None
    for step in steps:
        if beside is None:
            known = step.belief
        else:
            before = beside.start(1, grid, step.values) if known is None else known
            known = beside(before, step.detections, step.fixation, grid)
        cells.append(step.cell)
        fixations.append(step.fixation)
        detections.append(step.detections)
        maps.append(known.class_probabilities()[0])
        values.append(step.values[0])
        seconds.append(step.seconds)
        if target is not None:
            present.append(step.belief.probability(target)[0])
            anywhere.append(step.belief.presence(target)[0])
    return Scanpath(
        grid=grid,
        classes=classes,
        target=target,
        cells=torch.cat(cells),
        fixations=torch.cat(fixations),
        detections=tuple(detections),
        probabilities=torch.stack(maps),
        values=torch.stack(values),
        found=False,
        posterior=torch.stack(present) if present else None,
        presence=torch.stack(anywhere) if anywhere else None,
        seconds=tuple(seconds),
    )
