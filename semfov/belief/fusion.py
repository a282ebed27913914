"""Fusion: rules that update a Dirichlet belief with the likelihood of a detection, and a batch of maps with a look."""

from collections.abc import Callable

import torch
from torch import Tensor

from semfov.errors import check, check_shape, lookup, values_known

Rule = Callable[[Tensor, Tensor], Tensor]


def kaplan(beta: Tensor, likelihood: Tensor) -> Tensor:
    r"""Kaplan's rule: match the mean of the exact posterior, keep the least likely class where it is.

    .. math:: \beta'_k = \beta_k \frac{1 + \lambda_k / D}{1 + \min_j \lambda_j / D}, \quad
              D = \sum_j \beta_j \lambda_j

    (Luzio, Bernardino and Moreno, 2024, equation 7, after Kaplan, Chakraborty and Bisdikian, "Fusion of classifiers: A
    subjective logic perspective", IEEE Aerospace Conference 2012.) The whole numerator stands over the whole
    denominator. The exact posterior is a mixture of the Dirichlets Dir(β + e_k) with weights β_k λ_k / D, and its mean
    is that of Dir(β'). It is computed as `β + β (λ − min λ) / (D + min λ)`, which is the same and adds only terms that
    are not negative.

    Args:
        beta: `(..., K+1)`, Dirichlet parameters, positive.
        likelihood: `(..., K+1)`, λ_k = P(S | C = k) of the scores S that were seen, up to a common factor; not
            negative, not all zero; broadcasts with `beta`.

    Returns:
        New parameters, `(..., K+1)`, nowhere smaller than `beta`.

    Raises:
        InputError: a likelihood is zero for every class, negative or not finite, or a parameter is not positive.

    >>> kaplan(torch.ones(3), torch.tensor([1.0, 0.0, 0.0]))
    tensor([2., 1., 1.])
    """
    check_parameters(beta)
    return kaplan_scaled(beta, scale_likelihood(likelihood))


def product(beta: Tensor, likelihood: Tensor) -> Tensor:
    r"""Product rule: Bayes for a class that is fixed, with one unit of evidence more.

    .. math:: \beta'_k = (1 + \sum_j \beta_j) \, \beta_k \lambda_k / \sum_j \beta_j \lambda_j

    The mean is the categorical posterior `p_k λ_k / Σ p λ`. Luzio, Bernardino and Moreno (2024, section III-B) name the
    product and the sum rule, with which Kaplan et al. (2012) compare theirs, and print neither. That a look adds 1 to
    the sum of the parameters is our choice. Arguments and errors as for `kaplan`.

    >>> product(torch.ones(2), torch.tensor([3.0, 1.0]))
    tensor([2.2500, 0.7500])
    """
    check_parameters(beta)
    return product_scaled(beta, scale_likelihood(likelihood))


def sum(beta: Tensor, likelihood: Tensor) -> Tensor:
    r"""Sum rule: count the normalised likelihood as one soft observation.

    .. math:: \beta'_k = \beta_k + \lambda_k / \sum_j \lambda_j

    After n looks the mean is the average of the n normalised likelihoods and of the prior's mean, which counts Σβ
    times. As with `product`, the form for Dirichlet parameters is our choice. Arguments and errors as for `kaplan`.

    >>> sum(torch.ones(2), torch.tensor([3.0, 1.0]))
    tensor([1.7500, 1.2500])
    """
    check_parameters(beta)
    return sum_scaled(beta, scale_likelihood(likelihood))


def kaplan_scaled(beta: Tensor, scaled: Tensor) -> Tensor:
    """`kaplan` for likelihoods that `scale_likelihood` has checked and scaled."""
    least = scaled.amin(-1, keepdim=True)
    expected = (beta * scaled).sum(-1, keepdim=True)
    return torch.addcdiv(beta, beta * (scaled - least), expected + least)


def product_scaled(beta: Tensor, scaled: Tensor) -> Tensor:
    """`product` for likelihoods that `scale_likelihood` has checked and scaled."""
    joint = beta * scaled
    # A floor keeps parameters positive where many likelihoods of 0 in a row would leave none.
    joint = joint.clamp(min=torch.finfo(joint.dtype).tiny)
    return (1 + beta.sum(-1, keepdim=True)) * joint / joint.sum(-1, keepdim=True)


def sum_scaled(beta: Tensor, scaled: Tensor) -> Tensor:
    """`sum` for likelihoods that `scale_likelihood` has checked and scaled."""
    return beta + scaled / scaled.sum(-1, keepdim=True)


RULES: dict[str, Rule] = {"kaplan": kaplan_scaled, "product": product_scaled, "sum": sum_scaled}


def check_parameters(beta: Tensor) -> None:
    """Raise `InputError` unless Dirichlet parameters are positive and finite."""
    if not beta.numel() or not values_known(beta):
        return
    # NaN survives both.
    least, largest = beta.detach().aminmax()
    usable = bool((least > 0) & (largest < torch.inf))
    check(usable, "beta", "positive, finite Dirichlet parameters", f"{float(least):g} to {float(largest):g}")


def scale_likelihood(likelihood: Tensor) -> Tensor:
    """Check likelihoods and scale each row to a largest value of 1 (every rule is blind to a common factor)."""
    largest = likelihood.amax(-1, keepdim=True)
    if values_known(likelihood) and likelihood.numel():
        # NaN and infinity survive the maximum and the minimum, so two reductions answer everything.
        least = likelihood.detach().amin()
        usable = bool((least >= 0) & ((largest > 0) & (largest < torch.inf)).all())
        check(usable, "likelihood", "finite values, none negative, not all zero", _describe(likelihood))
    return likelihood / largest


def _describe(likelihood: Tensor) -> str:
    if not torch.isfinite(likelihood).all():
        return "NaN or infinity"
    return "a negative value" if (likelihood < 0).any() else "a row of zeros"


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
    covered = footprint > 0
    if not values_known(beta, likelihood, footprint):
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
