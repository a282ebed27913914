"""Placement of labels in figures, so that no label covers another."""

import math
from collections.abc import Iterable, Iterator, Sequence

from semfov.data.scene import boxes_meet

LabelBox = tuple[float, float, float, float]
_Size = tuple[float, float]
_Point = tuple[float, float]


def place_labels(
    boxes: Sequence[LabelBox], sizes: Sequence[_Size], frame: _Size, obstacles: Sequence[LabelBox] = ()
) -> list[LabelBox]:
    """Rectangles for labels `(width, height)` of boxes: at a free corner of the box, or further down."""
    corners = [
        [(x1, y1), (x1, y2 - high), (x2 - wide, y1), (x2 - wide, y2 - high), (x1, y1 - high), (x1, y2)]
        for (x1, y1, x2, y2), (wide, high) in zip(boxes, sizes, strict=True)
    ]
    return place_within(corners, sizes, frame, obstacles)


def place_numbers(
    points: Sequence[_Point], sizes: Sequence[_Size], frame: _Size, reach: float
) -> list[LabelBox | None]:
    """Rectangles for the numbers of points: on the point where there is room, or else near it."""
    placed: list[LabelBox] = []
    places: list[LabelBox | None] = [None] * len(points)
    ends = [len(points) - 1, 0] if len(points) > 1 else [0]
    for number in [*ends, *range(1, len(points) - 1)]:
        width, height = sizes[number]
        others = [point for point in points if point != points[number]]
        for x, y in _around(points[number], (width, height), reach):
            label = _into(x - width / 2, y - height / 2, width, height, frame)
            x1, y1, x2, y2 = label
            covers = any(boxes_meet(label, each) for each in placed)
            if not covers and not any(x1 < x < x2 and y1 < y < y2 for x, y in others):
                places[number] = label
                placed.append(label)
                break
    return places


def place_within(
    candidates: Sequence[Iterable[_Point]], sizes: Sequence[_Size], frame: _Size, obstacles: Sequence[LabelBox] = ()
) -> list[LabelBox]:
    """Rectangles for labels whose first corner may be at any of several points: at a free one, or further down."""
    placed = list(obstacles)
    for points, (width, height) in zip(candidates, sizes, strict=True):
        inside = [_into(x, y, width, height, frame) for x, y in points]
        free = (label for label in inside if not any(boxes_meet(label, each) for each in placed))
        x1, y1, x2, y2 = next(free, inside[0])
        while covered := [other for other in placed if boxes_meet((x1, y1, x2, y2), other)]:
            y1, y2 = (lowest := max(other[3] for other in covered)), lowest + y2 - y1
        placed.append((x1, y1, x2, y2))
    return placed[len(obstacles) :]


def _around(point: _Point, size: _Size, reach: float) -> Iterator[_Point]:
    """The point itself, followed by rings of points around it."""
    yield point
    radius = step = 0.6 * max(size)
    while radius <= reach:
        for turn in range(16):
            angle = math.pi / 8 * turn
            yield point[0] + radius * math.cos(angle), point[1] + radius * math.sin(angle)
        radius += step / 2


def _into(x: float, y: float, width: float, height: float, frame: _Size) -> LabelBox:
    x, y = max(0.0, min(x, frame[0] - width)), max(0.0, min(y, frame[1] - height))
    return x, y, x + width, y + height
