"""Training examples for target evidence: the looks from every cell of a photograph, and the true cells of a class."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.look_features import highest_score, look_features
from semfov.belief.observers import Observer
from semfov.belief.observers.base import own
from semfov.belief.observers.target import Target, TargetLook
from semfov.errors import DataError
from semfov.fit.examples import Examples
from semfov.runs.looking import Looking
from semfov.runs.progress import track
from semfov.runs.search_protocol import choose_classes


@dataclass(frozen=True)
class TargetExamples(Examples):
    """One example for each pair of photograph and class to search for. The class may be absent.

    Attributes:
        features: `(E, X·Y, X·Y, F)`, `look_features` of the looks from every cell, in half precision.
        score: `(E, X·Y)`, highest score of the class in the look from each cell.
        goal: `(E, X·Y)` boolean, cells that an object of the class overlaps; all False if the class is absent.
        target: `(E,)`, the class.
    """

    goal: Tensor
    target: Tensor

    def look(self, observer: Observer, episodes: Tensor, cell: Tensor, columns: int) -> TargetLook:
        """Process stored looks with the model in training; see `Examples.look`."""
        return TargetLook(
            own(observer, Target, "observer").model.evidence(self.features[episodes, cell].float()),
            self.distance[episodes, cell],
            self.score[episodes, cell],
            cell,
            self.target[episodes],
            columns,
        )


def make_examples(
    run: Looking,
    classes: int,
    max_area: float,
    seed: int,
    *,
    absent: int | None = None,
    scenes: Sequence[int] | None = None,
) -> TargetExamples:
    """Make examples from photographs for present and for absent classes.

    Args:
        run: the finished looks from every cell.
        classes: maximum number of present classes in a photograph.
        max_area: classes that cover a larger share of the image are left out.
        seed: seed of the random choice of classes.
        absent: maximum number of absent classes in a photograph (None: as many as present ones).
        scenes: indices of the photographs (None: all).

    Returns:
        The examples.

    Raises:
        DataError: no photograph has a class that may be searched for.
    """
    rows = []
    for index in track(range(len(run.scenes)) if scenes is None else scenes, "describing looks", "scene"):
        annotation, grid = run.scenes.annotation(index), run.grid(index)
        covered = grid.footprint(annotation.boxes)
        chosen = choose_classes(run.scenes, index, annotation, classes, max_area, seed, absent)
        detections = run.detections(index) if chosen else None
        for target in chosen:
            assert detections is not None
            goal = covered[annotation.labels == target].any(0)
            if goal.all():
                continue
            with torch.inference_mode():
                features = look_features(detections, grid.centres, grid, target).half()
            score = highest_score(detections, target)
            row = features, score, grid.cell_distance, torch.tensor(index), goal, torch.tensor(target)
            rows.append(row)
    if not rows:
        raise DataError("data: no photograph has a class that may be searched for; raise max_target_area")
    return TargetExamples(*(torch.stack(column) for column in zip(*rows, strict=True)))
