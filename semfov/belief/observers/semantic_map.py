"""The observer of explorations: a Dirichlet over all classes in each cell, with one likelihood for each look."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from semfov.belief.belief import Belief, DirichletBelief, dirichlet_belief
from semfov.belief.fusion import RULES
from semfov.belief.grid import Grid
from semfov.belief.likelihood import cells_of_detections, likelihood_ratios
from semfov.belief.observers.base import WEAK_PRIOR, Evidence, Observer, faded, own
from semfov.detection.detections import Detections
from semfov.observation.foveal import FovealObservationModel
from semfov.precision import exact_product


@dataclass(frozen=True)
class CellEvidence(Evidence):
    """Evidence of looks about whole cells.

    Attributes:
        ratio: likelihood of the classes given a detection, relative to background, summed over the detections that
            overlap each cell, `(B, X·Y, K+1)`.
        distance: from the fixation to each cell, `(B, X·Y)`, in longer sides of the image.
    """

    ratio: Tensor
    distance: Tensor


class SemanticMap(Observer):
    r"""A Dirichlet belief about what each cell holds, in which the closest look at a cell counts.

    A look has one likelihood for each cell: the detector missed its object, with odds m, or one of the detections l
    that overlap the cell shows it (`semfov.belief.association`). An exponent a and a weight of background w calibrate
    it:

    .. math:: \lambda_k(x) = \Bigl(m + \sum_{l \ni x} \frac{p(S_l \mid k, d_l)}{p(S_l \mid 0, d_l)}\Bigr)^a,
              \qquad \lambda_0(x) = w

    Kaplan's rule (`semfov.fusion.kaplan`) fuses it with a prior ε = 1e-5 of every class. The mean of the belief is then
    :math:`(\varepsilon + P_k) / (1 + (K + 1) \varepsilon)` with :math:`P_k = \lambda_k / \sum_j \lambda_j`, which is as
    good as P. A look from a nearer fixation replaces earlier ones, because looks at a still scene are not independent.

    Args:
        model: calibrates the scores, and has m, a and w (its `log_cell`).

    >>> model = FovealObservationModel.identity(["cup", "cat"], [0.2], cell=(0.01, 1.0, 1.0))
    >>> observer, grid = SemanticMap(model), Grid(2, 1, (10, 10))
    >>> seen = Detections(torch.tensor([[[0.0, 0, 4, 4]]]), torch.tensor([[[0.2, 0.7, 0.1]]]), torch.ones(1, 1).bool())
    >>> belief = observer(observer.start(1, grid, torch.zeros(1)), seen, torch.tensor([[2.0, 2.0]]), grid)
    >>> belief.class_probabilities().argmax(-1)  # a cup, and nothing
    tensor([[1, 0]])
    """

    def __init__(self, model: FovealObservationModel) -> None:
        super().__init__()
        self.model = model

    @property
    def components(self) -> int:
        """K + 1, number of classes with background."""
        return len(self.model.classes) + 1

    def start(self, batch: int, grid: Grid, like: Tensor) -> DirichletBelief:
        """Begin with the same small parameter for every class in every cell."""
        return DirichletBelief(like.new_full((batch, len(grid), self.components), WEAK_PRIOR))

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> CellEvidence:
        """Sum the likelihood ratios of the detections in each cell, the same for every target."""
        ratio = likelihood_ratios(detections, fixation, grid, self.model)
        covered = cells_of_detections(detections, grid).to(ratio)
        ratio_of_cells = exact_product(covered.mT, ratio)  # (B, X·Y, K+1)
        return CellEvidence(ratio_of_cells, grid.distance(fixation).to(ratio))

    def log_likelihood(self, ratio: Tensor) -> Tensor:
        """Compute the logarithm of the likelihood of every class in a cell.

        Args:
            ratio: `(..., K+1)`, sums of its detections (`CellEvidence`).

        Returns:
            `(..., K+1)`, ln λ; differentiable in the numbers of the model.
        """
        log_miss, log_exponent, log_background = self.model.log_cell.to(ratio)
        # Not the likelihood, which is larger than any number of 32 bits where the exponent is.
        objects = log_exponent.exp() * (log_miss.exp() + ratio[..., 1:]).log()
        return torch.cat([log_background.expand_as(objects[..., :1]), objects], -1)

    def unseen(self, like: Tensor) -> Tensor:
        """Compute the class probabilities of a cell without any detection.

        Args:
            like: a tensor of the device and the precision of the result.

        Returns:
            `(K+1,)`, background first.
        """
        return self.log_likelihood(like.new_zeros(self.components)).softmax(-1)

    def update(self, belief: Belief, look: Evidence) -> DirichletBelief:
        """Replace the belief in cells to which this fixation is nearer than all earlier ones."""
        old = dirichlet_belief(belief)
        cells = own(look, CellEvidence, "look")
        prior = torch.full_like(old.beta, WEAK_PRIOR)
        likelihood = self.log_likelihood(cells.ratio.to(prior)).softmax(-1)
        fused = RULES["kaplan"](prior, likelihood)
        is_closer = (cells.distance < old.closest)[..., None]
        return replace(
            old,
            beta=torch.where(is_closer, fused, old.beta),
            closest=torch.minimum(cells.distance, old.closest),
        )

    def fade(self, belief: Belief, look: Evidence, keep: float, visited: Tensor) -> DirichletBelief:
        r"""Move the Dirichlet parameters towards the prior, and increase the distances of the closest looks.

        .. math:: \beta \leftarrow \beta_0 + k (\beta - \beta_0)
        """
        return faded(dirichlet_belief(belief), WEAK_PRIOR, keep)
