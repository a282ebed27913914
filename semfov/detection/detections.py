"""The detections that a detector returns: a padded batch of boxes with full class-score vectors."""

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from semfov.detection.exchange import Exchange
from semfov.errors import check, check_shape


@dataclass(frozen=True)
class Detections(Exchange):
    """A padded batch of detections, each with a score for every class and for background.

    Attributes:
        boxes: `(..., L, 4)`, `(x1, y1, x2, y2)` in pixels of the detector's input image.
        scores: `(..., L, K+1)`, score vectors that sum to 1; index 0 is background, 1..K are the detector's classes.
        mask: `(..., L)`, true where a row is a detection and false where it is padding.

    Detections are in descending order of confidence (the largest score of a class other than background), with padding
    last.

    >>> d = Detections(torch.zeros(1, 2, 4), torch.full((1, 2, 3), 1 / 3), torch.tensor([[True, False]]))
    >>> d.count
    tensor([1])
    """

    boxes: Tensor
    scores: Tensor
    mask: Tensor

    def __post_init__(self) -> None:
        check_shape(self.boxes, "boxes", None, 4)
        check_shape(self.scores, "scores", None, None)
        check(self.mask.dtype == torch.bool, "mask", "a boolean tensor", self.mask.dtype)
        lead = self.mask.shape
        check(
            self.boxes.shape[:-1] == lead and self.scores.shape[:-1] == lead,
            "boxes, scores, mask",
            "the same leading dimensions",
            (tuple(self.boxes.shape), tuple(self.scores.shape), tuple(lead)),
        )

    @property
    def count(self) -> Tensor:
        """Number of detections in each image, without padding, `(...)`."""
        return self.mask.sum(-1)

    @property
    def confidence(self) -> Tensor:
        """Largest score of a class other than background, `(..., L)`; 0 for padding."""
        return self.scores[..., 1:].amax(-1) * self.mask

    @property
    def labels(self) -> Tensor:
        """Most probable class other than background, `(..., L)`, from 1 to K; 0 for padding."""
        return (self.scores[..., 1:].argmax(-1) + 1) * self.mask

    def to(self, device: torch.device | str) -> Self:
        """Move the detections to a device.

        Args:
            device: the device.

        Returns:
            The detections on that device.
        """
        return type(self)(self.boxes.to(device), self.scores.to(device), self.mask.to(device))

    def __getitem__(self, index: int | slice | Tensor) -> Self:
        """Return the detections of some images of the batch."""
        return type(self)(self.boxes[index], self.scores[index], self.mask[index])

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
        mask = torch.zeros(batch, 0, dtype=torch.bool, device=like.device)
        return cls(like.new_zeros(batch, 0, 4), like.new_zeros(batch, 0, classes + 1), mask)

    @classmethod
    def stack(cls, images: list[Self]) -> Self:
        """Join batches of images along the batch dimension, and pad them to the largest number of detections.

        Args:
            images: the batches.

        Returns:
            One batch with all images.
        """
        check(len(images) > 0, "images", "at least one batch of detections", 0)
        longest = max(d.mask.shape[-1] for d in images)
        padded = [d._pad(longest) for d in images]
        return cls(
            torch.cat([d.boxes for d in padded]),
            torch.cat([d.scores for d in padded]),
            torch.cat([d.mask for d in padded]),
        )

    def _pad(self, length: int) -> Self:
        extra = length - self.mask.shape[-1]
        pad = torch.nn.functional.pad
        return type(self)(
            pad(self.boxes, (0, 0, 0, extra)), pad(self.scores, (0, 0, 0, extra)), pad(self.mask, (0, extra))
        )
