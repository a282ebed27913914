"""An observation model whose graph has no gamma functions, which ONNX lacks."""

import torch
from torch import Tensor

from semfov.observation.foveal import FovealObservationModel
from semfov.observation.linear_map import linear_map


class FoldedObservationModel(FovealObservationModel):
    """An observation model stored as a fixed linear map of log scores.

    Its computation graph has no gamma functions, which ONNX lacks. It gives the same calibrated scores as `model`, to
    the bit. Later training of `model` does not change it.

    Args:
        model: the observation model to copy.

    >>> model = FovealObservationModel.identity(["cup", "cat"], edges=[0.1, 0.2])
    >>> FoldedObservationModel(model).calibrate(torch.tensor([0.2, 0.7, 0.1]), torch.tensor(0.15))
    tensor([0.2000, 0.7000, 0.1000])
    """

    weight: Tensor
    constant: Tensor

    def __init__(self, model: FovealObservationModel) -> None:
        super().__init__(
            model.alpha,
            model.edges,
            model.classes,
            epsilon=model.epsilon,
            log_prior=model.log_prior,
            tempering=float(model.tempering),
            expected=model.expected_scores(),
            miss_rate=model.miss_rate,
            exponents=model.log_exponents.exp(),
            miss_odds=None if model.log_miss is None else model.log_miss.exp(),
            refutation=model.refutation,
            cell=model.log_cell.exp(),
            presence=model.presence,
            metadata=model.metadata,
        )
        with torch.no_grad():
            weight, constant = linear_map(model.alpha)
        self.register_buffer("weight", weight)
        self.register_buffer("constant", constant)
        self.requires_grad_(False).eval()

    def _linear(self) -> tuple[Tensor, Tensor]:
        return self.weight, self.constant
