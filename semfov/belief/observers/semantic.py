"""The paper's observer: a Dirichlet belief about all classes in every cell."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal, Self, get_args

import torch
from torch import Tensor
from torch.nn.functional import pad

from semfov.belief.association import one_of, refuted
from semfov.belief.belief import Belief, DirichletBelief, dirichlet_belief, pick
from semfov.belief.evidence import farther
from semfov.belief.fusion import RULES, fuse_scaled, scale_covering
from semfov.belief.grid import Footprint, Grid
from semfov.belief.likelihood import Observation, likelihoods
from semfov.belief.observers.base import Look, Observer, own
from semfov.detection.detections import Detections
from semfov.errors import check, lookup
from semfov.observation.foveal import FovealObservationModel

CellMemory = Literal["all", "closest"]
Association = Literal["each", "one"]

_LEAST = 1e-6  # of the likelihood of background, by which the others are divided
_WEAK = 1e-5  # Dirichlet parameter of a prior that one look outweighs


@dataclass(frozen=True)
class SemanticLook(Look):
    """Likelihoods of a batch of looks.

    Attributes:
        likelihood: of the classes given each detection, `(B, L, K+1)`, scaled.
        footprint: the cells that each detection updates, `(B, L, X·Y)` (`fuse`).
        distance: from the fixation to each cell, `(B, X·Y)`.
    """

    likelihood: Tensor
    footprint: Tensor
    distance: Tensor

    @classmethod
    def join(cls, looks: Sequence[Self]) -> Self:
        """Concatenate several batches of looks, padded to the largest number of detections."""
        detections = max(look.likelihood.shape[-2] for look in looks)

        def joined(name: str) -> Tensor:
            values = [getattr(look, name) for look in looks]
            if name in ("likelihood", "footprint", "covered"):
                values = [pad(value, (0, 0, 0, detections - value.shape[-2])) for value in values]
            return torch.cat(values)

        return cls(*(joined(field.name) for field in fields(cls)))


@dataclass(frozen=True)
class AssociatedLook(SemanticLook):
    """Looks of which one detection may show the object of a cell; likelihoods are relative to background.

    `covered` `(B, L, X·Y)` are the cells under each detection, and `fixated` `(B,)` is the fixated cell.
    """

    covered: Tensor
    fixated: Tensor


@dataclass(frozen=True)
class AssociatedBelief(DirichletBelief):
    """A Dirichlet belief of a search, which goes on only if it has not fixated its target.

    Attributes:
        following: `(B, X·Y, K+1)`, Dirichlet parameters given that no fixated cell holds the target (`chance`); `beta`
            are those given the looks alone.
        visited: `(B, X·Y)` boolean, the fixated cells.
    """

    following: Tensor = None  # type: ignore[assignment]
    visited: Tensor = None  # type: ignore[assignment]

    def chance(self, target: int | Tensor) -> Tensor:
        """Give the posterior of the target class in each cell, given that no fixated cell holds it, `(B, X·Y)`."""
        return pick(self.following, torch.as_tensor(target)) / self.following.sum(-1)


class Semantic(Observer):
    r"""The paper's observer: a Dirichlet over all classes in every cell, updated by every detection that covers it.

    Four options are not in the paper. They exist because looks at a static scene are not independent, because cells
    without detections are evidence, too, and because a cell is shown by one of several detections:

    - `tempering` τ: the likelihood λ is replaced by `λ^τ` (`likelihoods`).
    - `memory="closest"`: the belief about a cell comes from its closest look alone; a closer look replaces it,

      .. math:: \beta(x) \leftarrow \mathrm{fuse}(\beta_0, \lambda) \quad \text{if } d(x, f) < \min_{f' < f} d(x, f')

    - `misses`: cells without detections are updated with the miss rate of each class at their distance.
    - `association="one"`: a look has one likelihood for each cell, in which detections and a miss are alternatives
      (`semfov.belief.association`), and it is fused once. A search goes on only if it has not fixated its target: for
      the next fixation (`Belief.chance`) detections that cover fixated cells lose weight, by the `refutation` of
      `misses`.

    Args:
        components: K + 1, number of classes with background.
        observation: model that calibrates the scores; None uses the raw scores as likelihoods.
        prior: Dirichlet parameter of every class before the first look, positive.
        fusion: `kaplan`, `product`, `sum` or `semba` (`semfov.fusion`).
        footprint: rule for the cells that a detection updates (`Grid.footprint`).
        tempering: exponent τ of the likelihoods, positive.
        memory: `all` fuses all looks, as published; `closest` keeps only the closest look at each cell.
        misses: model of the miss rates; None makes no update in cells without detections.
        association: `each` fuses every detection that covers a cell, as published; `one` takes at most one of them to
            show the object, and needs `misses`.

    Raises:
        InputError: `prior` is not positive, the fusion rule, the memory or the association is unknown, or `misses` is
            missing.

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
        association: Association = "each",
    ) -> None:
        super().__init__()
        check(prior > 0, "prior", "a positive number", prior)
        lookup(fusion, RULES, "fusion rule")
        lookup(memory, get_args(CellMemory), "memory")
        lookup(association, get_args(Association), "association")
        check(association == "each" or misses is not None, "misses", "a model for association='one'", None)
        self.components = components
        self.observation = observation
        self.prior = prior
        self.fusion = fusion
        self.footprint: Footprint = footprint
        self.tempering = tempering
        self.memory: CellMemory = memory
        self.misses = misses
        self.association: Association = association

    @classmethod
    def searching(cls, model: FovealObservationModel) -> Self:
        """Make the observer of a search whose model was fitted through the belief (`fit_through_belief`).

        Args:
            model: calibrates the scores, and has the odds of a miss and the refutation.

        Returns:
            An observer with `association="one"`, the closest look at each cell, and a prior that one look outweighs.
        """
        components = len(model.classes) + 1
        return cls(
            components,
            model,
            prior=_WEAK,
            footprint="box_centre",
            memory="closest",
            misses=model,
            association="one",
        )

    def start(self, batch: int, grid: Grid, like: Tensor) -> DirichletBelief:
        """Begin with the prior in every cell."""
        beta = like.new_full((batch, len(grid), self.components), self.prior)
        if self.association == "each":
            return DirichletBelief(beta)
        return AssociatedBelief(beta, following=beta, visited=torch.zeros_like(beta[..., 0], dtype=torch.bool))

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> SemanticLook:
        """Compute the likelihoods of the detections (`likelihoods`), the same for every target."""
        likelihood = likelihoods(detections, fixation, grid, self.observation, tempering=self.tempering)
        cells = grid.footprint(detections.boxes, self.footprint) * detections.mask[..., None]
        distance = grid.distance(fixation).to(likelihood)
        if self.association == "each":
            return SemanticLook(scale_covering(likelihood, cells), cells, distance)
        # One detection or a miss shows the object of a cell (`one_of`), each relative to background.
        ratio = likelihood / likelihood[..., :1].clamp(min=_LEAST)
        covered = grid.footprint(detections.boxes) * detections.mask[..., None]
        return AssociatedLook(ratio, cells, distance, covered, grid.cell_of(fixation))

    def update(self, belief: Belief, look: Look) -> DirichletBelief:
        """Fuse one more look in each episode."""
        semantic = own(look, SemanticLook, "look")
        if self.association == "one":
            return self._update_one(own(belief, AssociatedBelief, "belief"), own(look, AssociatedLook, "look"))
        old = dirichlet_belief(belief)
        fused = self._fuse_each(self._before(old.beta), semantic)
        return replace(old, beta=self._kept(old, old.beta, fused, semantic), closest=_closest(old, semantic))

    def _update_one(self, old: AssociatedBelief, look: AssociatedLook) -> AssociatedBelief:
        """Fuse a look of which one detection shows the object of a cell: given the looks, and for the next fixation."""
        assert self.misses is not None
        visited = old.visited.scatter(1, look.fixated[:, None], True)
        weight = look.footprint.to(old.beta)
        share = self.misses.refutation.clamp(0, 1).to(old.beta)
        remaining = refuted(weight, look.covered.to(old.beta), visited, share)
        present = self._fuse_one(self._before(old.beta), look, weight)
        following = self._fuse_one(self._before(old.following), look, remaining)
        return replace(
            old,
            beta=self._kept(old, old.beta, present, look),
            following=self._kept(old, old.following, following, look),
            visited=visited,
            closest=_closest(old, look),
        )

    def _before(self, beta: Tensor) -> Tensor:
        """Return the Dirichlet parameters that a look is fused with: the prior, where the closest look alone counts."""
        return beta if self.memory == "all" else torch.full_like(beta, self.prior)

    def _kept(self, old: DirichletBelief, beta: Tensor, fused: Tensor, look: SemanticLook) -> Tensor:
        """Choose between old and new Dirichlet parameters: a cell takes all of a closer look, or nothing of it."""
        if self.memory == "all":
            return fused
        return torch.where((look.distance < old.closest)[..., None], fused, beta)

    def _fuse_each(self, before: Tensor, look: SemanticLook) -> Tensor:
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

    def _fuse_one(self, before: Tensor, look: AssociatedLook, weight: Tensor) -> Tensor:
        """Fuse one likelihood for each cell, in which all detections of a look and a miss are alternatives.

        Args:
            before: Dirichlet parameters `(B, X·Y, K+1)`.
            look: the look of each episode.
            weight: how well each detection fits each cell, `(B, L, X·Y)`.

        Returns:
            New parameters.
        """
        assert self.misses is not None
        odds = self.misses.miss_odds(look.distance).to(before)
        likelihood = one_of(look.likelihood.to(before), weight, odds)
        return RULES[self.fusion](before, likelihood / likelihood.amax(-1, keepdim=True))

    def fade(self, belief: Belief, look: Look, keep: float, visited: Tensor) -> DirichletBelief:
        r"""Move the Dirichlet parameters towards the prior, :math:`\beta \leftarrow \beta_0 + k (\beta - \beta_0)`.

        The closest look counts as one from farther away, as in the learned observers (`Gatherer.fade`).
        """
        belief = dirichlet_belief(belief)
        if keep == 1:
            return belief
        faded = replace(belief, beta=self._faded(belief.beta, keep), closest=belief.closest + farther(keep))
        if isinstance(faded, AssociatedBelief):
            return replace(faded, following=self._faded(faded.following, keep), visited=visited)
        return faded

    def _faded(self, beta: Tensor, keep: float) -> Tensor:
        """Move Dirichlet parameters towards the prior."""
        return self.prior + keep * (beta - self.prior)

    def extra_repr(self) -> str:
        """Write prior, fusion rule, footprint and tempering."""
        return f"prior={self.prior:g}, fusion={self.fusion}, footprint={self.footprint}, tempering={self.tempering:g}"


def _closest(belief: DirichletBelief, look: SemanticLook) -> Tensor:
    """Compute the distance from each cell to the closest fixation after one more look, `(B, X·Y)`."""
    return torch.minimum(belief.closest, look.distance)
