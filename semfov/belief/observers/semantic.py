"""The paper's observer: a Dirichlet about all classes in every cell."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, get_args

import torch
from torch import Tensor
from torch.nn.functional import pad

from semfov.belief.belief import Belief, DirichletBelief, dirichlet_belief
from semfov.belief.evidence import farther
from semfov.belief.fusion import RULES, fuse
from semfov.belief.grid import Footprint, Grid
from semfov.belief.likelihood import Observation, likelihoods
from semfov.belief.observers.base import Look, Observer, own
from semfov.detection.detections import Detections
from semfov.errors import check, lookup

Memory = Literal["all", "closest"]


class MissModel(Protocol):
    """A model that tells how likely it is to see nothing (`semfov.FovealObservationModel`)."""

    def miss_likelihood(self, distance: Tensor) -> Tensor:
        """Likelihoods `(..., K+1)` of each class where nothing was detected, at distances `(...)`."""
        ...


@dataclass(frozen=True)
class SemanticLook(Look):
    """Likelihoods of a batch of looks, ready to be fused.

    Attributes:
        likelihood: `(B, L, K+1)`, likelihood of each class for each detection, up to a factor.
        footprint: `(B, L, X·Y)`, the cells that each detection concerns: boolean, or weights in [0, 1] that are the
            exponents of the likelihood; false or 0 for padding.
        distance: `(B, X·Y)`, from the fixation to every cell, in longer sides of the image.
    """

    likelihood: Tensor
    footprint: Tensor
    distance: Tensor

    def __getitem__(self, index: Tensor | slice) -> "SemanticLook":
        """Some of the looks."""
        return SemanticLook(self.likelihood[index], self.footprint[index], self.distance[index])

    @classmethod
    def join(cls, looks: Sequence["SemanticLook"]) -> "SemanticLook":
        """All looks of several batches; what has fewer detections is filled up with some that concern no cell."""
        most = max(look.likelihood.shape[-2] for look in looks)

        def filled(values: Tensor) -> Tensor:
            return pad(values, (0, 0, 0, most - values.shape[-2]))

        return cls(
            torch.cat([filled(look.likelihood) for look in looks]),
            torch.cat([filled(look.footprint) for look in looks]),
            torch.cat([look.distance for look in looks]),
        )


class Semantic(Observer):
    r"""The paper's belief: a Dirichlet over all classes in every cell, updated by every detection that covers it.

    Options go beyond it, for looks at a static scene are not independent, and what is not detected says something
    too:

    - `tempering` τ: a likelihood counts as `λ^τ` (`likelihoods`).
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
        misses: the model that tells how likely it is to see nothing; None takes that to say nothing.

    >>> from semfov import Detections
    >>> grid, fixation = Grid(2, 1, (10, 10)), torch.tensor([[2.0, 2.0]])
    >>> seen = Detections(torch.tensor([[[0.0, 0, 4, 4]]]), torch.tensor([[[0.2, 0.8]]]), torch.ones(1, 1).bool())
    >>> observer = Semantic(2)
    >>> observer(observer.start(1, grid, fixation), seen, fixation, grid).probability(1)
    tensor([[0.6500, 0.5000]])
    """

    observation: Observation | None
    misses: MissModel | None

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
        misses: MissModel | None = None,
    ) -> None:
        super().__init__()
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

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> SemanticLook:
        """Likelihoods of the detections (`likelihoods`), the same for every target."""
        likelihood = likelihoods(detections, fixation, grid, self.observation, tempering=self.tempering)
        cells = grid.footprint(detections.boxes, self.footprint) * detections.mask[..., None]
        return SemanticLook(likelihood, cells, grid.distance(fixation).to(likelihood))

    def update(self, belief: Belief, look: Look) -> DirichletBelief:
        """Fuse a look in each episode."""
        known, said = dirichlet_belief(belief), own(look, SemanticLook, "look")
        closest = torch.minimum(known.closest, said.distance)
        if self.memory == "all":
            return DirichletBelief(self._fuse(known.beta, said), closest)
        fresh = self._fuse(torch.full_like(known.beta, self.prior), said)
        closer = said.distance < known.closest
        return DirichletBelief(torch.where(closer[..., None], fresh, known.beta), closest)

    def fade(self, belief: Belief, look: Look, keep: float, visited: Tensor) -> DirichletBelief:
        r"""Dirichlet parameters return to the prior, :math:`\beta \leftarrow \beta_0 + k (\beta - \beta_0)`.

        The closest look counts as one from farther away, as that of a learned belief does (`Gatherer.fade`).
        """
        known = dirichlet_belief(belief)
        if keep == 1:
            return known
        return DirichletBelief(self.prior + keep * (known.beta - self.prior), known.closest + farther(keep))

    def _fuse(self, beta: Tensor, look: SemanticLook) -> Tensor:
        fused = fuse(beta, look.likelihood.to(beta.dtype), look.footprint, self.fusion)
        if self.misses is None:
            return fused
        nothing = ~(look.footprint > 0).any(-2)
        unseen = RULES[self.fusion](fused, self.misses.miss_likelihood(look.distance).to(beta.dtype))
        return torch.where(nothing[..., None], unseen, fused)

    def extra_repr(self) -> str:
        """Settings, for `repr`."""
        return f"prior={self.prior:g}, fusion={self.fusion}, footprint={self.footprint}, tempering={self.tempering:g}"
