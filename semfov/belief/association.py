"""Association of detections with cells: at most one of the detections of a look shows the object of a cell."""

import torch
from torch import Tensor

from semfov.errors import check_shape
from semfov.precision import exact_product


def one_of(ratio: Tensor, weight: Tensor, miss: Tensor) -> Tensor:
    r"""Compute the likelihood of every class in every cell, given all detections of a look.

    .. math:: \lambda_k(x) = m_k(x) + \sum_l w_l(x) \, \frac{p(S_l \mid k, d_l)}{p(S_l \mid 0, d_l)},
              \qquad \lambda_0(x) = 1

    Either the detector missed the object of the cell, or one of the detections shows it and the others show something
    else. This is the likelihood of probabilistic data association (Bar-Shalom and Tse, 1975) for a single object, with
    the constant factors of its two terms in m and in the calibration. Detections are alternatives and add up. The
    paper's fusion multiplies them as if each were a measurement of the cell.

    Args:
        ratio: `(B, L, K+1)`, likelihoods of the classes given each detection, relative to background.
        weight: `(B, L, X·Y)`, w, how well each detection fits each cell, in [0, 1]; 0 for padding.
        miss: `(B, X·Y, K+1)`, m, odds of a miss.

    Returns:
        `(B, X·Y, K+1)`, λ, 1 for background.

    Raises:
        InputError: shapes do not fit.

    >>> ratio = torch.tensor([[[1.0, 6.0], [1.0, 2.0]]])  # two detections; class 1 against background
    >>> weight, miss = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]]), torch.tensor([[[1.0, 0.5], [1.0, 0.5]]])
    >>> one_of(ratio, weight, miss)  # both are in the first cell
    tensor([[[1.0000, 8.5000],
             [1.0000, 0.5000]]])
    """
    check_shape(ratio, "ratio", None, None, miss.shape[-1])
    check_shape(weight, "weight", *ratio.shape[:2], miss.shape[-2])
    detected = exact_product(weight.mT, ratio[..., 1:])
    background = torch.ones_like(miss[..., :1])
    return torch.cat([background, miss[..., 1:] + detected], -1)


def refuted(weight: Tensor, covered: Tensor, visited: Tensor, share: Tensor) -> Tensor:
    r"""Lower the weights of detections that cover fixated cells, which do not hold the target.

    .. math:: w_l(x) \leftarrow w_l(x) \, (1 - \rho \max_{f} c_l(f))

    A search continues only if no fixated cell f holds the target. A detection that covers one of them then shows
    something else, wherever its centre is.

    Args:
        weight: `(B, L, X·Y)`, w.
        covered: `(B, L, X·Y)`, c, cells that each detection covers, from 0 to 1.
        visited: `(B, X·Y)` boolean, the fixated cells.
        share: `()`, ρ, from 0 to 1.

    Returns:
        `(B, L, X·Y)`, the new weights.

    >>> weight, covered = torch.tensor([[[0.0, 1.0, 0.0]]]), torch.tensor([[[1.0, 1.0, 0.0]]])
    >>> refuted(weight, covered, torch.tensor([[True, False, False]]), torch.tensor(0.9))
    tensor([[[0.0000, 0.1000, 0.0000]]])
    """
    check_shape(covered, "covered", *weight.shape)
    check_shape(visited, "visited", weight.shape[0], weight.shape[-1])
    fixated = (covered * visited[:, None]).amax(-1, keepdim=True)
    return weight * (1 - share * fixated)
