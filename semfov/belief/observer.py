"""Observers: how looks become a belief, and which looks count."""

from collections.abc import Callable
from typing import Any, Literal, Protocol, get_args

import torch
from torch import Tensor

from semfov.belief.belief import DirichletBelief
from semfov.belief.evidence import Evidence, Observation, weigh
from semfov.belief.fusion import RULES
from semfov.belief.grid import Footprint, Grid
from semfov.belief.update import fuse
from semfov.detection.detections import Detections
from semfov.errors import check, lookup

Memory = Literal["all", "closest"]


class Observer(Protocol):
    """Turns looks into a belief. What `weigh` returns can be indexed by look, and only `update` reads it.

    Attributes:
        by_target: whether what a look says depends on the target that is searched for.
    """

    by_target: bool

    def start(self, batch: int, grid: Grid, like: Tensor) -> Any:
        """The belief (`semfov.belief.Belief`) of `batch` episodes before the first look; dtype and device as `like`."""
        ...

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> Any:
        """What looks from `fixation` `(B, 2)` say."""
        ...

    def update(self, belief: Any, evidence: Any) -> Any:
        """The belief after a look in each episode."""
        ...


class SemanticObserver:
    r"""The paper's belief: a Dirichlet over all classes in every cell, updated by every detection that covers it.

    Options go beyond it, for looks at a static scene are not independent, and what is not detected says something
    too:

    - `tempering` τ: a likelihood counts as `λ^τ` (`semfov.weigh`).
    - `memory="closest"`: a cell's belief is what its closest look says, refreshed by a closer look and not multiplied,

      .. math:: \beta(x) \leftarrow \mathrm{fuse}(\beta_0, \lambda) \quad \text{if } d(x, f) < \min_{f' < f} d(x, f')

    - `misses`: cells in which nothing was detected are updated with the probability of that for each class at this
      distance.

    Args:
        components: number of classes, background included.
        observation: calibrates the scores; None takes raw scores as likelihoods.
        prior: Dirichlet parameter of every class before the first look.
        fusion: `kaplan`, `product` or `sum` (`semfov.fusion`).
        footprint: which cells a detection updates (`Grid.footprint`).
        tempering: exponent of the likelihoods.
        memory: `all` looks are fused, as published, or only what the `closest` look at each cell says.
        misses: likelihood of seeing nothing, a function of distances `(...)` that gives `(..., K+1)`
            (`semfov.MissModel`); None takes it to say nothing.
    """

    by_target = False

    def __init__(
        self,
        components: int,
        observation: Observation | None = None,
        *,
        prior: float = 0.5,
        fusion: str = "kaplan",
        footprint: Footprint = "overlap",
        tempering: float = 1.0,
        memory: Memory = "all",
        misses: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        check(prior > 0, "prior", "a positive number", prior)
        lookup(fusion, RULES, "fusion rule")
        lookup(memory, get_args(Memory), "memory")
        self.components = components
        self.observation = observation
        self.prior = prior
        self.fusion = fusion
        self.footprint: Footprint = footprint
        self.tempering = tempering
        self.memory: Memory = memory
        self.misses = misses

    def start(self, batch: int, grid: Grid, like: Tensor) -> DirichletBelief:
        """The prior in every cell."""
        return DirichletBelief.uniform(batch, len(grid), self.components, self.prior, like)

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> Evidence:
        """Likelihoods of the detections (`semfov.weigh`), the same for every target."""
        return weigh(detections, fixation, grid, self.observation, self.footprint, tempering=self.tempering)

    def update(self, belief: DirichletBelief, evidence: Evidence) -> DirichletBelief:
        """Fuse a look in each episode."""
        closest = torch.minimum(belief.closest, evidence.distance)
        if self.memory == "all":
            return DirichletBelief(self._fuse(belief.beta, evidence), closest)
        fresh = self._fuse(torch.full_like(belief.beta, self.prior), evidence)
        closer = evidence.distance < belief.closest
        return DirichletBelief(torch.where(closer[..., None], fresh, belief.beta), closest)

    def _fuse(self, beta: Tensor, evidence: Evidence) -> Tensor:
        fused = fuse(beta, evidence.likelihood.to(beta.dtype), evidence.footprint, self.fusion)
        if self.misses is None:
            return fused
        nothing = ~(evidence.footprint > 0).any(-2)
        unseen = RULES[self.fusion](fused, self.misses(evidence.distance).to(beta.dtype))
        return torch.where(nothing[..., None], unseen, fused)
