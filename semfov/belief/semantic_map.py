"""The map that an agent keeps: a Dirichlet belief about the class of every cell."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from semfov.belief.belief import DirichletBelief
from semfov.belief.evidence import Observation
from semfov.belief.grid import Footprint, Grid
from semfov.belief.observer import Memory, SemanticObserver
from semfov.detection.detections import Detections
from semfov.observation import dirichlet


class SemanticMap(nn.Module):
    """A grid of Dirichlet beliefs, `beta` of shape `(B, X·Y, K+1)`, one map for each episode of a batch.

    Args:
        grid: the cells.
        classes: names of the K classes, without background (index 0 of the belief).
        prior: Dirichlet parameter of every class before the first look.
        batch: number of maps.
        fusion: `kaplan`, `product` or `sum` (`semfov.fusion`).
        footprint: which cells a detection updates: `overlap`, `centre`, `box_centre` or `soft` (`Grid.footprint`).
        observation: calibrates the scores; None takes raw scores as likelihoods.
        tempering: see `SemanticObserver`, as for `memory` and `misses`.

    >>> from semfov import Detections
    >>> m = SemanticMap(Grid(2, 1, (10, 10)), ["cup"])
    >>> seen = Detections(torch.tensor([[[0.0, 0, 4, 4]]]), torch.tensor([[[0.2, 0.8]]]), torch.ones(1, 1).bool())
    >>> m.update(seen, torch.tensor([[2.0, 2.0]])).probabilities[0, :, 1]
    tensor([0.6500, 0.5000])
    """

    beta: Tensor
    closest: Tensor

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
        tempering: float = 1.0,
        memory: Memory = "all",
        misses: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        super().__init__()
        self.grid = grid
        self.classes = tuple(classes)
        components = len(self.classes) + 1
        self.observation = observation
        self.misses = misses
        self._observer = SemanticObserver(
            components,
            observation,
            prior=prior,
            fusion=fusion,
            footprint=footprint,
            tempering=tempering,
            memory=memory,
            misses=misses,
        )
        start = self._observer.start(batch, grid, torch.empty(0))
        self.register_buffer("beta", start.beta)
        self.register_buffer("closest", start.closest)

    @property
    def probabilities(self) -> Tensor:
        """Mean of every belief, `p_k = β_k / Σ β`, `(B, X·Y, K+1)`."""
        return dirichlet.mean(self.beta)

    def update(self, detections: Detections, fixation: Tensor) -> "SemanticMap":
        """Fuse the detections of one look from `fixation` `(B, 2)` and return the map itself."""
        evidence = self._observer.weigh(detections, fixation, self.grid)
        belief = self._observer.update(DirichletBelief(self.beta, self.closest), evidence)
        self.beta, self.closest = belief.beta, belief.closest
        return self

    def forward(self, detections: Detections, fixation: Tensor) -> Tensor:
        """As `update`; returns the new parameters."""
        return self.update(detections, fixation).beta
