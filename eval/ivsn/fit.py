"""Fit class templates: `python -m eval.ivsn.fit` averages a detector's features over the objects of each class.

    python -m eval.ivsn.fit --data.root DIR --data.annotations instances.json --out runs/fit_templates

Every photograph is passed through the detector once, without foveation, and the features at the centres of the
annotated objects are averaged. The folder `out` gets the model and a report on held-out photographs; use the model with
`python -m eval.ivsn --templates FILE`. Without photographs, the command uses the embedded scenes.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor
from tqdm import tqdm

from eval.ivsn.templates import ClassTemplates, at_points, unit
from semfov.belief.grid import Grid
from semfov.data.scene import Annotation, Scenes
from semfov.detection.detector import Detector
from semfov.errors import DataError
from semfov.fit.settings import FitConfig
from semfov.fit.training import training_of
from semfov.io.ranges import Range
from semfov.runs.command import command
from semfov.runs.config import DetectorConfig
from semfov.runs.setup import make_detector, make_scenes
from semfov.runs.tables import table
from semfov.runs.workers import prepare_worker
from train.outputs import model_path, write_outputs


@dataclass(frozen=True)
class FitTemplatesConfig(FitConfig):
    """Average a detector's features over the objects of each class.

    Args:
        detector: the detector that computes the features (one of the YOLOv3 family).
        holdout: one in every n photographs is held out for the evaluation.
    """

    unused = ("sensor", "seed", "cache", "workers", "scheduler")
    detector: DetectorConfig = field(default_factory=lambda: DetectorConfig("yolov3-tiny"))
    holdout: Annotated[int, Range(2, 10**9)] = 10
    out: Path = Path("runs/fit_templates")


class _TemplateSums:
    """Sums of the features of objects and of all positions."""

    def __init__(self, classes: int, channels: int) -> None:
        self.objects = torch.zeros(classes, channels, dtype=torch.float64)
        self.counts = torch.zeros(classes, dtype=torch.int64)
        self.everywhere = torch.zeros(channels, dtype=torch.float64)
        self.places = 0

    def update(self, features: Tensor, objects: Tensor, labels: Tensor) -> None:
        """Add a photograph.

        Shapes: features `(C, h, w)`, objects `(M, C)`, labels `(M,)`.
        """
        self.everywhere += features.double().sum((1, 2))
        self.places += features[0].numel()
        self.objects.index_add_(0, labels - 1, objects.double())
        self.counts += torch.bincount(labels - 1, minlength=len(self.counts))

    def templates(self) -> tuple[Tensor, Tensor]:
        """Compute the templates.

        Shapes: → `(K, C)`.
        """
        mean = self.everywhere / max(1, self.places)
        centred = self.objects / self.counts.clamp(min=1)[:, None] - mean
        return torch.where(self.counts[:, None] > 0, centred, 0.0).float(), mean.float()


def fit_templates(config: FitTemplatesConfig) -> None:
    """Average the objects of all photographs that are not held out, evaluate, and write all results."""
    prepare_worker()
    detector = make_detector(config.detector).eval().requires_grad_(False)
    scenes = make_scenes(config.data, detector.classes)
    held_out = list(range(0, len(scenes), config.holdout))
    fitted = [index for index in range(len(scenes)) if index % config.holdout]
    if not fitted:
        raise DataError(
            f"data: expected at least 2 photographs, one to train on and one to hold out, got {len(scenes)}"
        )
    sums: _TemplateSums | None = None
    for index in tqdm(fitted, desc="averaging objects", unit="photograph", dynamic_ncols=True):
        features, objects, labels = _objects_of(detector, scenes, index)
        sums = sums or _TemplateSums(len(detector.classes), len(features))
        sums.update(features, objects, labels)
    assert sums is not None
    metadata = {"detector": detector.settings(), "counts": sums.counts.tolist(), **training_of(config, scenes)}
    model = ClassTemplates(*sums.templates(), detector.classes, metadata=metadata).eval()
    areas = [
        area
        for index in tqdm(held_out, desc="evaluating", unit="photograph", dynamic_ncols=True)
        for area in _areas_under_roc(model, detector, scenes, index)
    ]
    path = model_path(config, detector.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    model.save(path)
    mean = sum(areas) / max(1, len(areas))
    text = "\n".join(
        [
            f"Templates of {int((sums.counts > 0).sum())} classes from {int(sums.counts.sum())} objects in "
            f"{len(fitted)} photographs. The area under the ROC curve measures how well attention to a class in the "
            "sharp photograph separates the cells of its objects from other cells. The mean is over "
            f"{len(areas)} pairs of photograph and class in {len(held_out)} held-out photographs:",
            "",
            *table([["mean area under the ROC"], [f"{mean:.3f}"]]),
            "",
        ]
    )
    write_outputs(config, text, {"areas.json": json.dumps({"mean": mean, "areas": areas}) + "\n"}, path)


def _objects_of(detector: Detector, scenes: Scenes, index: int) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the features of a photograph and of its objects, normalised to unit length.

    Shapes: → `(C, h, w)`.
    """
    with torch.inference_mode():
        canvas, placement = detector.fit(scenes[index].image[None])
        features = unit(detector.head_input(canvas))
        annotation = scenes.annotation(index)
        centres = (annotation.boxes[:, :2] + annotation.boxes[:, 2:]) / 2 - 0.5
        size = canvas.shape[-1], canvas.shape[-2]
        return features[0], at_points(features, centres, placement, size)[0].t(), annotation.labels


def _areas_under_roc(model: ClassTemplates, detector: Detector, scenes: Scenes, index: int) -> list[float]:
    """Compute the area under the ROC curve for each class in a photograph.

    The area is the probability that a cell with the class gets more attention than a cell without it. Ties count half.
    """
    annotation: Annotation = scenes.annotation(index)
    grid = Grid(10, 10, annotation.size)
    covered = grid.footprint(annotation.boxes)
    with torch.inference_mode():
        canvas, placement = detector.fit(scenes[index].image[None])
        maps = model(detector.head_input(canvas))
        attention = at_points(maps, grid.centres, placement, (canvas.shape[-1], canvas.shape[-2]))[0]
    areas = []
    for label in annotation.labels.unique().tolist():
        goal = covered[annotation.labels == label].any(0)
        if goal.any() and not goal.all():
            held, others = attention[label - 1, goal], attention[label - 1, ~goal]
            more = (held[:, None] > others).double() + 0.5 * (held[:, None] == others).double()
            areas.append(float(more.mean()))
    return areas


main = command(fit_templates, FitTemplatesConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
