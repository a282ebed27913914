"""A soft choice of the next fixation, through which gradients reach the values of the cells."""

import torch
from torch import Tensor

from semfov.errors import check, check_shape


def soft_fixation(
    logits: Tensor, visited: Tensor, centres: Tensor, noise: Tensor, *, temperature: float = 1.0, hard: bool = True
) -> tuple[Tensor, Tensor]:
    r"""Draw a fixation by Gumbel-softmax over the cells not visited (Jang, Gu and Poole, 2017).

    .. math:: y = \mathrm{softmax}\left(\frac{\ell - \ln(-\ln u)}{\tau}\right), \quad
              x^* = \arg\max_x y(x), \quad \tilde f = \sum_x y(x) \, c(x)

    With `hard` the fixation is the centre of x*, a draw from `softmax(ℓ)`, and has the gradient of the soft point f̃
    (straight-through; Bengio, Léonard and Courville, 2013); otherwise it is f̃ itself.

    Args:
        logits: `(B, X·Y)`, ℓ.
        visited: `(B, X·Y)` boolean, cells that may not be drawn; each row must leave at least one.
        centres: `(X·Y, 2)`, c, centres of the cells in pixels.
        noise: `(B, X·Y)`, u, uniform in [0, 1).
        temperature: τ, positive.
        hard: fixate the centre of x* with a straight-through gradient; otherwise the soft point f̃.

    Returns:
        The fixations `(B, 2)` in pixels, and the drawn cells `(B,)`.

    Raises:
        InputError: the temperature is not positive, or the shapes do not fit together.

    >>> logits = torch.tensor([[0.0, 9.0, 0.0]], requires_grad=True)
    >>> centres = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    >>> point, cell = soft_fixation(logits, torch.tensor([[True, False, False]]), centres, torch.full((1, 3), 0.5))
    >>> point.tolist(), cell.tolist()
    ([[1.0, 0.0]], [1])
    """
    check(temperature > 0, "temperature", "a positive number", temperature)
    check_shape(logits, "logits", None, None)
    check_shape(visited, "visited", *logits.shape)
    check_shape(noise, "noise", *logits.shape)
    check_shape(centres, "centres", logits.shape[-1], 2)
    limits = torch.finfo(noise.dtype)
    gumbel = -(-noise.clamp(min=limits.tiny, max=1 - limits.eps).log()).log()
    weights = ((logits + gumbel.to(logits)).masked_fill(visited, -torch.inf) / temperature).softmax(-1)
    cell = weights.argmax(-1)
    soft = weights @ centres.to(weights)
    return (centres.to(weights)[cell] + (soft - soft.detach()) if hard else soft), cell
