"""What closer looks at mosaics find, to learn from: every window of a coarse lattice, looked at once and kept."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from semfov.data.mosaics import Mosaics
from semfov.data.scene import Annotation
from semfov.experiments.gists import gist_fields, pack_gists, unpack_gists
from semfov.experiments.looks import one_thread
from semfov.experiments.store import SceneStore
from semfov.experiments.zoom_store import SOURCES as GLANCES
from semfov.io.code import modules_digest
from semfov.io.schema import Field, Schema
from semfov.observation.matching import box_iou
from semfov.zoom.eye import ZoomEye
from semfov.zoom.gist import FOUND, Gist
from semfov.zoom.glances import Glance, LiveGlances, Window, around, half_steps
from semfov.zoom.lattice import Lattice

SOURCES = (*GLANCES, "semfov.data.mosaics", __name__)
"""Modules that turn photographs into examples, with all that they import."""


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


@torch.inference_mode()
def look_at_mosaic(eye: ZoomEye, mosaics: Mosaics, index: int) -> ZoomExample:
    """Look at a mosaic in windows half a window apart, and at each of its photographs alone.

    On one thread, as everything that is kept: the bits then do not depend on the machine's processors.
    """
    image, annotation = mosaics[index].image, mosaics.annotation(index)
    view = eye.open(image)
    glances = LiveGlances(eye, view)
    windows = [*half_steps(view.lattice)]
    windows += [around(view.lattice, tuple(map(float, tile.slot))) for tile in mosaics.tiles(index)]  # type: ignore[arg-type]
    looks = []
    for window in windows:
        with one_thread():
            glance = glances.see([window])[0]
        looks.append(LookedAt(window, glance.gist, glance.show, found_by(glance, annotation)))
    return ZoomExample(view.lattice, annotation.labels, tuple(looks))


class MosaicStore(SceneStore):
    """What was seen of mosaics: of the gists only cells with a hint, at half precision.

    Args:
        folder: where the store lies.
        settings: `ZoomEye.settings()`.
        classes: of the detector.
    """

    def __init__(self, folder: Path, settings: Mapping[str, object], classes: int) -> None:
        schema = Schema(
            {
                "show": Field(("N", classes), torch.float32, low=0, high=1),
                "labels": Field(("M",), torch.int64, low=1, high=classes),
                "found": Field(("N", "M"), torch.bool),
                **gist_fields(torch.float16, classes),
            }
        )
        super().__init__(folder, {"settings": settings}, modules_digest(*SOURCES), schema)


def pack(example: ZoomExample) -> dict[str, Tensor]:
    """An example as tensors for a file."""
    show = torch.stack([look.show for look in example.looks])
    return {
        "labels": example.labels,
        "show": show,
        "found": torch.stack([look.found for look in example.looks]),
        **pack_gists([look.gist for look in example.looks], show.shape[-1], torch.float16),
    }


def unpack(tensors: dict[str, Tensor], lattice: Lattice, slots: list[tuple[float, float, float, float]]) -> ZoomExample:
    """The example that `pack` made the tensors from, of a mosaic with these slots."""
    windows = [*half_steps(lattice), *(around(lattice, slot) for slot in slots)]
    told = zip(windows, unpack_gists(tensors, windows), tensors["show"], tensors["found"], strict=True)
    return ZoomExample(lattice, tensors["labels"], tuple(LookedAt(*parts) for parts in told))
