"""Acquisition functions that do not look at the belief."""

from torch import Tensor, nn

from semfov.errors import check_shape


class Uniform(nn.Module):
    """Every cell is worth the same: with ties broken at random this is uniform random gaze.

    >>> import torch
    >>> Uniform()(torch.ones(1, 3, 2))
    tensor([[0., 0., 0.]])
    """

    def forward(self, beta: Tensor) -> Tensor:
        """Zeros `(..., X·Y)` for a belief `(..., X·Y, K+1)`."""
        return beta.new_zeros(beta.shape[:-1])


class Static(nn.Module):
    """Given values, such as a saliency map's, whatever the belief.

    Args:
        values: `(..., X·Y)`.
    """

    values: Tensor

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.register_buffer("values", values)

    def forward(self, beta: Tensor) -> Tensor:
        """The values `(..., X·Y)`, for a belief `(..., X·Y, K+1)` of as many cells."""
        check_shape(self.values, "values", beta.shape[-2])
        return self.values.expand(beta.shape[:-1])
