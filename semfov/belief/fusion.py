"""Fusion rules: update a Dirichlet belief with the likelihoods of detections.

A rule is a function here, which `_rule` registers under its name. `semfov.belief.observers.Semantic` takes it by that
name, and studies by `BeliefConfig.fusion` (`semfov.runs.config`), whose type lists the names. `SemanticSearch` and
`SemanticMap` always fuse by Kaplan's rule. Policies that simulate looks (`semfov.gaze.acquisition.lookahead`, and
`PredictedTargetPosterior`) do so by Kaplan's rule, too, whatever rule fuses the looks that are made.

A rule takes no settings. One with a number needs a field of `BeliefConfig`, which `_make_semantic` of
`semfov.runs.policy_looking` gives to `Semantic`.
"""

import math
from collections.abc import Callable
from functools import wraps

import torch
from torch import Tensor

from semfov.errors import check, check_shape, check_tensor, lookup, values_known
from semfov.threads import one_thread_if_small

__all__ = ["fuse", "kaplan", "product", "semba", "sum"]

_Rule = Callable[[Tensor, Tensor], Tensor]
# Elements of the maps that are fused together on a CPU: those of many episodes leave the processor's cache, and with
# half as many the calls take a tenth more time.
_BLOCK = 1 << 18
_LARGEST_SHORT = torch.iinfo(torch.int16).max
RULES: dict[str, _Rule] = {}  # the rules by name, without checks, for likelihoods from `_scale_likelihood`


def _rule(rule: _Rule) -> _Rule:
    """Register a rule, and check and scale what is given to it."""
    RULES[rule.__name__] = rule

    @wraps(rule)
    def checked(beta: Tensor, likelihood: Tensor) -> Tensor:
        check_parameters(beta)
        scaled = _scale_likelihood(likelihood)
        check_shape(likelihood, "likelihood", *beta.shape[-1:])
        return rule(beta, scaled)

    rule.__qualname__ = f"{rule.__name__}.__wrapped__"  # where pickle finds the rule without checks
    return checked


@_rule
def kaplan(beta: Tensor, likelihood: Tensor) -> Tensor:
    r"""Fuse by Kaplan's rule: match the mean of the exact posterior, and keep the least likely class's parameter.

    .. math:: \beta'_k = \beta_k \frac{1 + \lambda_k / D}{1 + \min_j \lambda_j / D}, \quad
              D = \sum_j \beta_j \lambda_j

    This is equation 7 of Luzio, Bernardino and Moreno (2024), after Kaplan, Chakraborty and Bisdikian, "Fusion of
    classifiers: A subjective logic perspective", IEEE Aerospace Conference 2012. The whole numerator is divided by the
    whole denominator. The exact posterior is a mixture of the Dirichlets Dir(β + e_k) with weights β_k λ_k / D; it has
    the same mean as Dir(β'). On average over scores that arise by the true likelihoods, the mean does not change
    (`semfov.acquisition.PredictedTargetPosterior`). The rule is computed in the equal form
    `β + β (λ − min λ) / (D + min λ)`, which adds no negative terms.

    Args:
        beta: `(..., K+1)`, Dirichlet parameters, positive.
        likelihood: `(..., K+1)`, λ_k = P(S | C = k) of the observed scores S, up to a common factor; not negative,
            not all zero; broadcasts with `beta`.

    Returns:
        `(..., K+1)`, new parameters, none smaller than before.

    Raises:
        InputError: a likelihood is zero for every class, negative or not finite, or a parameter is not positive.

    >>> kaplan(torch.ones(3), torch.tensor([1.0, 0.0, 0.0]))
    tensor([2., 1., 1.])
    """
    least = likelihood.amin(-1, keepdim=True)
    expected = (beta * likelihood).sum(-1, keepdim=True)
    return torch.addcdiv(beta, beta * (likelihood - least), expected + least)


@_rule
def product(beta: Tensor, likelihood: Tensor) -> Tensor:
    r"""Fuse by the product rule: Bayes' rule for the mean, with one more unit of evidence.

    .. math:: \beta'_k = (1 + \sum_j \beta_j) \, \beta_k \lambda_k / \sum_j \beta_j \lambda_j

    The mean is the categorical posterior `p_k λ_k / Σ p λ`. Luzio, Bernardino and Moreno (2024, section III-B) name
    the product rule and the sum rule, with which Kaplan et al. (2012) compare theirs, but give no formulas. It is our
    choice that a detection adds 1 to the sum of the parameters.

    Args:
        beta: `(..., K+1)`, Dirichlet parameters, positive.
        likelihood: `(..., K+1)`, λ, up to a common factor; not negative, not all zero; broadcasts with `beta`.

    Returns:
        `(..., K+1)`, new parameters.

    Raises:
        InputError: a likelihood is zero for every class, negative or not finite, or a parameter is not positive.

    >>> product(torch.ones(2), torch.tensor([3.0, 1.0]))
    tensor([2.2500, 0.7500])
    """
    joint = beta * likelihood
    # The floor keeps parameters positive after any number of likelihoods of 0.
    joint = joint.clamp(min=torch.finfo(joint.dtype).tiny)
    total = 1 + beta.sum(-1, keepdim=True)
    return total * joint / joint.sum(-1, keepdim=True)


@_rule
def sum(beta: Tensor, likelihood: Tensor) -> Tensor:
    r"""Fuse by the sum rule: count the normalised likelihood as one soft observation.

    .. math:: \beta'_k = \beta_k + \lambda_k / \sum_j \lambda_j

    After n detections the mean is the average of the n normalised likelihoods and the prior's mean, which has the
    weight Σβ. As for `product`, the form for Dirichlet parameters is our choice.

    Args:
        beta: `(..., K+1)`, Dirichlet parameters, positive.
        likelihood: `(..., K+1)`, λ, up to a common factor; not negative, not all zero; broadcasts with `beta`.

    Returns:
        `(..., K+1)`, new parameters.

    Raises:
        InputError: a likelihood is zero for every class, negative or not finite, or a parameter is not positive.

    >>> sum(torch.ones(2), torch.tensor([3.0, 1.0]))
    tensor([1.7500, 1.2500])
    """
    return beta + likelihood / likelihood.sum(-1, keepdim=True)


@_rule
def semba(beta: Tensor, likelihood: Tensor) -> Tensor:
    r"""Fuse by the rule in the code of SemBA.

    .. math:: \beta'_k = \beta_k \left(1 + \frac{\lambda_k / D}{1 + \min_j \lambda_j / D}\right), \quad
              D = \sum_j \beta_j \lambda_j

    Only the second term of Kaplan's numerator is divided (`utils/semba.py` of vislab-tecnico-lisboa/SemBA). So a
    likelihood that is the same for all classes makes the belief surer, and the mean is not that of the posterior. It
    is here to compare with; the rule that is called Kaplan's is `kaplan`.

    Args:
        beta: `(..., K+1)`, Dirichlet parameters, positive.
        likelihood: `(..., K+1)`, λ, as for `product`.

    Returns:
        `(..., K+1)`, new parameters.

    >>> semba(torch.ones(2), torch.tensor([1.0, 0.5]))
    tensor([1.5000, 1.2500])
    """
    joint = beta * likelihood
    expected = joint.sum(-1, keepdim=True)  # D
    least = likelihood.amin(-1, keepdim=True)
    return torch.addcdiv(beta, joint, expected + least)


def check_parameters(beta: Tensor) -> None:
    """Raise `InputError` unless Dirichlet parameters are positive and finite."""
    check_tensor(beta, "beta")
    if not beta.numel() or not values_known(beta):
        return
    # The minimum and the maximum of a tensor with a NaN are NaN.
    least, largest = torch.stack(beta.detach().aminmax()).tolist()
    got = f"{least:g} to {largest:g}"
    check(least > 0 and largest < math.inf, "beta", "positive, finite Dirichlet parameters", got)


def _scale_likelihood(likelihood: Tensor) -> Tensor:
    """Check likelihoods `(..., K+1)`, and scale each row to a maximum of 1: no rule depends on a common factor."""
    check_tensor(likelihood, "likelihood")
    largest = likelihood.amax(-1, keepdim=True)
    if values_known(likelihood) and likelihood.numel():
        # NaN and infinity pass through the maximum and the minimum, so two reductions check every condition.
        least = likelihood.detach().amin()
        if not bool((least >= 0) & ((largest > 0) & (largest < torch.inf)).all()):
            negative = "a negative value" if (likelihood < 0).any() else "a row of zeros"
            got = negative if torch.isfinite(likelihood).all() else "NaN or infinity"
            check(False, "likelihood", "finite values, none negative, not all zero", got)
    return likelihood / largest


def fuse(beta: Tensor, likelihood: Tensor, footprint: Tensor, rule: str = "kaplan") -> Tensor:
    """Update every cell with the detections that cover it, one after another.

    The result of Kaplan's rule depends on the order of the detections. Luzio, Bernardino and Moreno (2024, section
    IV-A) fuse them "in no particular order". Here it is the order of the rows; our detectors put the most confident
    detection first.

    Cells are independent of each other, so one step fuses the r-th detection of every cell of every map. The number of
    steps is therefore the largest number of detections on one cell, not the number of detections, and only covered
    cells are computed. While a graph is traced, and inside `torch.func.vmap`, the shape of the graph must not depend
    on the detections: each detection is then a step of its own, over all cells.

    Args:
        beta: `(B, X·Y, K+1)`, Dirichlet parameters, positive.
        likelihood: `(B, L, K+1)`, likelihoods of the classes given each detection, in order of fusion.
        footprint: `(B, L, X·Y)`, the cells that each detection updates, false or 0 for padding: boolean, or weights
            in [0, 1] that are used as exponents of the likelihood.
        rule: `kaplan`, `semba`, `product` or `sum` (`semfov.fusion`).

    Returns:
        `(B, X·Y, K+1)`, new parameters.

    Raises:
        InputError: shapes do not fit, the rule is unknown, or a value is out of range.

    >>> fuse(torch.ones(1, 2, 2), torch.tensor([[[0.0, 1.0]]]), torch.tensor([[[True, False]]]))
    tensor([[[1., 2.],
             [1., 1.]]])
    """
    check_shape(beta, "beta", None, None, None)
    batch, cells, components = beta.shape
    check_shape(likelihood, "likelihood", batch, None, components)
    check_shape(footprint, "footprint", batch, likelihood.shape[1], cells)
    lookup(rule, RULES, "fusion rule")
    check_parameters(beta)
    _check_footprint(footprint)
    # Kinds of numbers may differ; the result has that of the belief.
    scaled = scale_covering(likelihood.to(beta.dtype), footprint)
    return fuse_scaled(beta, scaled, footprint, rule)


def _check_footprint(footprint: Tensor) -> None:
    """Raise `InputError` unless a footprint is boolean, or weights from 0 to 1."""
    if footprint.dtype == torch.bool:
        return
    check(footprint.is_floating_point(), "footprint", "a boolean or floating-point tensor", footprint.dtype)
    if footprint.numel() and values_known(footprint):
        # The minimum and the maximum of a tensor with a NaN are NaN.
        least, largest = torch.stack(footprint.detach().aminmax()).tolist()
        check(least >= 0 and largest <= 1, "footprint", "weights from 0 to 1", f"{least:g} to {largest:g}")


@one_thread_if_small
def fuse_scaled(beta: Tensor, scaled: Tensor, footprint: Tensor, rule: str) -> Tensor:
    """Fuse as `fuse` does, without checks: in a graph detection by detection, else in blocks of episodes.

    Args:
        beta: `(B, X·Y, K+1)`, Dirichlet parameters.
        scaled: likelihoods `(B, L, K+1)` from `scale_covering`.
        footprint: `(B, L, X·Y)`, boolean, or exponents of the likelihood in [0, 1].
        rule: name of the fusion rule.

    Returns:
        `(B, X·Y, K+1)`, new parameters.
    """
    update = RULES[rule]
    if not values_known(beta, scaled, footprint):
        return _fuse_everywhere(beta, scaled, footprint, update)
    # The gradient of a block that is written into a larger tensor would pass through all of that tensor.
    recorded = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (beta, scaled, footprint))
    elements = max(1, beta[:1].numel())
    episodes = max(1, _BLOCK // elements)  # of a block, which stays in the cache of the processor
    if recorded or beta.device.type != "cpu" or len(beta) <= episodes:
        return _fuse_covered(beta.clone(memory_format=torch.contiguous_format), scaled, footprint, update)
    fused = torch.empty_like(beta, memory_format=torch.contiguous_format)
    for first in range(0, len(beta), episodes):
        block = slice(first, first + episodes)
        _fuse_covered(fused[block].copy_(beta[block]), scaled[block], footprint[block], update)
    return fused


def _fuse_everywhere(beta: Tensor, scaled: Tensor, footprint: Tensor, update: _Rule) -> Tensor:
    """Fuse each detection in a step of its own over all cells, so that the steps do not depend on values."""
    for number in range(scaled.shape[1]):
        likelihood = scaled[:, number, None]
        weight = footprint[:, number, :, None]
        if weight.is_floating_point():
            likelihood = likelihood.pow(weight.to(scaled))
        beta = torch.where(weight > 0, update(beta, likelihood), beta)
    # Without detections it is the tensor that was given, which the caller may change.
    return beta.clone()


def _fuse_covered(beta: Tensor, scaled: Tensor, footprint: Tensor, update: _Rule) -> Tensor:
    """Fuse the r-th detection of every covered cell of every map in step r; `beta` is written over.

    Args:
        beta: `(B, X·Y, K+1)`, contiguous.
        scaled: likelihoods `(B, L, K+1)`.
        footprint: `(B, L, X·Y)`, boolean, or exponents of the likelihood.
        update: the rule of fusion.

    Returns:
        `beta`.
    """
    covered = _covers(footprint)
    image, detection, cell = covered.nonzero(as_tuple=True)
    if len(image) == 0:
        return beta
    # The pairs of a cell and a detection that covers it, by the rank of the detection among those of its cell.
    rank = covered.cumsum(1, dtype=torch.int32)[image, detection, cell]
    order = _order_of(rank, footprint.shape[1])
    steps = torch.bincount(rank)[1:].tolist()  # pairs of each rank; ranks begin at 1
    cells = (image * beta.shape[1] + cell)[order].split(steps)
    detections = (image * scaled.shape[1] + detection)[order].split(steps)
    parameters = beta.view(-1, beta.shape[-1])  # (B · X·Y, K+1), the memory of `beta`
    evidence = scaled.reshape(-1, beta.shape[-1])  # (B · L, K+1)
    exponents = None
    if footprint.is_floating_point():
        exponents = footprint[image, detection, cell][order, None].to(evidence).split(steps)
    for step in range(len(steps)):
        likelihood = evidence.index_select(0, detections[step])
        if exponents is not None:
            likelihood = likelihood.pow(exponents[step])
        fused = update(parameters.index_select(0, cells[step]), likelihood)
        parameters.index_copy_(0, cells[step], fused)
    return beta


def _covers(footprint: Tensor) -> Tensor:
    """Tell which cells a footprint `(B, L, X·Y)` covers, boolean."""
    return footprint if footprint.dtype == torch.bool else footprint > 0


def _order_of(rank: Tensor, largest: int) -> Tensor:
    """Sort ranks `(N,)`, none of which is above the largest, and keep the order of equal ones; `(N,)` indices."""
    if rank.device.type != "cpu" or largest > _LARGEST_SHORT:
        return rank.argsort(stable=True)
    # NumPy sorts numbers of 16 bits by their digits, in a third of the time.
    return torch.from_numpy(rank.short().numpy().argsort(kind="stable"))


def scale_covering(likelihood: Tensor, footprint: Tensor) -> Tensor:
    """Scale the likelihoods of the detections that cover a cell; those of the others, such as padding, become 1.

    Args:
        likelihood: `(B, L, K+1)`.
        footprint: `(B, L, X·Y)`, boolean or weights.

    Returns:
        `(B, L, K+1)`, with a maximum of 1 in each row.
    """
    covers_cell = _covers(footprint).any(-1, keepdim=True)  # (B, L, 1)
    return _scale_likelihood(torch.where(covers_cell, likelihood, 1.0))
