"""The map that an agent keeps: a Dirichlet belief about the class of every cell."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from semfov.belief.evidence import Observation, weigh
from semfov.belief.grid import Footprint, Grid
from semfov.belief.update import fuse
from semfov.detection.detections import Detections
from semfov.errors import check


class SemanticMap(nn.Module):
    """A grid of Dirichlet beliefs, `beta` of shape `(B, X·Y, K+1)`, one map for each episode of a batch.

    Args:
        grid: the cells.
        classes: names of the K classes, without background (index 0 of the belief).
        prior: Dirichlet parameter of every class before the first look.
        batch: number of maps.
        fusion: `kaplan`, `product` or `sum` (`semfov.fusion`).
        footprint: which cells a detection updates: `overlap`, `centre` or `box_centre` (`Grid.footprint`).
        observation: calibrates the scores; None takes raw scores as likelihoods.

    >>> from semfov import Detections
    >>> m = SemanticMap(Grid(2, 1, (10, 10)), ["cup"])
    >>> seen = Detections(torch.tensor([[[0.0, 0, 4, 4]]]), torch.tensor([[[0.2, 0.8]]]), torch.ones(1, 1).bool())
    >>> m.update(seen, torch.tensor([[2.0, 2.0]])).probabilities[0, :, 1]
    tensor([0.6500, 0.5000])
    """

    beta: Tensor

    def __init__(
        self,
        grid: Grid,
        classes: Sequence[str],
        prior: float = 0.5,
        *,
        batch: int = 1,
        fusion: str = "kaplan",
        footprint: Footprint = "overlap",
        observation: Observation | None = None,
    ) -> None:
        super().__init__()
        check(prior > 0, "prior", "a positive number", prior)
        self.grid = grid
        self.classes = tuple(classes)
        self.prior = prior
        self.fusion = fusion
        self.footprint: Footprint = footprint
        self.observation = observation
        self.register_buffer("beta", torch.full((batch, len(grid), len(self.classes) + 1), prior))

    @property
    def probabilities(self) -> Tensor:
        """Mean of every belief, `p_k = β_k / Σ β`, `(B, X·Y, K+1)`."""
        return mean(self.beta)

    def update(self, detections: Detections, fixation: Tensor) -> "SemanticMap":
        """Fuse the detections of one look from `fixation` `(B, 2)` and return the map itself."""
        evidence = weigh(detections, fixation, self.grid, self.observation, self.footprint)
        self.beta = fuse(self.beta, evidence.likelihood.to(self.beta.dtype), evidence.footprint, self.fusion)
        return self

    def forward(self, detections: Detections, fixation: Tensor) -> Tensor:
        """As `update`; returns the new parameters."""
        return self.update(detections, fixation).beta


def mean(beta: Tensor) -> Tensor:
    """Mean of Dirichlet beliefs `(..., K+1)`: `p_k = β_k / Σ β`."""
    return beta / beta.sum(-1, keepdim=True)
