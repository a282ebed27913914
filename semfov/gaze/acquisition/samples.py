"""Looks drawn from the observation model, over which a lookahead can take the expectation."""

from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from semfov.errors import InputError, check


class DrawnModel(Protocol):
    """The part of an observation model that `sampled_likelihoods` needs (`semfov.FovealObservationModel`)."""

    edges: Tensor
    expected: Tensor | None

    @property
    def alpha(self) -> Tensor:
        """Dirichlet parameters, `(K+1, N, K+1)`, of the scores of each class at each level, background first."""
        ...

    def calibrate(self, scores: Tensor, distance: Tensor) -> Tensor:
        """Calibrated scores `(..., K+1)` for scores `(..., K+1)` at distances `(...)`."""
        ...


def sampled_likelihoods(model: DrawnModel, samples: int, *, calibrated: bool = True, seed: int = 0) -> Tensor:
    r"""Likelihoods of looks at an object of each class from each level of distance.

    .. math:: S_{knm} \sim \mathrm{Dir}(\alpha_{kn}), \qquad \lambda_{knm} = P(C = \cdot \mid S_{knm}, n)

    Args:
        model: an observation model whose Dirichlets are densities of the scores, as after a fit by maximum likelihood.
        samples: number M of looks for each class and level.
        calibrated: whether the likelihoods are the calibrated scores; otherwise they are the scores S themselves.
        seed: random seed of the scores.

    Returns:
        `(K+1, N, M, K+1)`: class, level, look, and the likelihood of each class.

    Raises:
        InputError: `samples` is less than 1, or the model's Dirichlets are not densities of the scores.

    >>> from semfov import FovealObservationModel
    >>> model = FovealObservationModel(torch.tensor([[[9.0, 1.0]], [[1.0, 9.0]]]), [], ["cup"])
    >>> sampled_likelihoods(model, 16).mean(2).argmax(-1)
    tensor([[0],
            [1]])
    """
    check(samples >= 1, "samples", "1 or more", samples)
    if model.expected is not None:
        raise InputError(
            "model: expected an observation model whose Dirichlets are densities of the scores, such as "
            "'yolox-nano-published', to draw looks from; got one that has expected scores of its own"
        )
    alpha = model.alpha.detach()
    generator = np.random.default_rng(seed)
    drawn = generator.standard_gamma(alpha.double().cpu().numpy()[:, :, None].repeat(samples, 2))
    scores = torch.from_numpy(drawn / drawn.sum(-1, keepdims=True)).to(alpha)
    if not calibrated:
        return scores
    # A border belongs to the level inside it; the last level has none, and is everything beyond.
    outer = torch.cat([model.edges, model.edges.new_full((1,), torch.inf)])
    return model.calibrate(scores, outer[None, :, None].expand(scores.shape[:-1])).detach()
