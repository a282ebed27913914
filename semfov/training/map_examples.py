"""Photographs to learn a map from: what looks from every cell show of some classes, and where those really are."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.look_features import class_features, highest_score
from semfov.belief.observers import LearnedMap, MapLook, Observer
from semfov.belief.observers.base import own
from semfov.episode import Looks, Sight
from semfov.errors import DataError
from semfov.experiments.progress import track
from semfov.experiments.seeds import generator_for
from semfov.metrics.exploration import answers_of
from semfov.training.evidence_examples import LookingRun, no_detections


@dataclass(frozen=True)
class MapExamples:
    """One example for each photograph, with T of its classes: those that it holds or seems to, and a few others.

    Attributes:
        features: `(E, X·Y, T, X·Y, F)`, of `class_features`, for looks from every cell; half precision.
        score: `(E, X·Y, T)`, highest score of each class in looks from every cell.
        distance: `(E, X·Y, X·Y)`, from every cell to every cell, in longer sides.
        answers: `(E, X·Y, T+1)` boolean, classes of the objects that overlap a cell; the first is that none does.
        targets: `(E, T)`, the classes.
        stands_for: `(E, T)`, how many classes of the photograph each one stands for.
        scene: `(E,)`, index of the photograph.
    """

    features: Tensor
    score: Tensor
    distance: Tensor
    answers: Tensor
    targets: Tensor
    stands_for: Tensor
    scene: Tensor

    def __len__(self) -> int:
        return len(self.scene)

    def __getitem__(self, index: Tensor) -> MapExamples:
        """Some of the examples."""
        return MapExamples(*(getattr(self, field.name)[index] for field in fields(self)))


class MapExampleLooks(Looks):
    """Looks at many photographs at once, an episode at each.

    Args:
        examples: the photographs, one for each episode.
        grid: cells, as many as theirs.
    """

    def __init__(self, examples: MapExamples, grid: Grid) -> None:
        self.examples, self.grid = examples, grid
        self.like = examples.score

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """What looks from the cells show, weighed by the model that is being trained."""
        known, model = self.examples, own(observer, LearnedMap, "observer").model
        look = MapLook(
            model.evidence(known.features[episodes, cell].float()),
            known.distance[episodes, cell],
            known.score[episodes, cell],
            cell,
            known.targets[episodes],
            self.grid.columns,
            known.stands_for[episodes],
        )
        return Sight(look, no_detections, {})


def make_map_examples(run: LookingRun, classes: int, others: int, seed: int) -> MapExamples:
    """Examples from all photographs of a run that hold an object.

    Args:
        run: that has looked.
        classes: how many of each photograph: those that it holds, then those with the highest scores, then others.
        others: how many of these are drawn at random; together they stand for all the rest.
        seed: of the draw.
    """
    parts = []
    components = len(run.scenes.classes) + 1
    for index in track(range(len(run.scenes)), "describing looks", "scene"):
        annotation, grid = run.scenes.annotation(index), run.grid(index)
        if not len(annotation.labels):
            continue
        detections = run.detections(index)
        every = torch.arange(1, components)
        score = highest_score(detections, every)
        held = torch.isin(every, annotation.labels)
        order = (score.amax(0) + 2 * held).argsort(descending=True)
        chosen, rest = order[: classes - others], order[classes - others :]
        drawn = torch.randperm(len(rest), generator=generator_for("others", seed, run.scenes.ids[index]))[:others]
        chosen = torch.cat([chosen, rest[drawn]])
        stands_for = torch.ones(len(chosen))
        stands_for[classes - others :] = len(rest) / max(len(drawn), 1)
        with torch.inference_mode():
            features = torch.cat(
                [
                    class_features(detections[place], grid.centres[place], grid, every[chosen]).half()
                    for place in torch.arange(len(grid)).split(10)
                ]
            )
        answers = answers_of(annotation, grid, components)
        answers = torch.cat([~answers.any(-1, keepdim=True), answers[:, every[chosen]]], -1)
        row = features, score[:, chosen], grid.cell_distance, answers, every[chosen], stands_for, torch.tensor(index)
        parts.append(row)
    if not parts:
        raise DataError("data: no photograph has an object; lower data.min_instances or raise data.limit")
    return MapExamples(*(torch.stack(column) for column in zip(*parts, strict=True)))
