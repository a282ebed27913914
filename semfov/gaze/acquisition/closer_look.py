"""Exploration by nearer fixations: it moves the fovea towards cells whose class is uncertain."""

from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.grid import Grid
from semfov.errors import check
from semfov.gaze.acquisition.base import AcquisitionFunction


class CloserLook(AcquisitionFunction):
    r"""Gain in acuity of a fixation, over the nearest fixation so far, at cells whose class is uncertain.

    Successive looks from one distance detect, and miss, the same objects; only a nearer fixation shows more. So a cell
    counts by the acuity v that the fixation adds to that of the nearest fixation so far, at distance :math:`d^*`:

    .. math:: a(f) = \sum_x \bigl(1 - \max_k q_k(x)\bigr) \bigl[v(d(x, f)) - v(d^*(x))\bigr]_+, \qquad
              v(d) = e^{-\max(d / r - 1,\, 0)}

    q are the probabilities of the classes other than background, scaled to sum to 1. r is the width of the fovea,
    within which acuity is constant. Once the fovea has been near every cell, all gains are 0, and ties are broken at
    random.

    Args:
        grid: the cells of one image.
        fovea: r in units of the image's longer side (100 px of 640 by default).

    Raises:
        InputError: `fovea` is not positive.

    >>> import torch
    >>> grid = Grid(3, 1, (90, 30))
    >>> from semfov import DirichletBelief
    >>> belief = DirichletBelief(torch.ones(1, 3, 4), torch.tensor([[0.0, 1 / 3, 2 / 3]]))
    >>> CloserLook(grid, 0.2)(belief, torch.tensor([[True, False, False]])).argmax().item()
    1
    """

    name = "closer-look"
    tasks = ("exploration",)
    seen: Tensor

    def __init__(self, grid: Grid, fovea: float = 100 / 640) -> None:
        super().__init__()
        check(fovea > 0, "fovea", "a positive number", fovea)
        self.fovea = fovea
        self.register_buffer("seen", acuity(grid.cell_distance, fovea))

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Compute values `(B, X·Y)` for a belief about all classes that has `closest` distances."""
        return one_by_one(self._values, belief.class_probabilities(), belief.closest)

    def _values(self, probabilities: Tensor, closest: Tensor) -> Tensor:
        """Compute the values from class probabilities `(B, X·Y, K+1)` and distances of the closest looks `(B, X·Y)`."""
        objects = probabilities[..., 1:]
        unknown = 1 - objects.amax(-1) / objects.sum(-1)
        gain = (self.seen.to(objects) - acuity(closest, self.fovea)[..., None]).clamp(min=0)
        return (gain * unknown[..., None]).sum(-2)


def acuity(distance: Tensor, fovea: float) -> Tensor:
    """Compute the relative acuity `exp(-max(d / r - 1, 0))` at distances d for a fovea of width r, in one unit."""
    return (1 - distance / fovea).clamp(max=0).exp()
