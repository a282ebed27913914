"""An observation model whose constants are computed once and for all, to be exported."""

import torch
from torch import Tensor

from semfov.observation.foveal import FovealObservationModel


class FoldedObservationModel(FovealObservationModel):
    """The same model as a fixed linear map of log scores.

    Gamma functions then stay out of the graph: ONNX has none. It calibrates to the same bits as `model`, and does not
    follow it when that is trained on.

    Args:
        model: the observation model.

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
            metadata=model.metadata,
        )
        with torch.no_grad():
            weight, constant = model._make_linear()
        self.register_buffer("weight", weight)
        self.register_buffer("constant", constant)
        self.requires_grad_(False).eval()

    def _linear(self) -> tuple[Tensor, Tensor]:
        return self.weight, self.constant
