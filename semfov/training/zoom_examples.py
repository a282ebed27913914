"""What closer looks at mosaics find, to learn from: every window of a coarse lattice."""

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
    """A look at a window, with what it found.

    Attributes:
        window: that was looked at.
        gist: of windows that can be looked at closer.
        show: `(K,)`, highest score of each class.
        found: `(M,)`, which objects of the scene it found.
    """

    window: Window
    gist: Gist | None
    show: Tensor
    found: Tensor


@dataclass(frozen=True)
class ZoomExample:
    """A mosaic, looked at in many windows.

    Attributes:
        lattice: of the mosaic.
        labels: `(M,)`, classes of its objects.
        looks: the overview first.
    """

    lattice: Lattice
    labels: Tensor
    looks: tuple[LookedAt, ...]


def found_by(glance: Glance, annotation: Annotation, score: float = FOUND, iou: float = 0.5) -> Tensor:
    """Which objects a look finds, `(M,)`: a detection of their class, with this score and overlap."""
    detections = glance.detections
    sure = detections.confidence[0] >= score
    boxes, labels = detections.boxes[0, sure], detections.labels[0, sure]
    hits = (box_iou(boxes, annotation.boxes) >= iou) & (labels[:, None] == annotation.labels)
    return hits.any(0) if len(boxes) else torch.zeros(len(annotation.boxes), dtype=torch.bool)


def windows_of(mosaics: Mosaics, index: int, lattice: Lattice) -> list[Window]:
    """Windows of a mosaic half a window apart, and each of its photographs alone."""
    slots: Any = [tuple(map(float, tile.slot)) for tile in mosaics.tiles(index)]
    return [*half_steps(lattice), *(around(lattice, slot) for slot in slots)]


def example_of(mosaics: Mosaics, index: int, glances: Glances) -> ZoomExample:
    """What looks at a mosaic show and find."""
    annotation = mosaics.annotation(index)
    looks = [
        LookedAt(glance.window, glance.gist, glance.show, found_by(glance, annotation))
        for glance in glances.see(windows_of(mosaics, index, glances.lattice))
    ]
    return ZoomExample(glances.lattice, annotation.labels, tuple(looks))
