"""Looks drawn from the observation model, over which a lookahead can take the expectation."""

import numpy as np
import torch
from torch import Tensor

from semfov.errors import InputError, check
from semfov.observation.foveal import FovealObservationModel


def sampled_likelihoods(
    model: FovealObservationModel, samples: int, *, calibrated: bool = True, seed: int = 0
) -> Tensor:
    r"""Likelihoods `(K+1, N, M, K+1)` of M looks at an object of each class from each level of distance.

    .. math:: S_{knm} \sim \mathrm{Dir}(\alpha_{kn}), \qquad \lambda_{knm} = P(C = \cdot \mid S_{knm}, n)

    The model's Dirichlets must be densities of the scores, as after a fit by maximum likelihood. Likelihoods that are
    not calibrated are the scores S themselves.
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
