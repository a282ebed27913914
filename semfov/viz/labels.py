"""Placement of labels in figures, so that no label covers another."""

import math
from collections.abc import Iterable, Iterator, Sequence

from semfov.data.scene import boxes_meet

LabelBox = tuple[float, float, float, float]
_Size = tuple[float, float]
_Point = tuple[float, float]


def at_both_ends(box: Sequence[float], width: float) -> list[LabelBox]:
    """Repeat a box that crosses the seam of a panorama at its other end.

    Args:
        box: `(x1, y1, x2, y2)`.
        width: width of the picture.

    Returns:
        The box, and where it reaches beyond the right border a second one.
    """
    x1, y1, x2, y2 = box
    shifts = (0, width) if x2 > width else (0,)
    return [(x1 - shift, y1, x2 - shift, y2) for shift in shifts]


def place_labels(
    boxes: Sequence[LabelBox], sizes: Sequence[_Size], frame: _Size, obstacles: Sequence[LabelBox] = ()
) -> list[LabelBox]:
    """Place labels of boxes at a free corner of the box, or further down.

    Args:
        boxes: the boxes.
        sizes: `(width, height)` of each label.
        frame: `(width, height)` of the picture.
        obstacles: rectangles that no label covers.

    Returns:
        The rectangle of each label.
    """
    corners = []
    for (x1, y1, x2, y2), (width, height) in zip(boxes, sizes, strict=True):
        inside = [(x1, y1), (x1, y2 - height), (x2 - width, y1), (x2 - width, y2 - height)]
        corners.append([*inside, (x1, y1 - height), (x1, y2)])
    return place_within(corners, sizes, frame, obstacles)


def place_numbers(
    points: Sequence[_Point], sizes: Sequence[_Size], frame: _Size, reach: float
) -> list[LabelBox | None]:
    """Place the numbers of points on the point where there is room, or else near it.

    The last point and the first come first, as they matter most. A number covers neither another number nor a point.

    Args:
        points: the points.
        sizes: `(width, height)` of each number.
        frame: `(width, height)` of the picture.
        reach: largest distance from the point.

    Returns:
        The rectangle of each number; None where there is no room.
    """
    placed: list[LabelBox] = []
    labels: list[LabelBox | None] = [None] * len(points)
    ends = [len(points) - 1, 0] if len(points) > 1 else [0]
    for number in [*ends, *range(1, len(points) - 1)]:
        other_points = [point for point in points if point != points[number]]
        label = _free_place(points[number], sizes[number], frame, reach, placed, other_points)
        if label is not None:
            labels[number] = label
            placed.append(label)
    return labels


def _free_place(
    point: _Point,
    size: _Size,
    frame: _Size,
    reach: float,
    placed: Sequence[LabelBox],
    points: Sequence[_Point],
) -> LabelBox | None:
    """Find the first rectangle around a point that covers neither one that is placed nor some points; None for none."""
    width, height = size
    for x, y in _around(point, size, reach):
        label = _into(x - width / 2, y - height / 2, width, height, frame)
        covers_label = bool(_covered(label, placed))
        if not covers_label and not any(_inside(other, label) for other in points):
            return label
    return None


def _inside(point: _Point, box: LabelBox) -> bool:
    x, y = point
    x1, y1, x2, y2 = box
    return x1 < x < x2 and y1 < y < y2


def place_within(
    candidates: Sequence[Iterable[_Point]], sizes: Sequence[_Size], frame: _Size, obstacles: Sequence[LabelBox] = ()
) -> list[LabelBox]:
    """Place labels whose left upper corner may be at any of several points: at a free one, or further down.

    Args:
        candidates: for each label the points, the best first.
        sizes: `(width, height)` of each label.
        frame: `(width, height)` of the picture.
        obstacles: rectangles that no label covers.

    Returns:
        The rectangle of each label.
    """
    placed = list(obstacles)
    for points, (width, height) in zip(candidates, sizes, strict=True):
        # A label without a free place moves down, below what it would cover, and at last below the picture.
        inside = [_into(x, y, width, height, frame) for x, y in points]
        free = (label for label in inside if not _covered(label, placed))
        label = next(free, inside[0])
        while covered := _covered(label, placed):
            label = _moved_down(label, max(other[3] for other in covered))
        placed.append(label)
    return placed[len(obstacles) :]


def _covered(label: LabelBox, placed: Sequence[LabelBox]) -> list[LabelBox]:
    """Find the rectangles that a label would cover."""
    return [other for other in placed if boxes_meet(label, other)]


def _moved_down(label: LabelBox, top: float) -> LabelBox:
    """Move a label down to a new upper border."""
    x1, y1, x2, y2 = label
    return x1, top, x2, top + y2 - y1


def _around(point: _Point, size: _Size, reach: float) -> Iterator[_Point]:
    """Go through the point itself, and rings of points around it."""
    yield point
    radius = step = 0.6 * max(size)
    while radius <= reach:
        for turn in range(16):
            angle = math.pi / 8 * turn
            yield point[0] + radius * math.cos(angle), point[1] + radius * math.sin(angle)
        radius += step / 2


def _into(x: float, y: float, width: float, height: float, frame: _Size) -> LabelBox:
    """Move a label with this left upper corner into the picture."""
    x = max(0.0, min(x, frame[0] - width))
    y = max(0.0, min(y, frame[1] - height))
    return x, y, x + width, y + height
