"""Fusing a batch of detections into a batch of maps."""

import torch
from torch import Tensor

from semfov.belief.fusion import RULES, Rule, check_parameters, scale_likelihood
from semfov.errors import check, check_shape, lookup, values_known


def fuse(beta: Tensor, likelihood: Tensor, footprint: Tensor, rule: str = "kaplan") -> Tensor:
    """Update every cell with the detections that cover it, one after another.

    Kaplan's rule depends on their order. Luzio, Bernardino and Moreno (2024, section IV-A) fuse them "in no particular
    order"; here it is the order of the rows, and our detectors give the most confident first.

    Cells are independent, so the r-th detection of every cell of every map is fused in the same step: there are as
    many steps as detections pile up on one cell, not as there are detections, and only covered cells are touched.
    Where a graph is traced, and inside `torch.func.vmap`, every detection is a step and meets every cell: the shape of
    the graph may not depend on what was seen.

    Args:
        beta: `(B, X·Y, K+1)`, Dirichlet parameters.
        likelihood: `(B, L, K+1)`, likelihoods of the classes given each detection, in order of fusion.
        footprint: `(B, L, X·Y)`, the cells that each detection updates (false or 0 for padding): boolean, or weights
            in [0, 1] that are taken as exponents of the likelihood.
        rule: `kaplan`, `product` or `sum` (`semfov.fusion`).

    Returns:
        New parameters `(B, X·Y, K+1)`.

    >>> fuse(torch.ones(1, 2, 2), torch.tensor([[[0.0, 1.0]]]), torch.tensor([[[True, False]]]))
    tensor([[[1., 2.],
             [1., 1.]]])
    """
    check_shape(beta, "beta", None, None, None)
    batch, cells, components = beta.shape
    check_shape(likelihood, "likelihood", batch, None, components)
    check_shape(footprint, "footprint", batch, likelihood.shape[1], cells)
    update = RULES[lookup(rule, RULES, "fusion rule")]
    check_parameters(beta)
    soft = footprint.is_floating_point()
    check(soft or footprint.dtype == torch.bool, "footprint", "a boolean or floating-point tensor", footprint.dtype)
    covered = footprint > 0 if soft else footprint
    if not values_known():
        return _fuse_one_by_one(beta, _scaled(likelihood, covered), footprint, update)
    image, detection, cell = covered.nonzero(as_tuple=True)
    if len(image) == 0:
        return beta.clone()
    rank = covered.cumsum(1, dtype=torch.int32)[image, detection, cell]
    order = rank.argsort(stable=True)
    rows = (image * cells + cell)[order]
    sources = (image * likelihood.shape[1] + detection)[order]
    steps = torch.bincount(rank)[1:].tolist()
    flat = beta.reshape(-1, components).clone()
    evidence = _scaled(likelihood, covered).reshape(-1, components)
    weights = footprint[image, detection, cell][order, None].to(evidence).split(steps) if soft else None
    for i, (row, source) in enumerate(zip(rows.split(steps), sources.split(steps), strict=True)):
        said = evidence.index_select(0, source)
        said = said if weights is None else said.pow(weights[i])
        flat.index_copy_(0, row, update(flat.index_select(0, row), said))
    return flat.view(batch, cells, components)


def _scaled(likelihood: Tensor, covered: Tensor) -> Tensor:
    """Scaled likelihoods. Padding may hold zeros, which no rule accepts; nothing reads it."""
    return scale_likelihood(torch.where(covered.any(-1, keepdim=True), likelihood, 1.0))


def _fuse_one_by_one(beta: Tensor, evidence: Tensor, footprint: Tensor, update: Rule) -> Tensor:
    """`fuse` as one graph, from scaled likelihoods."""
    for number in range(evidence.shape[1]):
        said, covers = evidence[:, number, None], footprint[:, number, :, None]
        if covers.is_floating_point():
            said = said.pow(covers.to(evidence))
        beta = torch.where(covers > 0, update(beta, said), beta)
    return beta.clone()
