"""Comparison with SAHI, which cuts pictures into slices, on the same detector and pictures as `eval.zoom`.

    python -m benchmarks.sahi --mosaics 20
    python -m benchmarks.sahi --data.root DIR --data.annotations FILE --mosaics 0 --target person

SAHI (Akyon, Altinuc and Temizel, 2022) looks at every slice and at the whole picture, and merges the detections by its
own rules (`GREEDYNMM`, its default, or `NMS`). It always looks at all slices, so it has a single result: recall after
all of its passes. It is compared with the same slices, merged by `semfov.zoom.merge`, and with windows that semfov
chooses.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.tables import table
from eval.zoom.run import ZoomConfig, ZoomRun
from semfov.data.scene import Annotation
from semfov.detection.detector import Detector
from semfov.observation.matching import box_iou
from semfov.runs.command import run_command
from semfov.runs.looks import one_thread
from semfov.runs.zoom_orders import in_order
from semfov.zoom.episode import look_by_look
from semfov.zoom.gist import FOUND
from semfov.zoom.objects import merge
from semfov.zoom.search import find_everything
from semfov.zoom.slices import slices

try:
    from sahi.models.base import DetectionModel
    from sahi.predict import get_sliced_prediction
    from sahi.prediction import ObjectPrediction
except ImportError as error:
    # SAHI depends on opencv-python, which would overwrite the files of opencv-python-headless, but also runs with the
    # latter.
    raise ModuleNotFoundError(
        "benchmarks.sahi needs SAHI: pip install 'semfov[peers]' && pip install --no-deps sahi"
    ) from error


class Slicing(DetectionModel):
    """A semfov detector with the interface of SAHI.

    Args:
        detector: any detector.
        target: class 1..K whose own score counts, as in `merge`; None: the best class of each box.
        score: boxes with a lower score are left out.
    """

    def __init__(self, detector: Detector, target: int | None, score: float) -> None:
        names = {str(number): name for number, name in enumerate(detector.classes, 1)}
        self.target, self.passes = target, 0
        super().__init__(model=detector, device="cpu", confidence_threshold=score, category_mapping=names)

    def set_model(self, model: Any, **kwargs: Any) -> None:
        """Set the detector."""
        self.model = model

    def perform_inference(self, image: NDArray[np.uint8]) -> None:
        """Detect in a slice `(H, W, 3)`."""
        self.passes += 1
        pixels = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float() / 255
        with torch.inference_mode():
            self._original_predictions = self.model(pixels)

    def _create_object_prediction_list_from_original_predictions(
        self,
        shift_amount_list: list[list[int | float]] | None = None,
        full_shape_list: list[list[int | float]] | None = None,
    ) -> None:
        seen: Any = self._original_predictions
        # For a single image, SAHI may pass the values without the list around them.
        shift, shape = (
            given[0] if given and isinstance(given[0], list) else given
            for given in (shift_amount_list, full_shape_list)
        )
        labels = seen.labels[0] if self.target is None else torch.full_like(seen.labels[0], self.target)
        scores = seen.confidence[0] if self.target is None else seen.scores[0, :, self.target]
        names = self.category_mapping or {}
        self._object_prediction_list_per_image = [
            [
                ObjectPrediction(
                    bbox=box,
                    category_id=label,
                    category_name=names[str(label)],
                    score=score,
                    shift_amount=shift or [0, 0],
                    full_shape=shape,
                )
                for box, label, score in zip(seen.boxes[0].tolist(), labels.tolist(), scores.tolist(), strict=True)
                if score >= self.confidence_threshold
            ]
        ]


@dataclass
class Outcome:
    """Result of a way of looking in all pictures.

    Attributes:
        found: number of objects found.
        objects: number of objects.
        boxes: number of boxes reported.
        passes: number of detector passes.
    """

    found: int = 0
    objects: int = 0
    boxes: int = 0
    passes: int = 0

    def add(self, boxes: Tensor, labels: Tensor, annotation: Annotation, passes: int) -> None:
        """Add a picture's counts; an object is found if a box of its class has an IoU of 0.5, as in `eval.zoom`."""
        hits = (box_iou(boxes, annotation.boxes) >= 0.5) & (labels[:, None] == annotation.labels)
        self.found += int(hits.any(0).sum())
        self.objects += len(annotation.boxes)
        self.boxes += len(boxes)
        self.passes += passes


def sliced(run: ZoomRun, index: int, **merging: str) -> tuple[Tensor, Tensor, int]:
    """Boxes and labels that SAHI reports for a picture, and its passes; `merging` changes its default rules."""
    config = run.config
    model = Slicing(run.eye.detector, run.target, FOUND)
    picture = (run.scenes[index].image * 255).round().byte().permute(1, 2, 0).numpy()
    result = get_sliced_prediction(
        picture,
        model,
        slice_height=config.slice,
        slice_width=config.slice,
        overlap_height_ratio=config.overlap,
        overlap_width_ratio=config.overlap,
        verbose=0,
        **merging,
    )
    kept = result.object_prediction_list
    boxes = torch.tensor([each.bbox.to_xyxy() for each in kept], dtype=torch.float32).view(-1, 4)
    return boxes, torch.tensor([each.category.id for each in kept], dtype=torch.long), model.passes


def compare(config: ZoomConfig) -> None:
    """Look at every picture in all ways, and print the table."""
    run = ZoomRun(config)
    merging = {"SAHI": {}, "SAHI, NMS": {"postprocess_type": "NMS", "postprocess_match_metric": "IOU"}}
    names = "the same slices, merged here", "ours, as many passes", "ours, half as many"
    outcomes = {name: Outcome() for name in (*merging, *names)}
    with one_thread():
        for index in range(len(run.scenes)):
            annotation, glances = run.annotation(index), run.glances(index)
            for name, how in merging.items():
                boxes, labels, passes = sliced(run, index, **how)
                outcomes[name].add(boxes, labels, annotation, passes)
            same = look_by_look(glances, in_order(slices(glances.lattice, config.slice, config.overlap)), None)
            chosen = [turn.glance for turn in islice(find_everything(glances, run.evidence, run.target), passes)]
            ways = {names[0]: [turn.glance for turn in same], names[1]: chosen, names[2]: chosen[: passes // 2]}
            for name, looks in ways.items():
                found = merge(looks, run.target, score=FOUND)
                outcomes[name].add(found.boxes, found.labels, annotation, len(looks))
            glances.save()
            print(f"{run.scenes.ids[index]}: {outcomes['SAHI'].found} of {outcomes['SAHI'].objects} so far", flush=True)
    count = len(run.scenes)
    rows = [
        [name, f"{o.passes / count:.1f}", f"{o.found / max(o.objects, 1):.3f}", f"{o.boxes / max(o.objects, 1):.2f}"]
        for name, o in outcomes.items()
    ]
    what = "objects" if config.target is None else config.target
    print(f"\n{outcomes['SAHI'].objects} {what} in {count} pictures, slices of {config.slice} px:\n")
    print(table(["", "passes", "recall", "boxes for each object"], rows))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(compare, ZoomConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
