"""From a detector's raw class scores to points of the simplex with a background component."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import torch
from torch import Tensor

from semfov.errors import InputError, check_shape, lookup

BackgroundPolicy = Literal["residual", "normalised", "uniform", "none", "own"]


@dataclass(frozen=True)
class Candidates:
    """Every box that a detector's head proposes, before any is thrown away.

    Attributes:
        boxes: `(B, N, 4)`, `(x1, y1, x2, y2)` in canvas pixels.
        classes: `(B, N, K)`, score of each class in [0, 1], as the head gives it.
        objectness: `(B, N)` in [0, 1], or None for heads that have none.
        background: `(B, N)` in [0, 1], the head's own background probability, or None.
    """

    boxes: Tensor
    classes: Tensor
    objectness: Tensor | None = None
    background: Tensor | None = None

    @cached_property
    def confidence(self) -> Tensor:
        """Objectness times the best class score, `(B, N)`: what detectors rank their boxes by."""
        best = self.classes.amax(-1)
        return best if self.objectness is None else best * self.objectness

    def take(self, image: int, index: Tensor) -> "Candidates":
        """Rows `index` of one image, without the batch dimension."""
        return Candidates(
            self.boxes[image, index],
            self.classes[image, index],
            None if self.objectness is None else self.objectness[image, index],
            None if self.background is None else self.background[image, index],
        )


def score_vectors(candidates: Candidates, policy: BackgroundPolicy = "residual") -> Tensor:
    r"""Full score vectors `(..., K+1)`, background first, each summing to 1.

    With class scores `c`, objectness `o` (or `o = max c` where the head has none) and `s_k = (1 - s_0) c_k / Σ c`:

    - `residual`: `s_0 = 1 - o`
    - `normalised`: `1 - o` and `o c_k` (`c_k` where the head has no objectness), all divided by their sum. Luzio,
      Bernardino and Moreno (2024) divide by the sum in a footnote; `1 - o` for background is ours
    - `uniform`: `s_0 = 1 / (K+1)`
    - `none`: `s_0 = 0`
    - `own`: `s_0` is the background probability that the head itself gives (heads with a softmax)

    >>> c = Candidates(torch.zeros(1, 4), torch.tensor([[0.6, 0.2]]), torch.tensor([0.5]))
    >>> score_vectors(c)
    tensor([[0.5000, 0.3750, 0.1250]])
    """
    lookup(policy, get_args(BackgroundPolicy), "background policy")
    classes = candidates.classes
    check_shape(classes, "classes", None)
    if policy == "own":
        if candidates.background is None:
            raise InputError("background policy 'own': expected a head with a background score of its own, got none")
        background = candidates.background
    elif policy == "residual":
        background = 1 - (classes.amax(-1) if candidates.objectness is None else candidates.objectness)
    elif policy == "normalised":
        seen = classes.amax(-1) if candidates.objectness is None else candidates.objectness
        sure = 1 if candidates.objectness is None else seen
        # (1 - o) / (1 - o + o Σ c): the other scores then share what is left as those of every policy do.
        background = (1 - seen) / (1 - seen + sure * classes.sum(-1)).clamp(min=torch.finfo(classes.dtype).tiny)
    elif policy == "uniform":
        background = torch.full_like(classes[..., 0], 1 / (classes.shape[-1] + 1))
    else:
        background = torch.zeros_like(classes[..., 0])
    background = background[..., None]
    floor = torch.finfo(classes.dtype).tiny
    shares = classes.clamp(min=floor)
    return torch.cat([background, (1 - background) * shares / shares.sum(-1, keepdim=True)], -1)
