"""Training examples for the map of all classes: the looks from every cell, and the true cells of some classes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.look_features import class_features, highest_score
from semfov.belief.observers import LearnedMap, MapLook, Observer
from semfov.belief.observers.base import own
from semfov.errors import DataError
from semfov.fit.examples import Examples
from semfov.metrics.exploration import answers_of
from semfov.runs.looking import Looking
from semfov.runs.progress import track
from semfov.runs.seeds import generator_for


@dataclass(frozen=True)
class MapExamples(Examples):
    """One example for each photograph, with T classes: present ones, those with the highest scores, and a few others.

    Attributes:
        features: `(E, X·Y, T, X·Y, F)`, `class_features` of the looks from every cell, in half precision.
        score: `(E, X·Y, T)`, highest score of each class in the look from each cell.
        answers: `(E, X·Y, T+1)` boolean, whether a cell is background (first), and whether an object of each class
            overlaps it.
        targets: `(E, T)`, the classes.
        stands_for: `(E, T)`, number of classes that each class represents.
    """

    answers: Tensor
    targets: Tensor
    stands_for: Tensor

    def look(self, observer: Observer, episodes: Tensor, cell: Tensor, columns: int) -> MapLook:
        """Process stored looks with the model in training; see `Examples.look`."""
        return MapLook(
            own(observer, LearnedMap, "observer").model.evidence(self.features[episodes, cell].float()),
            self.distance[episodes, cell],
            self.score[episodes, cell],
            cell,
            self.targets[episodes],
            columns,
            self.stands_for[episodes],
        )


def make_map_examples(run: Looking, classes: int, others: int, seed: int) -> MapExamples:
    """Make examples from all photographs with objects.

    Args:
        run: the finished looks from every cell.
        classes: number of classes in each example: the present ones, then those with the highest scores, then random
            ones.
        others: number of random classes. Together they represent all classes that are not in the example.
        seed: seed of the random choice.

    Returns:
        The examples.

    Raises:
        DataError: no photograph has an object.
    """
    rows = []
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
        row = features, score[:, chosen], grid.cell_distance, torch.tensor(index), answers, every[chosen], stands_for
        rows.append(row)
    if not rows:
        raise DataError("data: none of the photographs contains an object; raise data.limit or give other photographs")
    return MapExamples(*(torch.stack(column) for column in zip(*rows, strict=True)))
