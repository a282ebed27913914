"""Photographs to learn evidence from: what looks from every cell show of a class, and where the class really is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

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
from semfov.experiments.config import BeliefConfig, SearchConfig
from semfov.experiments.parts import Record
from semfov.experiments.progress import track
from semfov.experiments.run import Run, finish
from semfov.experiments.search_protocol import choose_classes
from semfov.gaze.policies import Task


class LookingRun(Run):
    """Looks at every scene from every cell, and keeps what was seen; there are no episodes."""

    task: ClassVar[Task] = "search"

    def outcomes(self, index: int) -> tuple[list[Record], dict[str, float]]:
        """No records."""
        self.detections(index)
        return [], {}


def looking_run(config: Any) -> LookingRun:
    """A run that is to look at all photographs of a fit from every cell.

    Args:
        config: settings of the fit: data, detector, sensor, columns, rows, out, cache and workers.
    """
    return LookingRun(
        SearchConfig(
            data=config.data,
            detector=config.detector,
            sensor=config.sensor,
            belief=BeliefConfig(columns=config.columns, rows=config.rows),
            policies=("random",),
            out=config.out,
            cache=config.cache,
            workers=config.workers,
        )
    )


def looking(config: Any) -> LookingRun:
    """A run that has looked (`looking_run`)."""
    run = looking_run(config)
    finish(run, "looking")
    return run


@dataclass(frozen=True)
class Examples:
    """One example for each photograph and class to search for, the class in the photograph or not.

    Attributes:
        features: `(E, X·Y, X·Y, F)`, of `look_features`, for looks from every cell; half precision.
        score: `(E, X·Y)`, highest score of the class in looks from every cell.
        distance: `(E, X·Y, X·Y)`, from every cell to every cell, in longer sides.
        goal: `(E, X·Y)` boolean, cells that an object of the class overlaps; none where it is absent.
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
        """Some of the examples."""
        return Examples(*(getattr(self, field.name)[index] for field in fields(self)))


class ExampleLooks(Looks):
    """Looks at many photographs at once, an episode at each.

    Args:
        examples: the photographs, one for each episode.
        grid: cells, as many as theirs.
    """

    def __init__(self, examples: Examples, grid: Grid) -> None:
        self.examples, self.grid = examples, grid
        self.like = examples.score

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """What looks from the cells show, weighed by the model that is being trained."""
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
    """What examples have of detections: none, only what was made of them."""
    raise NotImplementedError("examples keep no detections")


def make_examples(
    run: LookingRun,
    classes: int,
    max_area: float,
    seed: int,
    *,
    absent: int | None = None,
    scenes: Sequence[int] | None = None,
) -> Examples:
    """Examples from photographs of a run: up to `classes` classes that are there, and as many that are not.

    Args:
        run: that has looked.
        classes: of each kind, at most.
        max_area: classes that cover a larger share of the image are left out.
        seed: of the choice of classes.
        absent: most classes that are not there; None: as many as there are of the others.
        scenes: indices of the photographs; None takes all.
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
