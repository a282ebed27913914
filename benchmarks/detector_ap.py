"""COCO average precision of a detector on whole photographs, without foveation.

python -m benchmarks.detector_ap --detector yolov3-tiny --root DIR --annotations FILE
"""

import argparse
from collections.abc import Iterable, Iterator, Sequence
from math import nan
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from semfov.data.annotations import read_annotations
from semfov.data.reading import read_image
from semfov.detection import Candidates, Detector, Selection
from semfov.detection.load import load_detector
from semfov.detection.selection import suppress
from semfov.errors import lookup
from semfov.metrics.average_precision import average_precision as coco_ap

COCO_LIMIT = 100  # boxes of each class in an image that COCO counts, at any confidence
# The selections have no limit of their own.
SELECTIONS = {
    "per-class NMS": Selection(threshold=0.001, iou=0.5, limit=10_000, per_class=True),
    "class-agnostic NMS": Selection(threshold=0.001, iou=0.5, limit=10_000),
}


def rows_above(candidates: Candidates, threshold: float, *, multilabel: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Return the candidates of one image whose score is at least `threshold`.

    Args:
        candidates: candidates of one image.
        threshold: smallest score.
        multilabel: count each box for every class; false: only for its best class.

    Returns:
        Row of the candidate, score (objectness times class score) and label from 0, each `(M,)`.
    """
    scores = candidates.classes[0]
    if candidates.objectness is not None:
        scores = scores * candidates.objectness[0][:, None]
    if not multilabel:
        best = scores.argmax(-1, keepdim=True)
        scores = torch.zeros_like(scores).scatter(-1, best, scores.gather(-1, best))
    rows, labels = (scores >= threshold).nonzero(as_tuple=True)
    return rows, scores[rows, labels], labels


@torch.no_grad()
def detect(
    detector: Detector, image: Tensor, selections: Iterable[Selection], *, multilabel: bool = False
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield boxes, scores and labels of one photograph for each of `selections`."""
    canvas, placement = detector.fit(image)
    candidates = detector.propose(canvas)
    boxes = placement.boxes_to_image(candidates.boxes[0])
    for selection in selections:
        rows, scores, labels = rows_above(candidates, selection.threshold, multilabel=multilabel)
        keep = suppress(boxes[rows], scores, labels, selection)
        yield boxes[rows][keep], scores[keep], labels[keep]


def average_precision(
    detector: Detector,
    root: Path,
    annotations: Path,
    selections: Sequence[Selection],
    *,
    multilabel: bool = False,
) -> list[tuple[float, float]]:
    """AP and AP50 by COCOeval for each of `selections`, over all images of the annotation file; NaN without objects."""
    truth = read_annotations(annotations)
    ids = {entry["name"]: number for number, entry in truth.categories.items()}
    categories = [ids[lookup(name, ids, "category of the annotations")] for name in detector.classes]
    results: list[list[dict[str, Any]]] = [[] for _ in selections]
    for image_id in tqdm(sorted(truth.images), desc=detector.name, unit="image"):
        # In the stored orientation, to which COCO's annotations refer.
        image = read_image(root / truth.images[image_id]["file_name"], oriented=False)[None]
        by_selection = detect(detector, image, selections, multilabel=multilabel)
        for result, (boxes, scores, labels) in zip(results, by_selection, strict=True):
            sizes = torch.cat([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], -1)
            for box, score, label in zip(sizes.tolist(), scores.tolist(), labels.tolist(), strict=True):
                result.append({"image_id": image_id, "category_id": categories[label], "bbox": box, "score": score})
    return [coco_ap(truth, result, limit=COCO_LIMIT) or (nan, nan) for result in results]


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description="COCO average precision of a detector, without foveation")
    parser.add_argument("--detector", default="yolox-nano", help="name or file, as load_detector takes it")
    parser.add_argument("--weights", help="weights file, for a cfg or instead of the published weights")
    parser.add_argument("--root", type=Path, required=True, help="folder of the photographs")
    parser.add_argument("--annotations", type=Path, required=True, help="COCO annotation file")
    parser.add_argument("--input-size", type=int, help="longer side of the network's input, if it takes any size")
    parser.add_argument("--stride", type=int, help="pad the canvas to a multiple of this; 0: to the whole canvas")
    parser.add_argument("--multilabel", action="store_true", help="count a box for every class")
    parser.add_argument("--runtime", help="what runs a Darknet network: auto, torch or onnxruntime")
    arguments = parser.parse_args()
    options: dict[str, Any] = {}
    if arguments.weights:
        options["weights"] = arguments.weights
    if arguments.input_size:
        options["input_size"] = arguments.input_size
    if arguments.stride is not None:
        options["stride"] = arguments.stride or None
    if arguments.runtime:
        options["runtime"] = arguments.runtime
    detector = load_detector(arguments.detector, **options)
    selections = list(SELECTIONS.values())
    scores = average_precision(
        detector, arguments.root, arguments.annotations, selections, multilabel=arguments.multilabel
    )
    padding = "the whole canvas" if detector.stride is None else f"a multiple of {detector.stride}"
    print("| detector | padded to | NMS | AP | AP50 |\n|---|---|---|---|---|")
    for name, (ap, ap50) in zip(SELECTIONS, scores, strict=True):
        print(f"| {detector.name} | {padding} | {name} | {ap:.3f} | {ap50:.3f} |")


if __name__ == "__main__":
    main()
