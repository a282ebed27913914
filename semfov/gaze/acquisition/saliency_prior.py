"""Bottom-up saliency combined with a top-down acquisition function."""

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.errors import check, check_shape
from semfov.gaze.acquisition.base import AcquisitionFunction


class SaliencyPrior(AcquisitionFunction):
    r"""Another acquisition function multiplied by a saliency map, which acts as a prior over the cells.

    .. math:: a(x) = \ln v(x) + w \ln\frac{s(x) + \epsilon}{\sum_y (s(y) + \epsilon)}, \qquad
              \epsilon = 10^{-3} \max_y s(y)

    v is the value by the other function, such as the target's posterior. Values of 0 and below are replaced by the
    smallest positive number. With w = 0 only v counts. Luzio, Bernardino and Moreno (2024) name the integration of
    semantic information "with traditional bottom-up cues" as future work and give no formula. The product of prior and
    likelihood is that of Torralba, Oliva, Castelhano and Henderson (2006).

    Args:
        acquisition: the other acquisition function, v.
        saliency: s, `(..., X·Y)`, not negative (`semfov.saliency.cell_saliency`).
        weight: w, 0 or more.

    Raises:
        InputError: the weight or a saliency is negative.

    >>> from semfov import DirichletBelief, acquisition
    >>> belief = DirichletBelief(torch.tensor([[[1.0, 1.0], [1.0, 1.1]]]))
    >>> guided = SaliencyPrior(acquisition.TargetPosterior(1), torch.tensor([0.9, 0.1]), weight=0.3)
    >>> guided(belief, torch.zeros(1, 2, dtype=torch.bool)).argmax().item()
    0
    """

    log_prior: Tensor

    def __init__(self, acquisition: AcquisitionFunction, saliency: Tensor, *, weight: float) -> None:
        super().__init__()
        check(weight >= 0, "weight", "0 or more", weight)
        least = float(saliency.min())
        check(least >= 0, "saliency", "numbers of 0 or more", f"{least:g}")
        self.acquisition = acquisition
        self.weight = weight
        peak = saliency.amax(-1, keepdim=True)
        # Where saliency is 0 everywhere, as in a picture without contrast, the prior is uniform.
        raised = saliency + torch.where(peak > 0, 1e-3 * peak, 1.0)
        self.register_buffer("log_prior", (raised / raised.sum(-1, keepdim=True)).log())

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Compute values `(B, X·Y)`."""
        value: Tensor = self.acquisition(belief, visited)
        check_shape(self.log_prior, "saliency", value.shape[-1])
        least = torch.finfo(value.dtype).tiny
        log_value = one_by_one(lambda row: row.clamp(min=least).log(), value)
        return log_value + self.weight * self.log_prior.to(value)
