"""Places of a picture at which many fixations are expected: the peaks of a density."""

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
    centres = _cell_centres(cells, size)  # (N, 2)
    # In reaches of a place, so that 1 is its border.
    distance = _distances(centres, size[0] if around else None) / (REACH * max(size))  # (N, N)
    density = cells.flatten()  # (N,), as the shares and what is free
    share = (distance <= 1).to(cells) @ density
    weighted_share = (1 - distance).clamp(min=0).to(cells) @ density
    places: list[Place] = []
    is_free = torch.ones(len(centres), dtype=torch.bool)
    while bool(is_free.any()):  # all of them, since a later place can have a larger share
        best = int(torch.where(is_free, weighted_share, -1.0).argmax())
        x, y = centres[best].tolist()
        places.append({"x": pixels(x - 0.5), "y": pixels(y - 0.5), "share": digits(float(share[best]))})
        is_free &= distance[best] > 2
    return sorted(places, key=lambda place: -place["share"])


def _cell_centres(cells: Tensor, size: tuple[int, int]) -> Tensor:
    """Compute the centres of cells `(rows, columns)` in pixels, edges at integers, `(rows · columns, 2)`."""
    rows, columns = cells.shape
    width, height = size
    x = (torch.arange(columns) + 0.5) * (width / columns)
    y = (torch.arange(rows) + 0.5) * (height / rows)
    return torch.stack([x.expand(rows, -1), y[:, None].expand(-1, columns)], -1).flatten(0, 1)


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
