"""Where to write the labels of boxes, so that none covers another."""

from collections.abc import Sequence

Box = tuple[float, float, float, float]
Size = tuple[float, float]


def place_labels(boxes: Sequence[Box], sizes: Sequence[Size], frame: Size, taken: Sequence[Box] = ()) -> list[Box]:
    """Rectangles for the labels of boxes, in order: at a corner of the box where one is free, else further down.

    Args:
        boxes: `(x1, y1, x2, y2)`, y growing downwards.
        sizes: `(width, height)` of each label.
        frame: `(width, height)` that labels should not leave, as far as they fit.
        taken: rectangles to keep free, too.

    >>> place_labels([(0, 0, 9, 9), (0, 0, 9, 9)], [(4, 1), (4, 1)], (10, 10))
    [(0, 0, 4, 1), (0, 8, 4, 9)]
    """
    placed: list[Box] = list(taken)
    for (x1, y1, x2, y2), (width, height) in zip(boxes, sizes, strict=True):
        corners = [
            (x1, y1),
            (x1, y2 - height),
            (x2 - width, y1),
            (x2 - width, y2 - height),
            (x1, y1 - height),
            (x1, y2),
        ]
        inside = [_into(x, y, width, height, frame) for x, y in corners]
        free = next((label for label in inside if not _covers_any(label, placed)), None)
        placed.append(free or _further(inside[0], placed))
    return placed[len(taken) :]


def _into(x: float, y: float, width: float, height: float, frame: Size) -> Box:
    x, y = max(0, min(x, frame[0] - width)), max(0, min(y, frame[1] - height))
    return x, y, x + width, y + height


def _further(label: Box, placed: list[Box]) -> Box:
    """The label moved down until it is free, out of the frame if need be."""
    x1, y1, x2, y2 = label
    while covered := [other for other in placed if _cover((x1, y1, x2, y2), other)]:
        y1, y2 = (lowest := max(other[3] for other in covered)), lowest + y2 - y1
    return x1, y1, x2, y2


def _covers_any(label: Box, placed: list[Box]) -> bool:
    return any(_cover(label, other) for other in placed)


def _cover(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
