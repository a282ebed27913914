"""Training examples for target evidence: the looks from every cell of a photograph, and the true cells of a class."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.look_features import highest_score, look_features
from semfov.belief.observers import Observer
from semfov.belief.observers.base import own
from semfov.belief.observers.target import Target, TargetLook
from semfov.detection.detections import Detections
from semfov.episode import Looks, Sight
from semfov.errors import DataError
from semfov.runs.looking import Looking
from semfov.runs.progress import track
from semfov.runs.search_protocol import choose_classes


@dataclass(frozen=True)
class Examples:
    """One example for each pair of photograph and class to search for. The class may be absent.

    Attributes:
        features: `(E, X·Y, X·Y, F)`, `look_features` of the looks from every cell, in half precision.
        score: `(E, X·Y)`, highest score of the class in the look from each cell.
        distance: `(E, X·Y, X·Y)`, distance from every cell to every cell, in units of the image's longer side.
        goal: `(E, X·Y)` boolean, cells that an object of the class overlaps; all False if the class is absent.
        target: `(E,)`, the class.
        scene: `(E,)`, index of the photograph.
    """

    features: Tensor
    score: Tensor
    distance: Tensor
    goal: Tensor
    target: Tensor
    scene: Tensor

    def __len__(self) -> int:
        return len(self.scene)

    def __getitem__(self, index: Tensor) -> Examples:
        """Select examples by index or mask."""
        return Examples(*(getattr(self, field.name)[index] for field in fields(self)))


class ExampleLooks(Looks):
    """Looks at many photographs at once, with one episode for each photograph.

    Args:
        examples: the examples, one for each episode.
        grid: the grid of cells, of the examples' size.
    """

    def __init__(self, examples: Examples, grid: Grid) -> None:
        self.examples, self.grid = examples, grid
        self.like = examples.score

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """Look up the looks from some cells, processed by the model in training."""
        known, model = self.examples, own(observer, Target, "observer").model
        evidence = model.evidence(known.features[episodes, cell].float())
        look = TargetLook(
            evidence,
            known.distance[episodes, cell],
            known.score[episodes, cell],
            cell,
            known.target[episodes],
            self.grid.columns,
        )
        return Sight(look, no_detections, {})


def no_detections() -> Detections:
    """Raise an error: examples store features of detections, but not the detections."""
    raise NotImplementedError("examples store features of detections, not the detections")


def make_examples(
    run: Looking,
    classes: int,
    max_area: float,
    seed: int,
    *,
    absent: int | None = None,
    scenes: Sequence[int] | None = None,
) -> Examples:
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
    parts = []
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
            parts.append((features, score, grid.cell_distance, goal, torch.tensor(target), torch.tensor(index)))
    if not parts:
        raise DataError("data: no photograph has a class that may be searched for; raise max_target_area")
    return Examples(*(torch.stack(column) for column in zip(*parts, strict=True)))
