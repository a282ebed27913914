"""The cells that the objects of photographs occupy, from which context is counted."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import Scenes, legal_targets
from semfov.fit.settings import FitConfig
from semfov.runs.settings import Count, Positive, Range, Share, Side, SingleName, Weight, Whole


@dataclass(frozen=True)
class FitContextConfig(FitConfig):
    """Fit the context of searches.

    Args:
        name: name of the model.
        resolution: rows and columns of the grid on which places are counted.
        edges: borders between the bands of distance, in units of the image's longer side. The last band has no upper
            limit.
        max_target_area: a class that covers a larger share of an image is not learned as a target from that image.
        place_smoothing: weight of the average map over all classes in the map of a class, as a number of pictures.
        class_smoothing: weight of the average over all classes in the ratios of a class, as a number of cells.
        pair_smoothing: weight of the averages of two classes in the ratio of the pair, as a number of cells.
        holdout: one in every n photographs is held out for the evaluation.
        weigh: number of photographs to fit the weights on, evenly spaced among those that are not held out (0: the
            weights are 1).
        detector: the detector for fitting the weights.
        sensor: the foveal sensor for fitting the weights.
        fixations: random fixations in each photograph for fitting the weights.
        iou: must be the same as in `train.fit_fom` to share looks with it.
        seed: seed of the fixations and of the selection of looks.
        shard: number of photographs in a unit of work.
        folds: number of folds for fitting the weights, so that they are fitted on photographs that were not counted.
        min_objects: photographs with fewer objects are used neither to fit the weights nor for the evaluation.
        cache: folder for the looks (None: `out`).
        table: CSV table of classes by classes to use instead of counting (`ContextPrior.from_table`).
        source: where the table comes from (None: its file name).
        heights: CSV table of classes by heights in a picture, to use with `table`.
    """

    name: SingleName = "coco"
    resolution: Side = 10
    edges: tuple[Weight, ...] = (0.0, 0.15, 0.35)
    max_target_area: Positive = 0.2
    place_smoothing: Positive = 10.0
    class_smoothing: Positive = 100.0
    pair_smoothing: Positive = 20.0
    holdout: Annotated[int, Range(2, 10**9)] = 10
    weigh: Whole = 0
    fixations: Count = 8
    iou: Share = 0.5
    shard: Count = 32
    folds: Annotated[int, Range(2, 1000)] = 5
    min_objects: Whole = 4
    out: Path = Path("runs/fit_context")
    table: Path | None = None
    source: str | None = None
    heights: Path | None = None


@dataclass(frozen=True)
class ObjectPlaces:
    """The annotated objects of one photograph on a grid.

    Attributes:
        occupied: `(X·Y, K+1)` boolean, cells that objects of each class overlap.
        targets: classes that may be searched for.
        grid: the grid of cells.
        objects: number of objects.
    """

    occupied: Tensor
    targets: list[int]
    grid: Grid
    objects: int


def read_places(scenes: Scenes, config: FitContextConfig) -> list[ObjectPlaces]:
    """Find the cells that the objects of every photograph overlap."""
    places = []
    for index in range(len(scenes)):
        annotation = scenes.annotation(index)
        grid = Grid(config.resolution, config.resolution, annotation.size)
        covered = grid.footprint(annotation.boxes)
        occupied = torch.zeros(len(grid), len(scenes.classes) + 1, dtype=torch.bool)
        for label in annotation.labels.unique().tolist():
            occupied[:, label] = covered[annotation.labels == label].any(0)
        targets = [t for t in legal_targets(annotation, config.max_target_area) if not occupied[:, t].all()]
        places.append(ObjectPlaces(occupied, targets, grid, len(annotation.labels)))
    return places
