"""Quasi-Newton descent for the fits of a few hundred parameters."""

from typing import Any

import torch


class Lbfgs(torch.optim.LBFGS):
    """PyTorch's L-BFGS, without its compiler.

    The first call of two methods of an optimiser imports the compiler, so that graphs leave them out. That takes longer
    than most fits do, and the fits are in no graph. So these methods are called as they were defined.
    """

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        _plain(torch.optim.Optimizer.add_param_group)(self, param_group)

    def zero_grad(self, set_to_none: bool = True) -> None:
        _plain(torch.optim.Optimizer.zero_grad)(self, set_to_none)


def _plain(method: Any) -> Any:
    """Take a method without what wraps it; other versions of PyTorch may not wrap it."""
    return getattr(method, "__wrapped__", method)
