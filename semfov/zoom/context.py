"""Context of windows: other classes in a window tell something about the class that is searched for."""

import torch
from torch import Tensor

from semfov.belief.context import ContextPrior
from semfov.errors import check_number


class WindowContext:
    r"""Log odds that the context of a window w adds to its log odds of showing a class t.

    .. math:: c_t(w) = \lambda \sum_j s_j(w) \, r_{tj0}

    Here s is the strongest hint of each class in the window, and r are the log ratios of `ContextPrior` for objects
    that are next to each other. Tables of `ContextPrior.from_table` help most. Tables that were counted within
    photographs tell where objects are in pictures that hold both classes, but not which pictures hold both.

    Args:
        prior: the context.
        weight: λ.

    Raises:
        InputError: the weight is negative or too large.

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
        """Compute the log odds to add.

        Args:
            scores: `(N, K)`, strongest hint of each class in each window.
            target: class 1..K.

        Returns:
            `(N,)`, one number for each window.
        """
        ratio = self.prior.cooccurrence[target, 1:, 0].to(scores)
        return self.weight * torch.mv(scores, ratio)
