"""The log likelihoods of an observation model as a linear map of log scores, computed once for each of its states."""

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from semfov.observation.dirichlet import log_normaliser


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


_KEPT = WeakIdKeyDictionary()  # linear maps by the parameters they are made of, with the state of these then


def kept_map(log_alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Compute `linear_map` of parameters `ln α` once for each of their states, without gradients."""
    if log_alpha.is_inference():
        # Such tensors do not count their changes.
        return linear_map(log_alpha.exp())
    state = log_alpha._version, log_alpha.data_ptr()
    entry: tuple[tuple[int, int], tuple[Tensor, Tensor]] | None = _KEPT.get(log_alpha)
    if entry is None or entry[0] != state:
        with torch.inference_mode(False), torch.no_grad():
            entry = (state, linear_map(log_alpha.exp()))
        _KEPT[log_alpha] = entry
    return entry[1]


def forget(log_alpha: Tensor) -> None:
    """Drop what `kept_map` keeps for parameters `ln α`."""
    _KEPT.pop(log_alpha, None)


# An operation into which compilation does not look, and whose results a compiled graph may write over.
_OPERATIONS = torch.library.Library("semfov", "FRAGMENT")
_OPERATIONS.define("linear_map(Tensor log_alpha) -> (Tensor, Tensor)")
_OPERATIONS.impl(
    "linear_map", lambda log_alpha: tuple(map(torch.clone, kept_map(log_alpha))), "CompositeExplicitAutograd"
)
_OPERATIONS.impl("linear_map", lambda log_alpha: linear_map(log_alpha.exp()), "Meta")
