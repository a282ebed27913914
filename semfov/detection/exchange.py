"""Conversion of detections to and from other libraries: Supervision, torchvision, COCO results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from semfov.data.classes import canonical_name, class_indices
from semfov.errors import InputError, check, check_shape, check_whole

if TYPE_CHECKING:
    import supervision

SCORES = "scores"
"""Name of the full score vectors in a library that can store further data with its boxes."""


class Exchange:
    """Conversion of the detections of one image to other libraries, and back.

    These libraries store one class and one score for each box: the most probable class other than background, and its
    score. Where a library can store further data, the full score vector is stored too, and converting back is exact.
    """

    boxes: Tensor
    scores: Tensor
    mask: Tensor

    def _of_one_image(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Boxes, score vectors, classes from 1, and scores of the single image."""
        mask = self.mask
        if mask.shape[:-1].numel() != 1:
            raise InputError(
                f"detections: expected the detections of one image, such as detections[0], got a batch of shape "
                f"{tuple(mask.shape[:-1])}"
            )
        real = mask.reshape(-1)
        boxes, vectors = self.boxes.reshape(-1, 4)[real], self.scores.reshape(-1, self.scores.shape[-1])[real]
        best = vectors[:, 1:].max(-1) if vectors.shape[-1] > 1 else vectors.max(-1)
        return boxes, vectors, best.indices + 1, best.values

    def to_supervision(self, classes: Sequence[str] | None = None) -> supervision.Detections:
        """Convert the detections of one image to `supervision.Detections`, for its annotators, trackers and metrics.

        Supervision numbers classes from 0, without background. The full score vectors are in `data["scores"]`.

        Args:
            classes: names of the classes, without background, for `data["class_name"]`; None leaves them out.

        Returns:
            The detections for Supervision.

        Raises:
            InputError: there are several images, the number of names is wrong, or Supervision is not installed.

        Example::

            picture = supervision.BoxAnnotator().annotate(picture, seen.to_supervision(detector.classes))
        """
        boxes, vectors, labels, scores = (tensor.detach().cpu() for tensor in self._of_one_image())
        if classes is not None:
            _check_names(classes, vectors.shape[-1] - 1)
        return named_detections(boxes, labels, scores, classes, {SCORES: vectors.numpy()})

    @classmethod
    def from_supervision(cls, detections: supervision.Detections, classes: int) -> Self:
        """Convert `supervision.Detections` of one image to a batch of one image.

        Full score vectors are taken from `data["scores"]`. Without them, the vector of a box has the confidence at its
        class, and the rest up to 1 at background.

        Args:
            detections: detections with `class_id`, from 0, and `confidence` (1 where it is missing).
            classes: number of classes, without background.

        Returns:
            The detections.

        Raises:
            InputError: classes are missing, or a class or a confidence is out of range.
        """
        boxes = torch.as_tensor(detections.xyxy).reshape(-1, 4)
        boxes = boxes if boxes.is_floating_point() else boxes.float()
        full = detections.data.get(SCORES)
        if full is not None:
            vectors = torch.as_tensor(full)
            shape = (len(boxes), classes + 1)
            check(tuple(vectors.shape) == shape, "data['scores']", f"shape {shape}", tuple(vectors.shape))
            return cls._one_image(boxes, vectors)
        if detections.class_id is None and len(boxes):
            raise InputError("detections: expected a class_id for every box, got none")
        labels = torch.as_tensor([] if detections.class_id is None else detections.class_id).long() + 1
        confidence = detections.confidence
        return cls._one_image(
            boxes, vectors_of(labels, None if confidence is None else torch.as_tensor(confidence), classes)
        )

    def to_torchvision(self) -> dict[str, Tensor]:
        """Convert the detections of one image to the form of torchvision's detectors, which `torchmetrics` also takes.

        Returns:
            `boxes` `(L, 4)`, `labels` `(L,)` from 1 (0 is background), and `scores` `(L,)`.

        Raises:
            InputError: there are several images.
        """
        boxes, _, labels, scores = self._of_one_image()
        return {"boxes": boxes.clone(), "labels": labels, "scores": scores}

    @classmethod
    def from_torchvision(cls, detections: Mapping[str, Tensor], classes: int) -> Self:
        """Convert the output of a torchvision detector for one image to a batch of one image.

        The score vector of a box has the score at its class, and the rest up to 1 at background.

        Args:
            detections: `boxes`, `labels` from 1, and `scores` (1 where they are missing, as in training targets).
            classes: number of classes, without background.

        Returns:
            The detections.

        Raises:
            InputError: boxes or labels are missing, or a label or a score is out of range.
        """
        for name in ("boxes", "labels"):
            check(name in detections, "detections", f"the key {name!r}", f"the keys {sorted(detections)}")
        labels = detections["labels"]
        return cls._one_image(detections["boxes"], vectors_of(labels.long(), detections.get("scores"), classes))

    def to_coco(
        self,
        image_id: int,
        categories: Sequence[int] | Sequence[Mapping[str, Any]],
        classes: Sequence[str] | None = None,
    ) -> list[dict[str, Any]]:
        """Convert the detections of one image to COCO results, for `pycocotools.COCO.loadRes`.

        Args:
            image_id: id of the image in the annotation file.
            categories: the category id of each class, or the `categories` of the annotation file, in which classes are
                then found by name.
            classes: names of the classes, without background; needed to find classes by name.

        Returns:
            `image_id`, `category_id`, `bbox` as `[x, y, width, height]`, and `score` of each box.

        Raises:
            InputError: there are several images, or a class has no category.
        """
        boxes, vectors, labels, scores = (tensor.detach().cpu() for tensor in self._of_one_image())
        ids = category_ids(categories, classes)
        count = vectors.shape[-1] - 1
        check(len(ids) == count, "categories", f"one id for each of {count} classes", len(ids))
        return coco_results(image_id, boxes, labels, scores, dict(enumerate(ids, 1)))

    @classmethod
    def _one_image(cls, boxes: Tensor, vectors: Tensor) -> Self:
        """A batch of one, in descending order of confidence."""
        check_shape(boxes, "boxes", len(vectors), 4)
        order = vectors[:, 1:].amax(-1).argsort(descending=True, stable=True)
        mask = torch.ones(1, len(boxes), dtype=torch.bool, device=boxes.device)
        return cls(boxes[order][None], vectors[order][None], mask)  # type: ignore[call-arg]


def named_detections(
    boxes: Tensor, labels: Tensor, scores: Tensor, classes: Sequence[str] | None, data: Mapping[str, Any]
) -> supervision.Detections:
    """`supervision.Detections` of boxes, with classes from 0, their names unless None, and further data."""
    library, numbers = _supervision(), (labels - 1).numpy()
    names = {} if classes is None else {"class_name": np.array([classes[n] for n in numbers.tolist()], dtype=str)}
    made: supervision.Detections = library.Detections(
        boxes.numpy(), None, scores.numpy(), numbers, data={**data, **names}
    )
    return made


def coco_results(
    image_id: int, boxes: Tensor, labels: Tensor, scores: Tensor, ids: Mapping[int, int]
) -> list[dict[str, Any]]:
    """COCO results of boxes (corners), with the category id of each class 1..K from `ids`."""
    size = boxes[:, 2:] - boxes[:, :2]
    placed = torch.cat([boxes[:, :2], size], -1).double().tolist()
    return [
        {"image_id": image_id, "category_id": ids[label], "bbox": box, "score": score}
        for label, box, score in zip(labels.tolist(), placed, scores.double().tolist(), strict=True)
    ]


def vectors_of(labels: Tensor, scores: Tensor | None, classes: int) -> Tensor:
    """Score vectors `(L, K+1)` of boxes with one class 1..K and its score (None: 1) each; the rest is background."""
    check_whole(classes, "classes", 1, 10**6)
    scores = torch.ones(len(labels), device=labels.device) if scores is None else scores
    scores = scores if scores.is_floating_point() else scores.float()
    check_shape(scores, "scores", len(labels))
    inside = not len(labels) or (int(labels.min()) >= 1 and int(labels.max()) <= classes)
    check(inside, "labels", f"classes from 1 to {classes}", sorted(set(labels.tolist()))[-3:])
    # The comparison also refuses NaN.
    check(bool(((scores >= 0) & (scores <= 1)).all()), "scores", "numbers from 0 to 1", scores.tolist()[:3])
    vectors = scores.new_zeros(len(labels), classes + 1)
    vectors[:, 0] = 1 - scores
    return vectors.scatter(1, labels[:, None], scores[:, None])


def category_ids(
    categories: Sequence[int] | Sequence[Mapping[str, Any]], classes: Sequence[str] | None = None
) -> list[int]:
    """Find the category id of each class.

    Args:
        categories: the ids, which are returned as they are, or the `categories` of an annotation file.
        classes: names of the classes, without background; needed for the `categories` of a file.

    Returns:
        The category id of each class.

    Raises:
        InputError: names are missing, or a class has no category.

    >>> category_ids([{"id": 72, "name": "tv"}, {"id": 1, "name": "person"}], ["person", "tvmonitor"])
    [1, 72]
    """
    ids = [category for category in categories if not isinstance(category, Mapping)]
    if len(ids) == len(categories):
        return ids
    if classes is None:
        raise InputError("classes: expected the names of the detector's classes to find their categories, got None")
    named = [category for category in categories if isinstance(category, Mapping)]
    by_name = {canonical_name(str(category["name"])): int(category["id"]) for category in named}
    names = class_indices(classes)
    missing = [name for name in names if name not in by_name]
    check(not missing, "categories", "a category for each class", f"none for {', '.join(missing[:3])}")
    return [by_name[name] for name in names]


def _check_names(classes: Sequence[str], count: int) -> None:
    check(len(classes) == count, "classes", f"{count} names, without background", len(classes))


def _supervision() -> Any:
    try:
        import supervision
    except ImportError:
        raise InputError(
            "supervision: expected the package supervision, which is not installed; pip install supervision"
        ) from None
    return supervision
