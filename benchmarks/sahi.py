"""Comparison with SAHI, which cuts pictures into slices, on the same detector and pictures as `eval.zoom`.

    python -m benchmarks.sahi --mosaics 20
    python -m benchmarks.sahi --data.root DIR --data.annotations FILE --mosaics 0 --target person

SAHI (Akyon, Altinuc and Temizel, 2022) looks at every slice and at the whole picture, and merges the detections by its
own rules (`GREEDYNMM`, its default, or `NMS`). It always looks at all slices, so it has a single result. It is compared
with the same slices, merged by `semfov.zoom.merge`, with fewer of them, and with windows that semfov chooses. Every way
looks anew, so that its seconds are its own: reading, detecting, choosing and merging, on one thread (processor time).
"""

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from time import process_time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.tables import table
from eval.zoom.objects import AFTER, average_precision
from eval.zoom.orders import in_order, quad_tree, sparse
from eval.zoom.run import ZoomConfig, ZoomRun
from semfov.data.large import to_bytes
from semfov.data.scene import Annotation
from semfov.detection.detector import Detector
from semfov.detection.objects import Objects
from semfov.observation.matching import box_iou
from semfov.runs.command import run_command
from semfov.runs.looks import one_thread
from semfov.runs.window_looking import right_boxes
from semfov.zoom.episode import Order, WindowStep, find_everything, look_by_look
from semfov.zoom.glances import LiveGlances, Window
from semfov.zoom.hints import DETECTION_SCORE
from semfov.zoom.lattice import Lattice
from semfov.zoom.objects import merge
from semfov.zoom.slices import adaptive_slices, slices

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
        predictions: Any = self._original_predictions
        # For a single image, SAHI may pass the values without the list around them.
        shift, shape = (
            values[0] if values and isinstance(values[0], list) else values
            for values in (shift_amount_list, full_shape_list)
        )
        labels = predictions.labels[0] if self.target is None else torch.full_like(predictions.labels[0], self.target)
        scores = predictions.confidence[0] if self.target is None else predictions.scores[0, :, self.target]
        boxes, names = predictions.boxes[0], self.category_mapping or {}
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
                for box, label, score in zip(boxes.tolist(), labels.tolist(), scores.tolist(), strict=True)
                if score >= self.confidence_threshold
            ]
        ]


@dataclass
class Outcome:
    """Counts, seconds, and the scores of boxes and whether they are right, of a way of looking in all pictures."""

    found: int = 0
    objects: int = 0
    boxes: int = 0
    passes: int = 0
    seconds: float = 0.0
    scores: list[Tensor] = field(default_factory=list)
    right: list[Tensor] = field(default_factory=list)

    def add(self, objects: Objects, annotation: Annotation, passes: int, seconds: float) -> None:
        """Add a picture's counts; an object is found if a box of its class has an IoU of 0.5, as in `eval.zoom`."""
        hits = (box_iou(objects.boxes, annotation.boxes) >= 0.5) & (objects.labels[:, None] == annotation.labels)
        self.found += int(hits.any(0).sum())
        self.objects += len(annotation.boxes)
        self.boxes += len(objects)
        self.passes += passes
        self.seconds += seconds
        right = right_boxes(objects, annotation)
        self.scores.append(objects.scores[right >= 0])  # not those in a crowd
        self.right.append(right[right >= 0] > 0)

    def row(self, pictures: int) -> list[str]:
        """Passes and seconds for a picture, recall, average precision, and boxes for each object."""
        precision = average_precision(torch.cat(self.scores), torch.cat(self.right), self.objects)
        shares = self.found / max(self.objects, 1), precision
        rest = [f"{share:.3f}" for share in shares] + [f"{self.boxes / max(self.objects, 1):.2f}"]
        return [f"{self.passes / pictures:.1f}", f"{self.seconds / pictures:.2f}", *rest]


def sliced(run: ZoomRun, pixels: NDArray[np.uint8], **merging: str) -> tuple[Objects, int]:
    """Objects that SAHI reports for a picture `(H, W, 3)`, and its passes; `merging` changes its default rules."""
    config = run.config
    model = Slicing(run.eye.detector, run.target, DETECTION_SCORE)
    result = get_sliced_prediction(
        pixels,
        model,
        slice_height=config.slice,
        slice_width=config.slice,
        overlap_height_ratio=config.overlap,
        overlap_width_ratio=config.overlap,
        verbose=0,
        **merging,
    )
    predictions = result.object_prediction_list
    boxes = torch.tensor([each.bbox.to_xyxy() for each in predictions], dtype=torch.float32).view(-1, 4)
    labels = torch.tensor([each.category.id for each in predictions], dtype=torch.long)
    scores = torch.tensor([each.score.value for each in predictions], dtype=torch.float32)
    return Objects(boxes, scores, labels, torch.zeros_like(labels)), model.passes


def merged(
    run: ZoomRun, pixels: NDArray[np.uint8], turns: Callable[[LiveGlances], Iterable[WindowStep[Any]]], passes: int
) -> tuple[Objects, int]:
    """Objects that the first looks at windows of a picture show, and the number of looks."""
    glances = LiveGlances(run.eye, run.eye.open(pixels))
    looks = [turn.glance for turn in islice(turns(glances), passes)]
    return merge(looks, run.target, score=DETECTION_SCORE), len(looks)


def ways(run: ZoomRun) -> dict[str, Callable[[NDArray[np.uint8]], tuple[Objects, int]]]:
    """The ways of looking at a picture, by name."""
    config, targets = run.config, [] if run.target is None else [run.target]

    def ordered(order: Callable[[Lattice, list[Window]], Order]) -> Callable[[LiveGlances], Iterable[WindowStep[Any]]]:
        def turns(glances: LiveGlances) -> Iterable[WindowStep[Any]]:
            lattice = glances.lattice
            return look_by_look(glances, order(lattice, slices(lattice, config.slice, config.overlap)), None)

        return turns

    orders: dict[str, Callable[[Lattice, list[Window]], Order]] = {
        "the same slices, merged here": lambda lattice, cut: in_order(cut),
        "sparse slices": lambda lattice, cut: sparse(cut, targets, config.sparse),
        "slices as in ASAHI": lambda lattice, cut: in_order(adaptive_slices(lattice)),
        "quad-tree": lambda lattice, cut: quad_tree(lattice, run.target, most=False),
    }

    def chosen(glances: LiveGlances) -> Iterable[WindowStep[Any]]:
        return find_everything(glances, run.evidence, run.target)

    return {
        "SAHI": partial(sliced, run),
        "SAHI, NMS": partial(sliced, run, postprocess_type="NMS", postprocess_match_metric="IOU"),
        **{name: partial(merged, run, turns=ordered(each), passes=config.passes) for name, each in orders.items()},
        **{f"ours, {number} passes": partial(merged, run, turns=chosen, passes=number) for number in AFTER[1:]},
    }


def compare(config: ZoomConfig) -> None:
    """Look at every picture in all ways, and print the table."""
    run = ZoomRun(config)
    outcomes = {name: Outcome() for name in ways(run)}
    with one_thread(), torch.inference_mode():
        for index in range(len(run.scenes)):
            annotation, pixels = run.annotation(index), to_bytes(run.scenes[index].image)
            for name, way in ways(run).items():
                began = process_time()
                objects, passes = way(pixels)
                outcomes[name].add(objects, annotation, passes, process_time() - began)
            print(f"{run.scenes.ids[index]}: {outcomes['SAHI'].found} of {outcomes['SAHI'].objects} so far", flush=True)
    count = len(run.scenes)
    what = "objects" if config.target is None else config.target
    print(f"\n{outcomes['SAHI'].objects} {what} in {count} pictures, slices of {config.slice} px:\n")
    head = ["", "passes", "seconds", "recall", "AP50", "boxes for each object"]
    print(table(head, [[name, *outcome.row(count)] for name, outcome in outcomes.items()]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(compare, ZoomConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
