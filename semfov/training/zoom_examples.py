"""Training examples for evidence by magnification: looks at every window of a coarse lattice over mosaics."""

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
