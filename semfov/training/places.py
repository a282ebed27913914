"""Where the objects of photographs are, as context is counted from."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import Scenes, legal_targets
from semfov.experiments.config import DataConfig, DetectorConfig, SensorConfig
from semfov.experiments.settings import (
    Count,
    Name,
    Positive,
    Range,
    Seed,
    Settings,
    Share,
    Side,
    Weight,
    Whole,
    Workers,
)


@dataclass(frozen=True)
class FitContextConfig(Settings):
    """Fit the context of searches.

    Args:
        data: photographs to learn from (all of them: no selection by number of objects).
        name: name of the model.
        resolution: cells in a row and in a column of the map of places.
        edges: borders of the bands of distance, in longer sides of the image; the last band is open.
        max_target_area: classes that cover a larger share of an image are not learned from as targets there.
        place_smoothing: weight of the map of all classes, in pictures.
        class_smoothing: weight of what holds for all classes in what holds for one, in cells.
        pair_smoothing: weight of what holds for either class in what holds for a pair, in cells.
        holdout: every n-th photograph is kept out and used to judge.
        weigh: photographs to fit the weights on, spread over all that are not held out (0: the weights are 1).
        detector: which detector looks.
        sensor: the foveal sensor.
        fixations: random fixations in each photograph.
        iou: as in `train.fit_fom`, for looks to be shared with it.
        seed: of the fixations, and of which looks are used.
        shard: photographs in a unit of work.
        folds: the weights are fitted on photographs that the prior beside them has not counted.
        min_objects: photographs with fewer objects are left out when weights are fitted, and judged.
        out: folder for the model and the report.
        cache: folder for the looks (None: `out`).
        workers: processes that look (None: one for each CPU core).
        table: CSV of classes by classes to take in place of counting (`ContextPrior.from_table`).
        source: where the table comes from (None: its name).
        heights: CSV of classes by heights in a picture, beside a table.
        embeddings: file of word vectors (GloVe's or word2vec's text) whose cosines make such a table.
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    name: Name = "coco"
    resolution: Side = 10
    edges: tuple[Weight, ...] = (0.0, 0.15, 0.35)
    max_target_area: Positive = 0.2
    place_smoothing: Positive = 10.0
    class_smoothing: Positive = 100.0
    pair_smoothing: Positive = 20.0
    holdout: Annotated[int, Range(2, 10**9)] = 10
    weigh: Whole = 0
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    fixations: Count = 8
    iou: Share = 0.5
    seed: Seed = 0
    shard: Count = 32
    folds: Annotated[int, Range(2, 1000)] = 5
    min_objects: Whole = 4
    out: Path = Path("runs/fit_context")
    cache: Path | None = None
    workers: Workers | None = None
    table: Path | None = None
    source: str | None = None
    heights: Path | None = None
    embeddings: Path | None = None


@dataclass(frozen=True)
class Places:
    """What annotations tell of one photograph.

    Attributes:
        occupied: `(X·Y, K+1)` boolean, cells that objects of each class overlap.
        targets: classes that may be searched for.
        grid: the cells.
        objects: number of objects.
    """

    occupied: Tensor
    targets: list[int]
    grid: Grid
    objects: int


def read_places(scenes: Scenes, config: FitContextConfig) -> list[Places]:
    """Which cells the objects of every photograph overlap."""
    places = []
    for index in range(len(scenes)):
        annotation = scenes.annotation(index)
        grid = Grid(config.resolution, config.resolution, annotation.size)
        covered = grid.footprint(annotation.boxes)
        occupied = torch.zeros(len(grid), len(scenes.classes) + 1, dtype=torch.bool)
        for label in annotation.labels.unique().tolist():
            occupied[:, label] = covered[annotation.labels == label].any(0)
        targets = [t for t in legal_targets(annotation, config.max_target_area) if not occupied[:, t].all()]
        places.append(Places(occupied, targets, grid, len(annotation.labels)))
    return places
