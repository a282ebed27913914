"""Score vectors with a background component, from a detector's raw class scores."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, get_args

import torch
from torch import Tensor

from semfov.errors import InputError, check_shape, lookup

BackgroundPolicy = Literal["residual", "normalised", "uniform", "none", "own"]

HALVES = (torch.float16, torch.bfloat16)  # half precisions


@dataclass(frozen=True)
class Candidates:
    """All boxes of a detector's head, before any selection.

    Attributes:
        boxes: `(B, N, 4)`, `(x1, y1, x2, y2)` in canvas pixels.
        classes: `(B, N, K)`, the head's score of each class, in [0, 1].
        objectness: `(B, N)` in [0, 1]; None for heads without objectness.
        background: `(B, N)` in [0, 1], the head's own background probability; None for heads without one.
        are_checked: whether the boxes are known to be finite, and the scores to lie in [0, 1] (`as_checked`).

    >>> classes = torch.tensor([[[0.5, 0.25], [0.5, 1.0]]])
    >>> Candidates(torch.zeros(1, 2, 4), classes, torch.tensor([[0.5, 1.0]])).confidence
    tensor([[0.2500, 1.0000]])
    """

    boxes: Tensor
    classes: Tensor
    objectness: Tensor | None = None
    background: Tensor | None = None
    are_checked: bool = field(default=False, init=False)

    @cached_property
    def confidence(self) -> Tensor:
        """Objectness times the best class score, `(B, N)`, by which detectors rank their boxes."""
        best = self.classes.amax(-1)
        return best if self.objectness is None else best * self.objectness

    def as_checked(self) -> "Candidates":
        """Mark boxes as finite and scores as within [0, 1], so that they are not checked again.

        Parts and copies on another device keep it; other numbers in place of some (`dataclasses.replace`) do not.

        Returns:
            The same boxes.
        """
        object.__setattr__(self, "are_checked", True)
        return self

    def precise(self) -> "Candidates":
        """Convert half precision, which is too coarse for pixels, to float32; other precisions stay as they are."""
        coarse = self.boxes.dtype in HALVES or self.classes.dtype in HALVES
        return self._mapped(Tensor.float) if coarse else self

    def to(self, device: torch.device) -> "Candidates":
        """Move the boxes and scores to a device.

        Args:
            device: the device.

        Returns:
            The same where they are there, else copies.
        """
        return self if self.boxes.device == device else self._mapped(lambda tensor: tensor.to(device))

    def take(self, image: int, index: Tensor) -> "Candidates":
        """Select boxes of one image by index.

        Args:
            image: index of the image in the batch.
            index: indices of the boxes, `(M,)`.

        Returns:
            The boxes `(M, 4)` and their scores, without the batch dimension.
        """
        return self._mapped(lambda tensor: tensor[image].index_select(0, index))

    def _mapped(self, function: Callable[[Tensor], Tensor]) -> "Candidates":
        """Apply a function to each tensor."""
        objectness = None if self.objectness is None else function(self.objectness)
        background = None if self.background is None else function(self.background)
        mapped = Candidates(function(self.boxes), function(self.classes), objectness, background)
        return mapped.as_checked() if self.are_checked else mapped


def score_vectors(candidates: Candidates, policy: BackgroundPolicy = "residual") -> Tensor:
    r"""Compute full score vectors with a background score, each of which sums to 1.

    With class scores `c` and objectness `o` (`o = max c` where the head has none), class k gets the score
    `s_k = (1 - s_0) c_k / Σ c`. The policy determines the background score `s_0`:

    - `residual`: `s_0 = 1 - o`.
    - `normalised`: `1 - o` and `o c_k` (`c_k` where the head has no objectness) are divided by their sum. Luzio,
      Bernardino and Moreno (2024) divide by the sum in a footnote; `1 - o` for background is ours.
    - `uniform`: `s_0 = 1 / (K+1)`.
    - `none`: `s_0 = 0`.
    - `own`: `s_0` is the head's own background probability (for heads with a softmax).

    Args:
        candidates: boxes with class scores `(..., K)`.
        policy: background policy.

    Returns:
        Score vectors `(..., K+1)`, background first.

    Raises:
        InputError: the policy is unknown, or is `own` for a head without a background score.

    >>> c = Candidates(torch.zeros(1, 4), torch.tensor([[0.6, 0.2]]), torch.tensor([0.5]))
    >>> score_vectors(c)
    tensor([[0.5000, 0.3750, 0.1250]])
    """
    background, classes = shares(candidates, policy)
    return torch.cat([background[..., None], classes], -1)


def shares(candidates: Candidates, policy: BackgroundPolicy) -> tuple[Tensor, Tensor]:
    """Compute the parts of `score_vectors`.

    Args:
        candidates: boxes with class scores `(..., K)`.
        policy: background policy.

    Returns:
        The background score `(...)`, and the scores of the classes `(..., K)`.

    Raises:
        InputError: the policy is unknown, or is `own` for a head without a background score.
    """
    lookup(policy, get_args(BackgroundPolicy), "background policy")
    classes = candidates.classes
    check_shape(classes, "classes", None)
    background = _BACKGROUNDS[policy](candidates)
    # Where all scores are 0, the classes share equally instead of 0 / 0.
    classes = classes.clamp(min=torch.finfo(classes.dtype).tiny)
    return background, (1 - background)[..., None] * classes / classes.sum(-1, keepdim=True)


# Background scores `s_0` `(...)` by policy; `score_vectors` has the formulas.


def _residual(candidates: Candidates) -> Tensor:
    """Compute `1 - o`; where the head has no objectness, the best class score is `o`."""
    if candidates.objectness is None:
        return 1 - candidates.classes.amax(-1)
    return 1 - candidates.objectness


def _normalised(candidates: Candidates) -> Tensor:
    """Compute `(1 - o) / (1 - o + Σ o c)`, or with `Σ c` where the head has no objectness."""
    background = _residual(candidates)
    total_of_classes = candidates.classes.sum(-1)
    if candidates.objectness is not None:
        total_of_classes = candidates.objectness * total_of_classes
    total = background + total_of_classes
    return background / total.clamp(min=torch.finfo(candidates.classes.dtype).tiny)


def _uniform(candidates: Candidates) -> Tensor:
    """Compute `1 / (K + 1)`."""
    classes = candidates.classes
    return torch.full_like(classes[..., 0], 1 / (classes.shape[-1] + 1))


def _none(candidates: Candidates) -> Tensor:
    """Compute 0."""
    return torch.zeros_like(candidates.classes[..., 0])


def _own(candidates: Candidates) -> Tensor:
    """Take the background probability of the head; raises `InputError` where it has none."""
    if candidates.background is None:
        raise InputError("background: expected a head with a score for the policy 'own', got none; use 'residual'")
    return candidates.background


_BACKGROUNDS: dict[BackgroundPolicy, Callable[[Candidates], Tensor]] = {
    "residual": _residual,
    "normalised": _normalised,
    "uniform": _uniform,
    "none": _none,
    "own": _own,
}
