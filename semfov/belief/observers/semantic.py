"""The observer of the paper (Luzio, Bernardino and Moreno, 2024): a Dirichlet over all classes in every cell."""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from torch import Tensor

from semfov.belief.belief import Belief, DirichletBelief, dirichlet_belief
from semfov.belief.fusion import RULES, fuse_scaled, scale_covering
from semfov.belief.grid import Footprint, Grid
from semfov.belief.likelihood import Observation, cells_of_detections, likelihoods
from semfov.belief.observers.base import Evidence, Observer, faded, own
from semfov.detection.detections import Detections
from semfov.errors import check, lookup
from semfov.observation.foveal import FovealObservationModel

CellMemory = Literal["all", "closest"]


@dataclass(frozen=True)
class SemanticEvidence(Evidence):
    """Likelihoods of a batch of looks.

    Attributes:
        likelihood: of the classes given each detection, `(B, L, K+1)`, scaled.
        footprint: the cells that each detection updates, `(B, L, X·Y)` (`fuse`).
        distance: from the fixation to each cell, `(B, X·Y)`.
    """

    by_detection = ("likelihood", "footprint")

    likelihood: Tensor
    footprint: Tensor
    distance: Tensor


class Semantic(Observer):
    r"""The observer of the paper: a Dirichlet over all classes in a cell, updated by each detection that covers it.

    Three options are not in the paper. They exist because looks at a static scene are not independent, and because
    cells without detections are evidence, too:

    - `tempering` τ: the likelihood λ is replaced by `λ^τ` (`likelihoods`).
    - `memory="closest"`: the belief about a cell comes from its closest look alone; one from nearer replaces it,

      .. math:: \beta(x) \leftarrow \mathrm{fuse}(\beta_0, \lambda) \quad \text{if } d(x, f) < \min_{f' < f} d(x, f')

    - `misses`: cells without detections are updated with the miss rate of each class at their distance.

    Args:
        components: K + 1, number of classes with background.
        observation: model that calibrates the scores; None uses the raw scores as likelihoods.
        prior: Dirichlet parameter of every class before the first look, positive.
        fusion: `kaplan`, `product`, `sum` or `semba` (`semfov.fusion`).
        footprint: rule for the cells that a detection updates (`Grid.footprint`).
        tempering: exponent τ of the likelihoods, positive.
        memory: `all` fuses all looks, as published; `closest` keeps only the closest look at each cell.
        misses: model of the miss rates; None makes no update in cells without detections.

    Raises:
        InputError: `prior` is not positive, or the fusion rule or the memory is unknown.

    >>> from semfov import Detections
    >>> grid, fixation = Grid(2, 1, (10, 10)), torch.tensor([[2.0, 2.0]])
    >>> seen = Detections(torch.tensor([[[0.0, 0, 4, 4]]]), torch.tensor([[[0.2, 0.8]]]), torch.ones(1, 1).bool())
    >>> observer = Semantic(2)
    >>> observer(observer.start(1, grid, fixation), seen, fixation, grid).probability(1)
    tensor([[0.6500, 0.5000]])
    """

    observation: Observation | None
    misses: FovealObservationModel | None

    def __init__(
        self,
        components: int,
        observation: Observation | None = None,
        *,
        prior: float = 0.5,
        fusion: str = "kaplan",
        footprint: Footprint = "overlap",
        tempering: float = 1.0,
        memory: CellMemory = "all",
        misses: FovealObservationModel | None = None,
    ) -> None:
        super().__init__()
        check(prior > 0, "prior", "a positive number", prior)
        lookup(fusion, RULES, "fusion rule")
        lookup(memory, get_args(CellMemory), "memory")
        self.components = components
        self.observation = observation
        self.prior = prior
        self.fusion = fusion
        self.footprint: Footprint = footprint
        self.tempering = tempering
        self.memory: CellMemory = memory
        self.misses = misses

    def start(self, batch: int, grid: Grid, like: Tensor) -> DirichletBelief:
        """Begin with the prior in every cell."""
        return DirichletBelief(like.new_full((batch, len(grid), self.components), self.prior))

    def weigh(
        self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None
    ) -> SemanticEvidence:
        """Compute the likelihoods of the detections (`likelihoods`), the same for every target."""
        likelihood = likelihoods(detections, fixation, grid, self.observation, tempering=self.tempering)
        cells = cells_of_detections(detections, grid, self.footprint)
        scaled = scale_covering(likelihood, cells)
        return SemanticEvidence(scaled, cells, grid.distance(fixation).to(likelihood))

    def update(self, belief: Belief, look: Evidence) -> DirichletBelief:
        """Fuse one more look in each episode."""
        semantic = own(look, SemanticEvidence, "look")
        old = dirichlet_belief(belief)
        nearest = torch.minimum(old.closest, semantic.distance)
        if self.memory == "all":
            return replace(old, beta=self._fuse(old.beta, semantic), closest=nearest)
        # A look from a nearer fixation replaces the belief about a cell; any other look does not change it.
        fused = self._fuse(torch.full_like(old.beta, self.prior), semantic)
        is_closer = (semantic.distance < old.closest)[..., None]
        return replace(old, beta=torch.where(is_closer, fused, old.beta), closest=nearest)

    def _fuse(self, before: Tensor, look: SemanticEvidence) -> Tensor:
        """Fuse the detections one after another, and misses in cells without any.

        Args:
            before: Dirichlet parameters `(B, X·Y, K+1)`.
            look: the look of each episode.

        Returns:
            New parameters.
        """
        fused = fuse_scaled(before, look.likelihood.to(before.dtype), look.footprint, self.fusion)
        if self.misses is None:
            return fused
        empty = ~(look.footprint > 0).any(-2)
        missed = RULES[self.fusion](fused, self.misses.miss_likelihood(look.distance).to(before.dtype))
        return torch.where(empty[..., None], missed, fused)

    def fade(self, belief: Belief, look: Evidence, keep: float, visited: Tensor) -> DirichletBelief:
        r"""Move the Dirichlet parameters towards the prior, :math:`\beta \leftarrow \beta_0 + k (\beta - \beta_0)`.

        The closest look counts as one from farther away.
        """
        return faded(dirichlet_belief(belief), self.prior, keep)

    def extra_repr(self) -> str:
        """Return prior, fusion rule, footprint and tempering for `repr`."""
        return f"prior={self.prior:g}, fusion={self.fusion}, footprint={self.footprint}, tempering={self.tempering:g}"
