"""The detections that a detector returns: a padded batch of boxes with full class-score vectors, and its conversion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor
from torch.nn.functional import pad

from semfov.detection.exchange import Category, CocoResult, category_ids, coco_results, named_detections
from semfov.errors import check, check_shape, check_whole

if TYPE_CHECKING:
    import supervision


_MOST_CLASSES = 10**6
_SCORES = "scores"  # name of the full score vectors in a library that can store further data with its boxes


def greatest(values: Tensor, dimension: int) -> Tensor:
    """Find the greatest of values from 0 along a dimension; 0 where there are none.

    Args:
        values: the values.
        dimension: the dimension, which the result lacks.

    Returns:
        The greatest values.
    """
    return values.amax(dimension) if values.shape[dimension] else values.sum(dimension)


def _vectors_of(labels: Tensor, scores: Tensor | None, classes: int) -> Tensor:
    """Make score vectors `(L, K+1)` of boxes with one class 1..K and its score (None: 1); the rest is background."""
    check_whole(classes, "classes", 1, _MOST_CLASSES)
    if scores is None:
        scores = torch.ones(len(labels), device=labels.device)
    elif not scores.is_floating_point():
        scores = scores.float()
    check_shape(scores, "scores", len(labels))
    are_classes = bool(((labels >= 1) & (labels <= classes)).all())
    largest = sorted(set(labels.tolist()))[-3:]
    check(are_classes, "labels", f"classes from 1 to {classes}", largest)
    are_scores = bool(((scores >= 0) & (scores <= 1)).all())  # NaN is neither
    check(are_scores, "scores", "numbers from 0 to 1", scores.tolist()[:3])
    vectors = scores.new_zeros(len(labels), classes + 1)
    vectors[:, 0] = 1 - scores
    return vectors.scatter(1, labels[:, None], scores[:, None])


@dataclass(frozen=True, eq=False)
class Detections:
    """A padded batch of detections, each with a score for every class and for background.

    Beliefs read the score vectors, in which the classes share what background leaves. Lists, drawings and thresholds
    read the confidence, the number that the bare detector shows. With many classes, the largest score in the vector is
    often far below it.

    Attributes:
        boxes: `(..., L, 4)`, `(x1, y1, x2, y2)` in pixels of the detector's input image.
        scores: `(..., L, K+1)`, score vectors that sum to 1; index 0 is background, 1..K are the detector's classes.
        mask: `(..., L)`, true if a row is a detection, and false if it is padding; None: all rows are detections.
        confidence: `(..., L)`, the detector's own score of the best class, 0 for padding; None: the largest score of a
            class in the vector.
        highest: `(..., K+1)`, the highest score of each class in the whole image, also among candidates that are too
            faint for a detection; None: among the detections.

    Detections are sorted by the largest score of a class in their vectors, the order in which beliefs fuse them;
    padding comes last.

    Other libraries store one class and one score for each box: the best class other than background, and the
    confidence. Where a library can store further data, the full score vector is stored too, and converting back is
    exact.

    >>> d = Detections(torch.zeros(1, 2, 4), torch.full((1, 2, 3), 1 / 3), torch.tensor([[True, False]]))
    >>> d.count
    tensor([1])
    """

    boxes: Tensor
    scores: Tensor
    mask: Tensor = None  # type: ignore[assignment]  # `__post_init__` replaces None
    confidence: Tensor = None  # type: ignore[assignment]  # `__post_init__` replaces None
    highest: Tensor = None  # type: ignore[assignment]  # likewise

    def __post_init__(self) -> None:
        check_shape(self.boxes, "boxes", None, 4)
        check_shape(self.scores, "scores", None, None)
        if self.mask is None:
            every_row = torch.ones(self.boxes.shape[:-1], dtype=torch.bool, device=self.boxes.device)
            object.__setattr__(self, "mask", every_row)
        check(self.mask.dtype == torch.bool, "mask", "a boolean tensor", self.mask.dtype)
        lead = self.mask.shape
        have_lead = self.boxes.shape[:-1] == lead and self.scores.shape[:-1] == lead
        shapes = tuple(self.boxes.shape), tuple(self.scores.shape), tuple(lead)
        check(have_lead, "boxes, scores, mask", "the same leading dimensions", shapes)
        if self.confidence is None:
            object.__setattr__(self, "confidence", self._best_of_rows())
        check(self.confidence.shape == lead, "confidence", f"shape {tuple(lead)}", tuple(self.confidence.shape))
        if self.highest is None:
            object.__setattr__(self, "highest", self._highest_of_rows())
        by_class = (*lead[:-1], self.scores.shape[-1])
        check(self.highest.shape == by_class, "highest", f"shape {by_class}", tuple(self.highest.shape))

    def _best_of_rows(self) -> Tensor:
        """Find the largest score of a class of each detection, `(..., L)`; 0 without classes, and for padding."""
        return greatest(self.scores[..., 1:], -1) * self.mask

    def _highest_of_rows(self) -> Tensor:
        """Find the highest score of each class among the detections, `(..., K+1)`; 0 without detections."""
        return greatest(self.scores * self.mask[..., None], -2)

    @property
    def count(self) -> Tensor:
        """Number of detections in each image, without padding, `(...)`."""
        return self.mask.sum(-1)

    @property
    def labels(self) -> Tensor:
        """Best class other than background, `(..., L)`, from 1 to K; 0 for padding."""
        return (self.scores[..., 1:].argmax(-1) + 1) * self.mask

    @property
    def class_scores(self) -> Tensor:
        """The detector's own score of each class, `(..., L, K)`: the confidence for the best class.

        Every background policy divides what background leaves in proportion to these scores.
        """
        classes = self.scores[..., 1:]
        # Padding has no scores to divide by.
        best = classes.amax(-1, keepdim=True).clamp(min=torch.finfo(classes.dtype).tiny)
        return classes / best * self.confidence[..., None]

    def to(self, device: torch.device | str) -> Self:
        """Move the detections to a device.

        Args:
            device: the device.

        Returns:
            The detections on that device.
        """
        return self._mapped(lambda tensor: tensor.to(device))

    def __getitem__(self, index: int | slice | Tensor | tuple[int | Tensor, ...] | None) -> Self:
        """Return the detections of some images of the batch; single rows, by a tuple, are no whole image any more."""
        if isinstance(index, tuple):
            return type(self)(*(column[index] for column in self._columns()))
        return self._mapped(lambda tensor: tensor[index])

    def take(self, rows: slice | Tensor) -> Self:
        """Select detections of every image by index.

        Args:
            rows: the rows of the detections: their numbers, or a boolean `(L,)`.

        Returns:
            The detections, in the order of the rows. Their highest scores are still those of the whole images.
        """
        return type(self)(
            self.boxes[..., rows, :],
            self.scores[..., rows, :],
            self.mask[..., rows],
            self.confidence[..., rows],
            self.highest,
        )

    def _columns(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """List the tensors that have a row for each detection, in the order of the attributes."""
        return self.boxes, self.scores, self.mask, self.confidence

    def _mapped(self, function: Callable[[Tensor], Tensor]) -> Self:
        """Apply a function to each tensor."""
        return type(self)(*map(function, (*self._columns(), self.highest)))

    @classmethod
    def empty(cls, batch: int, classes: int, *, like: Tensor | None = None) -> Self:
        """Make a batch without detections.

        Args:
            batch: number of images.
            classes: number of classes K, without background.
            like: a tensor with the dtype and device of the result; None for float32 on the CPU.

        Returns:
            Detections with L = 0.
        """
        like = torch.empty(0) if like is None else like
        boxes = like.new_zeros(batch, 0, 4)
        scores = like.new_zeros(batch, 0, classes + 1)
        mask = torch.zeros(batch, 0, dtype=torch.bool, device=like.device)
        return cls(boxes, scores, mask)

    @classmethod
    def stack(cls, images: list[Self]) -> Self:
        """Join batches of images along the batch dimension, and pad them to the largest number of detections.

        Args:
            images: the batches.

        Returns:
            One batch with all images.
        """
        check(len(images) > 0, "images", "at least one batch of detections", 0)
        longest = max(batch.mask.shape[-1] for batch in images)
        padded = [(*batch._padded(longest)._columns(), batch.highest) for batch in images]
        return cls(*map(torch.cat, zip(*padded, strict=True)))

    def _padded(self, length: int) -> Self:
        """Pad the detections to a length."""
        missing = length - self.mask.shape[-1]
        return type(self)(
            pad(self.boxes, (0, 0, 0, missing)),
            pad(self.scores, (0, 0, 0, missing)),
            pad(self.mask, (0, missing)),
            pad(self.confidence, (0, missing)),
            self.highest,
        )

    def _of_one_image(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """List boxes, score vectors, classes from 1, and confidences of the single image, most confident first."""
        lead = self.mask.shape[:-1]
        expected = "the detections of one image, such as detections[0]"
        check(lead.numel() == 1, "detections", expected, f"a batch of shape {tuple(lead)}")
        image = self._mapped(lambda tensor: tensor.reshape(*tensor.shape[len(lead) :]))
        image = image.take(image.mask)
        image = image.take(image.confidence.argsort(descending=True, stable=True))
        # Without classes there is no best one that could be found.
        labels = image.labels if image.scores.shape[-1] > 1 else image.mask.long()
        return image.boxes, image.scores, labels, image.confidence

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
            count = vectors.shape[-1] - 1
            check(len(classes) == count, "classes", f"{count} names, without background", len(classes))
        return named_detections(boxes, labels, scores, classes, {_SCORES: vectors.numpy()})

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
        if not boxes.is_floating_point():
            boxes = boxes.float()
        scores = None if detections.confidence is None else torch.as_tensor(detections.confidence)
        # What `to_supervision` has put there, which Supervision keeps when it filters.
        full = detections.data.get(_SCORES)
        if full is not None:
            vectors = torch.as_tensor(full)
            shape = (len(boxes), classes + 1)
            check(tuple(vectors.shape) == shape, "data['scores']", f"shape {shape}", tuple(vectors.shape))
            return cls._one_image(boxes, vectors, scores)
        numbers = detections.class_id
        check(numbers is not None or not len(boxes), "detections", "a class_id for every box", "none")
        labels = torch.as_tensor([] if numbers is None else numbers).long() + 1
        return cls._one_image(boxes, _vectors_of(labels, scores, classes))

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
        return cls._one_image(detections["boxes"], _vectors_of(labels.long(), detections.get("scores"), classes))

    def to_coco(
        self,
        image_id: int | str,
        categories: Sequence[int | str] | Sequence[Category],
        classes: Sequence[str] | None = None,
    ) -> list[CocoResult]:
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
    def _one_image(cls, boxes: Tensor, vectors: Tensor, confidence: Tensor | None = None) -> Self:
        """Make a batch of one, in descending order of the largest score of a class; confidence `(L,)`, or None."""
        check_shape(boxes, "boxes", len(vectors), 4)
        every = torch.ones(1, len(boxes), dtype=torch.bool, device=boxes.device)
        image = cls(boxes[None], vectors[None], every)
        if confidence is not None:
            image = replace(image, confidence=confidence[None])
        order = vectors[:, 1:].amax(-1).argsort(descending=True, stable=True)
        return image.take(order)
