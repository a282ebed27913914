"""Products that automatic mixed precision may not round."""

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor


def without_autocast(like: Tensor) -> AbstractContextManager[object]:
    """Make a context in which products keep the precision of their factors.

    Automatic mixed precision computes them with 8 significant bits. A log likelihood is a sum of terms of hundreds of
    nats, in which that is an error of a nat or two: enough for another class to be the most probable one.
    A picture would keep two digits.

    Args:
        like: a tensor on the device of the products.

    Returns:
        The context, which does nothing where autocast is off.
    """
    kind = like.device.type
    is_on = torch.amp.is_autocast_available(kind) and torch.is_autocast_enabled(kind)
    return torch.autocast(kind, enabled=False) if is_on else nullcontext()


def exact_product(left: Tensor, right: Tensor) -> Tensor:
    """Multiply matrices, or a matrix and a vector, in the wider type of the factors (`without_autocast`).

    Args:
        left: the first factor.
        right: the second factor.

    Returns:
        `left @ right`.
    """
    wider = torch.promote_types(left.dtype, right.dtype)
    with without_autocast(left):
        return left.to(wider) @ right.to(wider)
