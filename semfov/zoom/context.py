"""Context of windows: what one shows of other classes says something of the class that is searched for."""

import torch
from torch import Tensor

from semfov.belief.context import ContextPrior
from semfov.errors import check_number


class WindowContext:
    r"""Log odds that context adds to those of a window w.

    .. math:: c_t(w) = \lambda \sum_j s_j(w) \, r_{tj0}

    with s the strongest hint of each class in the window, and r of `ContextPrior` for things that are next to each
    other. Tables of `ContextPrior.from_table` tell most here: those that were counted within photographs say where
    things are in pictures that hold both, and not which pictures hold both.

    Args:
        prior: the context.
        weight: λ.

    >>> pairs = torch.zeros(3, 3, 1)
    >>> pairs[1, 2] = 2.0  # cups are beside tables
    >>> context = WindowContext(ContextPrior(["cup", "table"], torch.zeros(3, 1, 1), pairs, []), 0.5)
    >>> context(torch.tensor([[0.0, 0.8], [0.0, 0.0]]), 1)
    tensor([0.8000, 0.0000])
    """

    def __init__(self, prior: ContextPrior, weight: float = 1.0) -> None:
        check_number(weight, "weight", 0, 1e6)
        self.prior, self.weight = prior, weight

    def __call__(self, scores: Tensor, target: int) -> Tensor:
        """Log odds to add, `(N,)`.

        Args:
            scores: `(N, K)`, strongest hint of each class in each window.
            target: class 1..K.
        """
        ratio = self.prior.cooccurrence[target, 1:, 0].to(scores)
        return self.weight * torch.mv(scores, ratio)
