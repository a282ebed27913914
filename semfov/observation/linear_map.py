"""The log likelihoods of an observation model as a linear map of log scores, computed once for each of its states."""

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from semfov.observation.dirichlet import log_normaliser
from semfov.threads import one_thread_if_small


def linear_map(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Write the log likelihoods as a linear map of log scores, level by level.

    Args:
        alpha: `(K+1, N, K+1)`.

    Returns:
        Weights `(N (K+1), K+1)` and constants `(N (K+1),)`.
    """
    by_level = alpha.transpose(0, 1)
    # ln Γ of large parameters is much larger than the differences between likelihoods: compute it in float64.
    constant = -log_normaliser(by_level.to(torch.float64)).to(alpha.dtype)
    return (by_level - 1).flatten(0, 1), constant.flatten()


# Copies of parameters ln α with the linear maps that were made of them, by the parameters.
_KEPT = WeakIdKeyDictionary()


def kept_map(log_alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Compute `linear_map` of parameters `ln α` once for each of their values, without gradients.

    The values are compared with those of the last call. The version of a tensor would not do: fused optimisers, and
    changes of its `data`, as averages of models make them, do not count in it.
    """
    entry: tuple[Tensor, tuple[Tensor, Tensor]] | None = _KEPT.get(log_alpha)
    if entry is None or not _are_equal(log_alpha, entry[0]):
        with torch.inference_mode(False), torch.no_grad():
            values = log_alpha.detach().clone()
            entry = (values, linear_map(values.exp()))
        _KEPT[log_alpha] = entry
    return entry[1]


@one_thread_if_small
def _are_equal(parameters: Tensor, before: Tensor) -> bool:
    """Tell whether parameters have the device, the type and the values of a copy that was made before."""
    is_alike = parameters.device == before.device and parameters.dtype == before.dtype
    return is_alike and torch.equal(parameters, before)


# An operation into which compilation does not look, and whose results a compiled graph may write over.
_OPERATIONS = torch.library.Library("semfov", "FRAGMENT")
_OPERATIONS.define("linear_map(Tensor log_alpha) -> (Tensor, Tensor)")
_OPERATIONS.impl(
    "linear_map", lambda log_alpha: tuple(map(torch.clone, kept_map(log_alpha))), "CompositeExplicitAutograd"
)
_OPERATIONS.impl("linear_map", lambda log_alpha: linear_map(log_alpha.exp()), "Meta")
