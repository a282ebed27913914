"""Bottom-up saliency beside top-down value."""

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.errors import check, check_shape
from semfov.gaze.acquisition.base import AcquisitionFunction


class SaliencyPrior(AcquisitionFunction):
    r"""Semantic value times a saliency map: saliency is a prior over the cells, counted with a weight.

    .. math:: a(x) = \ln v(x) + w \ln\frac{s(x) + \epsilon}{\sum_y (s(y) + \epsilon)}, \qquad
              \epsilon = 10^{-3} \max_y s(y)

    v is the value that another acquisition function gives, as the target's posterior; a value that is not positive
    counts as next to nothing. With w = 0 it is that function alone. Luzio, Bernardino and Moreno (2024) name the
    integration of semantic information "with traditional bottom-up cues" as what to try next and give no formula; the
    product of prior and likelihood is that of Torralba, Oliva, Castelhano and Henderson (2006).

    Args:
        acquisition: gives v.
        saliency: s, `(..., X·Y)`, not negative (`semfov.saliency.cell_saliency`).
        weight: w, 0 or more.

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
        check(bool((saliency >= 0).all()), "saliency", "no negative numbers", float(saliency.min()))
        self.acquisition = acquisition
        self.weight = weight
        peak = saliency.amax(-1, keepdim=True)
        # A picture without contrast has no saliency anywhere: all of its cells are equal.
        raised = saliency + torch.where(peak > 0, 1e-3 * peak, 1.0)
        self.register_buffer("log_prior", (raised / raised.sum(-1, keepdim=True)).log())

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(B, X·Y)`."""
        value: Tensor = self.acquisition(belief, visited)
        check_shape(self.log_prior, "saliency", value.shape[-1])
        least = torch.finfo(value.dtype).tiny
        return one_by_one(lambda row: row.clamp(min=least).log(), value) + self.weight * self.log_prior.to(value)

    def extra_repr(self) -> str:
        """Settings, for `repr`."""
        return f"weight={self.weight:g}"
