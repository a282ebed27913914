"""The observer of searches: a Dirichlet in each cell, if a look missed the object or one detection shows it."""

from dataclasses import dataclass, field, replace
from typing import Self

import torch
from torch import Tensor

from semfov.belief.association import one_of, refuted
from semfov.belief.belief import Belief, DirichletBelief, pick
from semfov.belief.fusion import RULES
from semfov.belief.grid import Footprint, Grid
from semfov.belief.likelihood import cells_of_detections, likelihood_ratios
from semfov.belief.observers.base import WEAK_PRIOR, Evidence, Observer, faded_parameters, farther, own
from semfov.belief.prior import Prior, PriorLike, with_prior
from semfov.detection.detections import Detections
from semfov.errors import check
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.presence import EVEN, Presence, log_evidence, presence_facts
from semfov.observation.thresholds import Thresholds


@dataclass(frozen=True)
class SearchEvidence(Evidence):
    """Likelihoods of a batch of looks, if at most one detection of each look shows the object of a cell.

    Attributes:
        ratio: likelihood of the classes given each detection, relative to background, `(B, L, K+1)`.
        weight: how well each detection fits each cell, `(B, L, X·Y)`.
        covered: the cells under each detection, `(B, L, X·Y)`.
        distance: from the fixation to each cell, `(B, X·Y)`, in longer sides of the image.
        fixated: the fixated cell, `(B,)`.
        evidence: `log_evidence` of the highest score of each class, `(B, K+1)`.
    """

    by_detection = ("ratio", "weight", "covered")

    ratio: Tensor
    weight: Tensor
    covered: Tensor
    distance: Tensor
    fixated: Tensor
    evidence: Tensor


@dataclass(frozen=True, repr=False)
class SearchBelief(DirichletBelief):
    """A Dirichlet belief of a search, under the condition that no fixated cell holds the target.

    Attributes:
        following: `(B, X·Y, K+1)`, Dirichlet parameters given that no fixated cell holds the target (`chance`); `beta`
            are those given the looks alone.
        visited: `(B, X·Y)` boolean, the fixated cells.
        evidence: `(B, K+1)`, `log_evidence` of the highest score of each class in any look.
        looks: `(B,)`, number of looks.
        footprint: rule for the weight of a detection in each cell (`Presence.of_cells`).
        calibration: by which it says whether the picture holds a class; None takes the most probable cell.
        prior: how often the target is there.
    """

    following: Tensor = None  # type: ignore[assignment]
    visited: Tensor = None  # type: ignore[assignment]
    evidence: Tensor = None  # type: ignore[assignment]
    looks: Tensor = None  # type: ignore[assignment]
    footprint: Footprint = "box_centre"
    calibration: Presence | None = None
    prior: Prior = field(default_factory=Prior)

    def probability(self, target: int | Tensor) -> Tensor:
        fitted = self._true(super().probability(target))
        if self.prior.changes_nothing:
            return fitted
        return self.prior.at_place(fitted, self._fitted_presence(target)[:, None])

    def chance(self, target: int | Tensor) -> Tensor:
        fitted = pick(self.following, target) / self.following.sum(-1)
        return self.prior(self._true(fitted))

    def _true(self, probability: Tensor) -> Tensor:
        """Make the probabilities of cells true, where the fit knows how."""
        return probability if self.calibration is None else self.calibration.of_cells(probability, self.footprint)

    def presence(self, target: int | Tensor) -> Tensor:
        if self.calibration is None:
            return self.prior(self._fitted_presence(target))
        return with_prior(self._log_odds(self.calibration, target), self.prior.share, self.prior.fitted).sigmoid()

    def _fitted_presence(self, target: int | Tensor) -> Tensor:
        """Compute the probability that the image holds the target, by the prior of the fit, `(B,)`."""
        if self.calibration is None:
            return super().probability(target).amax(-1)
        return self._log_odds(self.calibration, target).sigmoid()

    def _log_odds(self, calibration: Presence, target: int | Tensor) -> Tensor:
        """Compute the log odds that the image holds the target: 0 before the first look, and where all has faded."""
        return self.looks.clamp(max=1) * calibration(self.facts(target))

    def detach(self) -> Self:
        belief = super().detach()
        return belief if self.calibration is None else replace(belief, calibration=self.calibration.detach())

    def facts(self, target: int | Tensor) -> Tensor:
        """Return the facts for the probability of presence (`semfov.observation.presence.presence_facts`).

        Args:
            target: as for `probability`.

        Returns:
            `(B, 2)`.
        """
        return presence_facts(super().probability(target), pick(self.evidence, target))


class SemanticSearch(Observer):
    r"""A Dirichlet belief about all classes in every cell, with one likelihood for each cell and look.

    The detector missed the object of a cell, with odds m that depend on the distance d, or one of the detections l
    shows it (`semfov.belief.association`), with the weight w, which is 1 in the cell of its box's centre:

    .. math:: \lambda_k(x) = m_k(d) + \sum_l w_l(x) \, \frac{p(S_l \mid k, d_l)}{p(S_l \mid 0, d_l)},
              \qquad \lambda_0(x) = 1

    Kaplan's rule (`semfov.fusion.kaplan`) fuses it with a prior ε = 1e-5 of every class, which one look outweighs. The
    closest look at a cell counts, because looks at a static scene are not independent.

    A search goes on only if it has not fixated its target. For the next fixation (`Belief.chance`) a detection that
    covers a fixated cell therefore loses the share ρ of its weight, the model's `refutation`. Whether the picture holds
    the target at all is told by its most probable cell and by the highest score of all looks
    (`semfov.observation.Presence`).

    Args:
        model: calibrates the scores, and has the odds of a miss, ρ, and the calibration of presence, if it was fitted.
        prior: how often the target is there; None: in half of the pictures.
        footprint: rule for the weight w of a detection in each cell (`Grid.footprint`): a gaze lands best in the cell
            of its centre, `box_centre`; `overlap` tells for each cell whether it holds the target.

    >>> model = FovealObservationModel.identity(["cup", "cat"], [0.2], miss_odds=torch.full((3, 2), 0.1))
    >>> observer, grid = SemanticSearch(model), Grid(2, 1, (10, 10))
    >>> seen = Detections(torch.tensor([[[0.0, 0, 4, 4]]]), torch.tensor([[[0.2, 0.7, 0.1]]]), torch.ones(1, 1).bool())
    >>> belief = observer(observer.start(1, grid, torch.zeros(1)), seen, torch.tensor([[2.0, 2.0]]), grid)
    >>> belief.probability(1).detach()  # of a cup in each cell
    tensor([[0.6923, 0.0833]])
    """

    def __init__(
        self,
        model: FovealObservationModel,
        *,
        prior: Prior | None = None,
        footprint: Footprint = "box_centre",
    ) -> None:
        super().__init__()
        check(isinstance(model, FovealObservationModel), "model", "a FovealObservationModel", type(model).__name__)
        check(prior is None or isinstance(prior, Prior), "prior", "a Prior (`with_prior` takes a share)", prior)
        self.model = model
        self.footprint: Footprint = footprint
        self.prior = Prior() if prior is None else prior

    def with_prior(self, prior: PriorLike, target: int) -> Self:
        """Make an observer that assumes another share of searches with a present target.

        Args:
            prior: the share (`Prior.of`).
            target: class 1..K that is searched for.

        Returns:
            An observer with the same model.
        """
        presence = self.model.presence
        fitted = None if presence is None else EVEN
        usual = None if presence is None else float(presence.shares[target - 1])
        known = Prior.of(prior, fitted, usual)
        return type(self)(self.model, prior=known, footprint=self.footprint)

    @property
    def components(self) -> int:
        """K + 1, number of classes with background."""
        return len(self.model.classes) + 1

    @property
    def thresholds(self) -> Thresholds | None:
        """Thresholds of the model."""
        return None if self.model.presence is None else self.model.presence.thresholds

    def start(self, batch: int, grid: Grid, like: Tensor) -> SearchBelief:
        """Begin with the same small parameter for every class in every cell."""
        beta = like.new_full((batch, len(grid), self.components), WEAK_PRIOR)
        visited = torch.zeros_like(beta[..., 0], dtype=torch.bool)
        return SearchBelief(
            beta,
            following=beta,
            visited=visited,
            evidence=beta.new_zeros(batch, self.components),
            looks=beta.new_zeros(batch),
            footprint=self.footprint,
            calibration=self.model.presence,
            prior=self.prior,
        )

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> SearchEvidence:
        """Compute the likelihoods of the detections, relative to background, the same for every target."""
        ratio = likelihood_ratios(detections, fixation, grid, self.model)
        covered = cells_of_detections(detections, grid)
        weight = covered if self.footprint == "overlap" else cells_of_detections(detections, grid, self.footprint)
        return SearchEvidence(
            ratio=ratio,
            weight=weight,
            covered=covered,
            distance=grid.distance(fixation).to(ratio),
            fixated=grid.cell_of(fixation),
            evidence=log_evidence(detections.highest.to(ratio)),
        )

    def unseen(self, like: Tensor) -> Tensor:
        """Compute the class probabilities of a cell without detections, at the largest distance.

        Args:
            like: a tensor of the device and the precision of the result.

        Returns:
            `(K+1,)`, background first.
        """
        odds = self.model.miss_odds(like.new_ones(())).to(like)
        probability = odds / odds.sum()
        if self.model.presence is None:
            return probability
        return self.model.presence.of_cells(probability, self.footprint)

    def update(self, belief: Belief, look: Evidence) -> SearchBelief:
        """Fuse one look in each episode, into the belief and into the belief that chooses the next fixation."""
        old = own(belief, SearchBelief, "belief")
        seen = own(look, SearchEvidence, "look")
        visited = old.visited.scatter(1, seen.fixated[:, None], True)
        weight = seen.weight.to(old.beta)
        share = self.model.refutation.clamp(0, 1).to(old.beta)
        remaining = refuted(weight, seen.covered.to(old.beta), visited, share)
        odds = self.model.miss_odds(seen.distance).to(weight)
        fused = _fusion(seen, weight, odds)
        fused_for_next = _fusion(seen, remaining, odds)
        is_closer = (seen.distance < old.closest)[..., None]
        return replace(
            old,
            beta=torch.where(is_closer, fused, old.beta),
            following=torch.where(is_closer, fused_for_next, old.following),
            visited=visited,
            evidence=torch.maximum(old.evidence, seen.evidence.to(old.beta)),
            looks=old.looks + 1,
            closest=torch.minimum(old.closest, seen.distance),
            # That of a belief that was detached is a copy, through which the model would not learn.
            calibration=self.model.presence,
        )

    def fade(self, belief: Belief, look: Evidence, keep: float, visited: Tensor) -> SearchBelief:
        r"""Move the Dirichlet parameters towards the prior, and increase the distances of the closest looks.

        .. math:: \beta \leftarrow \beta_0 + k (\beta - \beta_0)
        """
        old = own(belief, SearchBelief, "belief")
        if keep == 1:
            return old
        return replace(
            old,
            beta=faded_parameters(old.beta, WEAK_PRIOR, keep),
            following=faded_parameters(old.following, WEAK_PRIOR, keep),
            visited=visited,
            evidence=keep * old.evidence,
            looks=keep * old.looks,
            closest=old.closest + farther(keep),
        )


def _fusion(look: SearchEvidence, weight: Tensor, odds: Tensor) -> Tensor:
    """Fuse the prior with a look, in which all detections and a miss are alternatives.

    Args:
        look: the look of each episode.
        weight: how well each detection fits each cell, `(B, L, X·Y)`.
        odds: of a miss, `(B, X·Y, K+1)`.

    Returns:
        Dirichlet parameters, `(B, X·Y, K+1)`.
    """
    likelihood = one_of(look.ratio.to(weight), weight, odds)
    scaled = likelihood / likelihood.amax(-1, keepdim=True)  # the rule without checks takes a maximum of 1
    return RULES["kaplan"](torch.full_like(odds, WEAK_PRIOR), scaled)
