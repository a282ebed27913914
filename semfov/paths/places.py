"""Places of a picture at which many fixations are expected: the peaks of a density."""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.io.tables import digits, pixels

REACH = 0.05
"""Distance, in longer sides of the picture, within which probability belongs to a place."""

Place = dict[str, float]
"""`x` and `y` in pixels of the picture, and `share`, the probability of a fixation around it."""


def places_of(cells: Tensor, size: tuple[int, int], *, around: bool) -> list[Place]:
    """List all places of a density, the most likely first.

    Near fixations count more in the choice of a place, so that it is where the density is high. Places are at least
    twice as far apart as they reach.

    Args:
        cells: `(rows, columns)`, probability of a fixation in each cell.
        size: `(width, height)` of the picture in pixels.
        around: whether the left and the right edge of the picture meet.

    Returns:
        The places, by their shares.
    """
    rows, columns = cells.shape
    surroundings = _surroundings(rows, columns, size, around)
    centres = surroundings.centres
    density = cells.flatten()  # (N,), as the shares and what is free
    share = surroundings.is_within.to(cells) @ density
    weighted_share = surroundings.weight.to(cells) @ density
    places: list[Place] = []
    is_free = torch.ones(len(centres), dtype=torch.bool)
    while bool(is_free.any()):  # all of them, since a later place can have a larger share
        best = int(torch.where(is_free, weighted_share, -1.0).argmax())
        x, y = centres[best].tolist()
        places.append({"x": pixels(x - 0.5), "y": pixels(y - 0.5), "share": digits(float(share[best]))})
        is_free &= surroundings.is_apart[best]
    return sorted(places, key=lambda place: -place["share"])


class _Surroundings(NamedTuple):
    """What lies around each of N cells: their centres `(N, 2)`, and matrices `(N, N)` of pairs of cells.

    A place at a cell has the cells that are within its reach, with weights that fall to 0 at its border; other places
    are apart, at least two reaches away.
    """

    centres: Tensor
    is_within: Tensor
    weight: Tensor
    is_apart: Tensor


@lru_cache(maxsize=1)  # a picture has a density for each of the first fixations
def _surroundings(rows: int, columns: int, size: tuple[int, int], around: bool) -> _Surroundings:
    """Compute what lies around the cells of a picture of `(width, height)` pixels."""
    width, height = size
    x = (torch.arange(columns) + 0.5) * (width / columns)
    y = (torch.arange(rows) + 0.5) * (height / rows)
    centres = torch.stack([x.expand(rows, -1), y[:, None].expand(-1, columns)], -1).flatten(0, 1)
    # In reaches of a place, so that 1 is its border.
    distance = _distances(centres, width if around else None) / (REACH * max(size))
    return _Surroundings(centres, distance <= 1, (1 - distance).clamp(min=0), distance > 2)


def _distances(points: Tensor, around: float | None) -> Tensor:
    """Compute the distances between points `(N, 2)`, `(N, N)`; the shorter way round a panorama of width `around`."""
    distance = torch.cdist(points, points)
    if around is None:
        return distance
    turn = points.new_tensor([around, 0.0])
    distance_left = torch.cdist(points, points - turn)
    distance_right = torch.cdist(points, points + turn)
    return distance.minimum(distance_left).minimum(distance_right)


def are_apart(place: Place, others: list[Place], size: tuple[int, int], *, around: bool) -> bool:
    """Tell whether a place is as far from all others as two places of one density are."""
    least = 2 * REACH * max(size)
    for other in others:
        distance_x = abs(place["x"] - other["x"])
        if around:
            distance_x = min(distance_x, size[0] - distance_x)
        distance_y = place["y"] - other["y"]
        if distance_x**2 + distance_y**2 <= least**2:
            return False
    return True
