"""Training examples for evidence by magnification: looks at every window of a coarse lattice over mosaics."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from semfov.data.mosaics import Mosaics
from semfov.data.scene import Annotation
from semfov.observation.matching import box_iou
from semfov.zoom.gist import FOUND, Gist
from semfov.zoom.glances import Glance, Glances, Window, around, half_steps
from semfov.zoom.lattice import Lattice
from semfov.zoom.networks import STEPS


@dataclass(frozen=True)
class LookedAt:
    """A look at a window and its results.

    Attributes:
        window: the window.
        gist: summary of the look, for windows that can be looked at closer; None for others.
        show: `(K,)`, highest score of each class.
        found: `(M,)` boolean, the objects of the scene that it found.
    """

    window: Window
    gist: Gist | None
    show: Tensor
    found: Tensor


@dataclass(frozen=True)
class ZoomExample:
    """A mosaic with looks at many windows.

    Attributes:
        lattice: the lattice of windows over the mosaic.
        labels: `(M,)`, classes of its objects.
        looks: the looks, the overview first.
    """

    lattice: Lattice
    labels: Tensor
    looks: tuple[LookedAt, ...]


def closer_windows(example: ZoomExample, looked_at: LookedAt) -> Iterator[tuple[LookedAt, int, tuple[int, ...]]]:
    """List the closer looks of a mosaic at windows of the lattice inside a look, as far as it predicts them.

    Args:
        example: the mosaic.
        looked_at: the look. Windows inside an overview may reach beyond the picture.

    Yields:
        The closer look, its octaves from the look, and its window `(x1, y1, x2, y2)` in cells of the gist.
    """
    look = looked_at.gist
    assert look is not None
    high, wide = look.scores.shape[:2]
    for closer in example.looks:
        steps = closer.window.level - look.level
        corners = zip(closer.window.cells, look.first * 2, strict=True)
        x1, y1, x2, y2 = ((cell - first) // look.scale for cell, first in corners)
        inside = x1 >= 0 and y1 >= 0 and x2 <= wide and y2 <= high
        if closer.window.within is None and 1 <= steps <= STEPS and (inside or look.level == 0):
            yield closer, steps, (x1, y1, x2, y2)


def found_by(glance: Glance, annotation: Annotation, score: float = FOUND, iou: float = 0.5) -> Tensor:
    """Find the objects that a look shows with a detection of their class.

    Args:
        glance: the look.
        annotation: the M objects of the scene.
        score: least score of the detection.
        iou: least overlap of the detection with the object.

    Returns:
        Whether each object is found, `(M,)` boolean.
    """
    detections = glance.detections
    sure = detections.confidence[0] >= score
    boxes, labels = detections.boxes[0, sure], detections.labels[0, sure]
    hits = (box_iou(boxes, annotation.boxes) >= iou) & (labels[:, None] == annotation.labels)
    return hits.any(0) if len(boxes) else torch.zeros(len(annotation.boxes), dtype=torch.bool)


def windows_of(mosaics: Mosaics, index: int, lattice: Lattice) -> list[Window]:
    """List the windows of a mosaic at steps of half a window, and one window for each photograph."""
    slots: Any = [tuple(map(float, tile.slot)) for tile in mosaics.tiles(index)]
    return [*half_steps(lattice), *(around(lattice, slot) for slot in slots)]


def example_of(mosaics: Mosaics, index: int, glances: Glances) -> ZoomExample:
    """Look at all windows of a mosaic and collect the results."""
    annotation = mosaics.annotation(index)
    looks = [
        LookedAt(glance.window, glance.gist, glance.show, found_by(glance, annotation))
        for glance in glances.see(windows_of(mosaics, index, glances.lattice))
    ]
    return ZoomExample(glances.lattice, annotation.labels, tuple(looks))
