"""Detections in the forms of other libraries: Supervision, torchvision, COCO results."""

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
"""Name of the full score vectors where another library keeps data of its users' own beside its boxes."""


class Exchange:
    """What turns the detections of one image into those of other libraries, and back.

    They all keep one class and one score of a box. Here these are the most probable class that is not background, and
    its score; where there is room for more, the full vector goes along, and the way back then loses nothing.
    """

    boxes: Tensor
    scores: Tensor
    mask: Tensor

    def _of_one_image(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Boxes, score vectors, classes from 1, and scores of the only image there is."""
        mask = self.mask
        if mask.shape[:-1].numel() != 1:
            raise InputError(f"detections: expected those of one image (detections[0]), got {tuple(mask.shape[:-1])}")
        kept = mask.reshape(-1)
        boxes, vectors = self.boxes.reshape(-1, 4)[kept], self.scores.reshape(-1, self.scores.shape[-1])[kept]
        best = vectors[:, 1:].max(-1) if vectors.shape[-1] > 1 else vectors.max(-1)
        return boxes, vectors, best.indices + 1, best.values

    def to_supervision(self, classes: Sequence[str] | None = None) -> supervision.Detections:
        """The detections of one image as `supervision.Detections`, for its annotators, trackers and metrics.

        Supervision numbers classes from 0, without background. The full vectors are in `data["scores"]`.

        Args:
            classes: names of the classes, without background, for `data["class_name"]`.

        Raises:
            InputError: these are of several images, names do not fit, or Supervision is not installed.

        Example::

            picture = supervision.BoxAnnotator().annotate(picture, seen.to_supervision(detector.classes))
        """
        library = _supervision()
        boxes, vectors, labels, scores = (tensor.detach().cpu() for tensor in self._of_one_image())
        data: dict[str, Any] = {SCORES: vectors.numpy()}
        if classes is not None:
            _check_names(classes, vectors.shape[-1] - 1)
            data["class_name"] = np.array([classes[index] for index in (labels - 1).tolist()], dtype=str)
        return library.Detections(boxes.numpy(), None, scores.numpy(), (labels - 1).numpy(), data=data)

    @classmethod
    def from_supervision(cls, detections: supervision.Detections, classes: int) -> Self:
        """`supervision.Detections` of one image, as a batch of one.

        Full vectors are taken from `data["scores"]`. Without them a box has its confidence at its class, and what is
        left of 1 at background.

        Args:
            detections: with `class_id`, from 0, and `confidence` (none: 1).
            classes: how many classes there are, without background.

        Raises:
            InputError: a class or a confidence is missing or out of range.
        """
        boxes = torch.as_tensor(detections.xyxy).reshape(-1, 4)
        boxes = boxes if boxes.is_floating_point() else boxes.float()
        full = detections.data.get(SCORES)
        if full is not None:
            vectors = torch.as_tensor(full)
            wanted = (len(boxes), classes + 1)
            check(tuple(vectors.shape) == wanted, "data['scores']", f"shape {wanted}", tuple(vectors.shape))
            return cls._one_image(boxes, vectors)
        if detections.class_id is None and len(boxes):
            raise InputError("detections: expected a class_id for every box, got none")
        labels = torch.as_tensor([] if detections.class_id is None else detections.class_id).long() + 1
        given = detections.confidence
        return cls._one_image(boxes, vectors_of(labels, None if given is None else torch.as_tensor(given), classes))

    def to_torchvision(self) -> dict[str, Tensor]:
        """The detections of one image as torchvision's detectors return them, and `torchmetrics` takes them.

        Returns:
            `boxes` `(L, 4)`, `labels` `(L,)` from 1 (0 is background), and `scores` `(L,)`.

        Raises:
            InputError: these are of several images.
        """
        boxes, _, labels, scores = self._of_one_image()
        return {"boxes": boxes.clone(), "labels": labels, "scores": scores}

    @classmethod
    def from_torchvision(cls, detections: Mapping[str, Tensor], classes: int) -> Self:
        """What a torchvision detector returns for an image, as a batch of one; vectors as in `from_supervision`.

        Args:
            detections: `boxes`, `labels` from 1, and `scores` (none: 1, as targets of training have them).
            classes: how many classes there are, without background.

        Raises:
            InputError: boxes or labels are missing, or a label or a score is out of range.
        """
        for name in ("boxes", "labels"):
            check(name in detections, "detections", f"{name!r} among its keys", sorted(detections))
        labels = detections["labels"]
        return cls._one_image(detections["boxes"], vectors_of(labels.long(), detections.get("scores"), classes))

    def to_coco(
        self,
        image_id: int,
        categories: Sequence[int] | Sequence[Mapping[str, Any]],
        classes: Sequence[str] | None = None,
    ) -> list[dict[str, Any]]:
        """The detections of one image as COCO results, for `pycocotools.COCO.loadRes`.

        Args:
            image_id: of the annotation file.
            categories: the file's category id for each class, or its `categories` as they are; classes are then found
                by name.
            classes: names of the classes, without background, for the latter.

        Returns:
            `image_id`, `category_id`, `bbox` as `[x, y, width, height]`, and `score` of each box.

        Raises:
            InputError: these are of several images, or a class has no category.
        """
        boxes, vectors, labels, scores = (tensor.detach().cpu() for tensor in self._of_one_image())
        ids = category_ids(categories, classes)
        count = vectors.shape[-1] - 1
        check(len(ids) == count, "categories", f"one id for each of {count} classes", len(ids))
        size = boxes[:, 2:] - boxes[:, :2]
        placed = torch.cat([boxes[:, :2], size], -1).double().tolist()
        return [
            {"image_id": image_id, "category_id": ids[label - 1], "bbox": box, "score": score}
            for label, box, score in zip(labels.tolist(), placed, scores.double().tolist(), strict=True)
        ]

    @classmethod
    def _one_image(cls, boxes: Tensor, vectors: Tensor) -> Self:
        """A batch of one, in descending order of confidence."""
        check_shape(boxes, "boxes", len(vectors), 4)
        order = vectors[:, 1:].amax(-1).argsort(descending=True, stable=True)
        mask = torch.ones(1, len(boxes), dtype=torch.bool, device=boxes.device)
        return cls(boxes[order][None], vectors[order][None], mask)  # type: ignore[call-arg]


def vectors_of(labels: Tensor, scores: Tensor | None, classes: int) -> Tensor:
    """Score vectors `(L, K+1)` of boxes of which only a class 1..K and its score are known; the rest is background.

    >>> vectors_of(torch.tensor([2]), torch.tensor([0.75]), 3)
    tensor([[0.2500, 0.0000, 0.7500, 0.0000]])
    """
    check_whole(classes, "classes", 1, 10**6)
    known = torch.ones(len(labels), device=labels.device) if scores is None else scores
    known = known if known.is_floating_point() else known.float()
    check_shape(known, "scores", len(labels))
    inside = not len(labels) or (int(labels.min()) >= 1 and int(labels.max()) <= classes)
    check(inside, "labels", f"classes of {classes}", sorted(set(labels.tolist()))[-3:])
    # NaN is not between 0 and 1 either.
    check(bool(((known >= 0) & (known <= 1)).all()), "scores", "numbers from 0 to 1", known.tolist()[:3])
    vectors = known.new_zeros(len(labels), classes + 1)
    vectors[:, 0] = 1 - known
    return vectors.scatter(1, labels[:, None], known[:, None])


def category_ids(
    categories: Sequence[int] | Sequence[Mapping[str, Any]], classes: Sequence[str] | None = None
) -> list[int]:
    """The id of the category of each class: as given, or by name from the `categories` of an annotation file.

    >>> category_ids([{"id": 72, "name": "tv"}, {"id": 1, "name": "person"}], ["person", "tvmonitor"])
    [1, 72]
    """
    ids = [category for category in categories if not isinstance(category, Mapping)]
    if len(ids) == len(categories):
        return ids
    if classes is None:
        raise InputError("classes: expected the names of the detector's classes, for categories by name, got None")
    named = [category for category in categories if isinstance(category, Mapping)]
    by_name = {canonical_name(str(category["name"])): int(category["id"]) for category in named}
    wanted = class_indices(classes)
    missing = [name for name in wanted if name not in by_name]
    check(not missing, "categories", "one for each class", f"none for {', '.join(missing[:3])}")
    return [by_name[name] for name in wanted]


def _check_names(classes: Sequence[str], count: int) -> None:
    check(len(classes) == count, "classes", f"{count} names, without background", len(classes))


def _supervision() -> Any:
    try:
        import supervision
    except ImportError:
        raise InputError("supervision: expected the package, got none; pip install supervision") from None
    return supervision
