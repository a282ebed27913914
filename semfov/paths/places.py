"""Places of a picture at which many fixations are expected: the peaks of a density."""

import torch
from torch import Tensor

from semfov.io.tables import digits, pixels

REACH = 0.05
"""Distance, in longer sides of the picture, within which probability belongs to a place."""

Place = dict[str, float]
"""`x` and `y` in pixels of the picture, and `share`, the probability of a fixation around it."""


def places_of(cells: Tensor, size: tuple[int, int], *, around: bool = False) -> list[Place]:
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
    width, height = size
    x = (torch.arange(columns) + 0.5) * (width / columns)
    y = (torch.arange(rows) + 0.5) * (height / rows)
    centres = torch.stack([x.expand(rows, -1), y[:, None].expand(-1, columns)], -1).flatten(0, 1)
    distance = torch.cdist(centres, centres)
    if around:
        seam = centres.new_tensor([width, 0.0])
        for other_side in (centres - seam, centres + seam):
            distance = torch.minimum(distance, torch.cdist(centres, other_side))
    distance = distance / (REACH * max(size))
    share = (distance <= 1).to(cells) @ cells.flatten()
    value = (1 - distance).clamp(min=0).to(cells) @ cells.flatten()
    free = torch.ones(len(centres), dtype=torch.bool)
    places: list[Place] = []
    while bool(free.any()):  # all of them, since a later place can have a larger share
        best = int(torch.where(free, value, -1.0).argmax())
        x_best, y_best = centres[best].tolist()
        places.append({"x": pixels(x_best - 0.5), "y": pixels(y_best - 0.5), "share": digits(float(share[best]))})
        free &= distance[best] > 2
    return sorted(places, key=lambda place: -place["share"])


def are_apart(place: Place, others: list[Place], size: tuple[int, int], *, around: bool = False) -> bool:
    """Tell whether a place is as far from all others as two places of one density are."""
    least = 2 * REACH * max(size)
    for other in others:
        across = abs(place["x"] - other["x"])
        if around:
            across = min(across, size[0] - across)
        if across**2 + (place["y"] - other["y"]) ** 2 <= least**2:
            return False
    return True
