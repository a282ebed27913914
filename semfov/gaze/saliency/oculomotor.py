"""Oculomotor biases: where the eye tends to go after a scanpath, independent of the picture."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.errors import check, check_shape
from semfov.precision import exact_product

_LENGTHS = (0.0, 0.015, 0.03, 0.05, 0.075, 0.105, 0.145, 0.2, 0.27, 0.36, 0.5, 0.7, 1.0)
"""Distances, in longer sides of the picture, between which the tables are interpolated."""
_NEAR = (0.0, 0.02, 0.04, 0.07, 0.11, 0.16, 0.24)  # the same for refixation; from the last one on it has no effect
_DIRECTIONS = 7
_TURNS = 3
_AGES = 4
_NUMBERS = 12
_MEMORY = 8  # number of earlier fixations that refixation depends on, the latest ones


class OculomotorBias(nn.Module):
    r"""Log bias of the next fixation by saccade length and direction, turns, and returns to earlier fixations.

    .. math:: o(u \mid f_1 \ldots f_n) = \sum_k s_k(r) \, \phi_k(\theta) + \sum_k t_k(r) \cos(k\tau)
              + \sum_{i<n} b_{n-i}(\|u - f_i\|)

    r and θ are length and direction of the saccade from the last fixation :math:`f_n` to u, and τ is the turn from the
    saccade before. The last sum is over the eight fixations before the last one. φ are 1, cos θ, sin θ, cos 2θ,
    sin 2θ, cos 4θ and sin 4θ. The functions s, t and b are tables, interpolated linearly, in longer sides of the
    picture; b differs by the age of a fixation up to four. Gains of the map and of the centre bias depend on the number
    n of fixations so far.

    The form follows DeepGaze III (Kümmerer, Bethge and Wallis, 2022), whose part is a network on distances and
    differences to the last four fixations; tables can be read.

    Shape:
        - path: `(B, n, 2)`, `(x, y)` of the fixations so far in longer sides of the picture, the last one last; NaN
          before the first one of a shorter path
        - places: `(N, 2)`, in the same units
        - output: `(B, N)`

    >>> OculomotorBias()(torch.rand(2, 3, 2), torch.rand(5, 2)).shape
    torch.Size([2, 5])
    """

    def __init__(self) -> None:
        super().__init__()
        self.saccade = nn.Parameter(torch.zeros(_DIRECTIONS, len(_LENGTHS)))
        self.turn = nn.Parameter(torch.zeros(_TURNS, len(_LENGTHS)))
        self.back = nn.Parameter(torch.zeros(_AGES, len(_NEAR) - 1))
        self.gain = nn.Parameter(torch.ones(2, _NUMBERS))

    def forward(self, path: Tensor, places: Tensor) -> Tensor:
        """Compute the log bias of every place as the next fixation, up to a constant.

        Args:
            path: `(B, n, 2)`, fixations so far.
            places: `(N, 2)`.

        Returns:
            `(B, N)`.
        """
        check_shape(path, "path", None, None, 2)
        check_shape(places, "places", None, 2)
        check(path.shape[1] > 0, "path", "at least one fixation", tuple(path.shape))
        if path.shape[1] == 1:
            path = F.pad(path, (0, 0, 1, 0), value=torch.nan)
        saccades = self._saccade_bias(path[:, -1], path[:, -2], places)
        return self._refixation_bias(path, places, saccades)

    def _saccade_bias(self, last: Tensor, before: Tensor, places: Tensor) -> Tensor:
        """Compute the bias by length, direction and turn of the saccade to every place.

        Args:
            last: the last fixation, `(B, 2)`.
            before: the one before, `(B, 2)`, NaN for none.
            places: `(N, 2)`.

        Returns:
            `(B, N)`.
        """
        saccade = places - last[:, None]  # (B, N, 2)
        length = _norm(saccade)
        direction = saccade / length[..., None].clamp(min=1e-9)
        tables = torch.cat([self.saccade, self.turn])
        # A table that is interpolated linearly is its first value and the shares of its steps that were passed.
        by_length = tables[:, :1] + exact_product(tables.diff(dim=1), _passed(_LENGTHS, length))  # (B, tables, N)
        by_angle = torch.stack([*_of_direction(direction), *_of_turn(direction, last - before)], -2)
        return by_length.mul(by_angle).sum(-2)

    def _refixation_bias(self, path: Tensor, places: Tensor, bias: Tensor) -> Tensor:
        """Add to a bias that of the distance of every place to the fixations before the last one.

        Args:
            path: fixations so far, `(B, n, 2)`.
            places: `(N, 2)`.
            bias: `(B, N)`.

        Returns:
            `(B, N)`.
        """
        earlier = path[:, :-1].flip(1)[:, :_MEMORY]  # the latest first
        fixated = (~earlier[..., 0].isnan()).to(bias)
        points = torch.where(fixated[..., None] > 0, earlier, 0.0)
        # Products of matrices would lose the digits of short distances.
        distance = torch.cdist(points, places.expand(len(earlier), -1, -1), compute_mode="donot_use_mm_for_euclid_dist")
        ages = torch.arange(earlier.shape[1], device=path.device).clamp(max=_AGES - 1)
        tables = F.pad(self.back, (0, 1))[ages]  # (fixations, knots), 0 from the last knot on
        # As in `_saccade_bias`, a table is its first value and its steps; those of a fixation that is not there are 0.
        intervals = len(_NEAR) - 1
        steps = tables.diff(dim=1).flatten()  # one for each interval of each fixation
        fixated_by_interval = fixated[..., None].expand(-1, -1, intervals).flatten(1)
        weights = steps * fixated_by_interval
        passed = _passed(_NEAR, distance).flatten(1, 2)  # (B, fixations · intervals, N)
        by_distance = exact_product(weights[:, None], passed)[:, 0]
        at_fixations = (tables[:, 0] * fixated).sum(1)
        return bias + by_distance + at_fixations[:, None]

    def gains(self, number: Tensor) -> Tensor:
        """Look up the gains of the map and of the centre bias.

        Args:
            number: `(B,)`, number of fixations so far, from 1.

        Returns:
            `(B, 2)`.
        """
        return self.gain.t()[(number - 1).clamp(0, _NUMBERS - 1)]


def _of_direction(direction: Tensor) -> list[Tensor]:
    """Compute φ of unit vectors `(B, N, 2)`: 1, cos θ, sin θ, cos 2θ, sin 2θ, cos 4θ and sin 4θ."""
    cos, sin = direction.unbind(-1)
    cos2 = cos.square() - sin.square()
    sin2 = 2 * cos * sin
    cos4 = cos2.square() - sin2.square()
    sin4 = 2 * cos2 * sin2
    return [torch.ones_like(cos), cos, sin, cos2, sin2, cos4, sin4]


def _of_turn(direction: Tensor, before: Tensor) -> list[Tensor]:
    """Compute cos τ, cos 2τ and cos 3τ of the turns to unit vectors `(B, N, 2)` from the saccades before, `(B, 2)`.

    They are 0 where there is no saccade before, which is NaN.
    """
    step = torch.where(before.isnan(), 0.0, before)
    unit = step / _norm(step)[:, None].clamp(min=1e-9)
    cos, sin = direction.unbind(-1)
    cos_before, sin_before = unit[:, None].unbind(-1)  # (B, 1)
    cos_turn = cos * cos_before + sin * sin_before
    cos_2_turn = 2 * cos_turn.square() - 1
    cos_3_turn = 4 * cos_turn**3 - 3 * cos_turn
    has_turn = (~before[:, :1].isnan()).to(cos_turn)
    return [has_turn * cos_turn, has_turn * cos_2_turn, has_turn * cos_3_turn]


def _norm(vectors: Tensor) -> Tensor:
    """Compute the lengths of vectors `(..., 2)`, with a gradient of 0 at 0."""
    square = vectors.square().sum(-1)
    positive = square > 0
    return torch.where(positive, torch.where(positive, square, 1.0).sqrt(), 0.0)


def _passed(knots: tuple[float, ...], distance: Tensor) -> Tensor:
    """Compute the share of each interval between K knots that distances `(..., N)` have passed, `(..., K - 1, N)`."""
    knot = distance.new_tensor(knots)
    beyond_knot = distance[..., None, :] - knot[:-1, None]
    width = knot.diff()[:, None]
    return (beyond_knot / width).clamp(0, 1)
