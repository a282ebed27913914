"""Stores the glances at pictures, so that each is computed only once."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from semfov.data.scene import Scenes
from semfov.detection.detections import Detections
from semfov.detection.load import load_detector
from semfov.experiments.gists import gist_fields, pack_gists, unpack_gists
from semfov.experiments.looks import one_thread
from semfov.experiments.store import SceneStore
from semfov.io.code import modules_digest
from semfov.io.schema import Field, Schema
from semfov.zoom.eye import ZoomEye
from semfov.zoom.glances import Glance, Glances, LiveGlances, Window
from semfov.zoom.lattice import Lattice

SOURCES = (Glances.__module__, load_detector.__module__, "semfov.data.images", "semfov.data.large", __name__)
"""Modules that turn a large picture into glances; all modules that they import count, too."""


class GlanceStore(SceneStore):
    """Glances at pictures, on disk.

    Args:
        folder: folder of the store.
        settings: `ZoomEye.settings()`.
        classes: number of the detector's classes.
    """

    def __init__(self, folder: Path, settings: Mapping[str, object], classes: int) -> None:
        schema = Schema(
            {
                "show": Field(("N", classes), torch.float32, low=0, high=1),
                "windows": Field(("N", 12), torch.float64),
                "count": Field(("N",), torch.int64, low=0),
                "boxes": Field(("M", 4), torch.float32),
                "scores": Field(("M", classes + 1), torch.float32, low=0, high=1),
                "cut": Field(("M",), torch.bool),
                **gist_fields(classes),
            }
        )
        super().__init__(folder, {"settings": settings}, modules_digest(*SOURCES), schema)

    def load(self, digest: str) -> list[Glance]:
        """The stored glances at a picture; empty if they are missing or incomplete."""
        tensors = self.read(digest)
        if tensors is None or int(tensors["count"].sum()) != len(tensors["boxes"]):
            return []
        return unpack(tensors)

    def save(self, digest: str, glances: Sequence[Glance]) -> None:
        """Store the glances at a picture."""
        self.write(digest, pack(glances))


class StoredGlances(Glances):
    """Looks at one picture, each computed once: read from a store, or taken by an eye that is opened only when needed.

    Looks pass through the detector one at a time and on one thread. The bits then depend neither on which looks share a
    batch nor on the number of CPU cores.

    Args:
        lattice: lattice of the picture.
        live: opens the picture.
        store: store of the looks; None stores none.
        digest: digest of the picture's pixels.
    """

    def __init__(self, lattice: Lattice, live: Callable[[], Glances], store: GlanceStore | None, digest: str) -> None:
        self.lattice = lattice
        self._open, self._live = live, None
        self._store, self._digest = store, digest
        self._known = {} if store is None else {glance.window: glance for glance in store.load(digest)}
        self._kept = len(self._known)

    _live: Glances | None

    def see(self, windows: Sequence[Window], *, hints: bool = True) -> list[Glance]:
        """The looks at windows, read from the store or computed; they have all their hints."""
        for window in windows:
            if window not in self._known:
                with one_thread(), torch.inference_mode():
                    self._live = self._open() if self._live is None else self._live
                    self._known[window] = self._live.see([window])[0]
        return [self._known[window] for window in windows]

    def save(self) -> None:
        """Store the looks at the picture if there are new ones."""
        if self._store is not None and len(self._known) > self._kept:
            self._store.save(self._digest, [*self._known.values()])
            self._kept = len(self._known)


def open_scene(eye: ZoomEye, scenes: Scenes, index: int, store: GlanceStore | None) -> StoredGlances:
    """Looks of an eye at a scene; the scene's image is composed or read only when a look is not in the store."""
    lattice = Lattice.over(scenes.annotation(index).size, eye.detector.input_size, finest=eye.finest)

    def live() -> Glances:
        return LiveGlances(eye, eye.open(scenes[index].image))

    return StoredGlances(lattice, live, store, scenes.digest(index))


def pack(glances: Sequence[Glance]) -> dict[str, Tensor]:
    """Convert glances to tensors for a file."""
    # Four zeros stand for a window without a limit, since no limit ends at 0.
    rows = [
        [*g.window.fixation, *(g.window.within or (0.0, 0.0, 0.0, 0.0)), g.window.level, *g.window.cells]
        for g in glances
    ]
    return {
        "windows": torch.tensor(rows, dtype=torch.float64),
        "count": torch.tensor([len(g.cut) for g in glances]),
        "boxes": torch.cat([g.detections.boxes[0] for g in glances]),
        "scores": torch.cat([g.detections.scores[0] for g in glances]),
        "cut": torch.cat([g.cut for g in glances]),
        "show": torch.stack([g.show for g in glances]),
        **pack_gists([g.gist for g in glances], len(glances[0].show)),
    }


def unpack(tensors: dict[str, Tensor]) -> list[Glance]:
    """Convert the tensors of `pack` back to glances."""
    windows = [_window(row) for row in tensors["windows"].tolist()]
    counts = tensors["count"].tolist()
    parts = (tensors[name].split(counts) for name in ("boxes", "scores", "cut"))
    gists = unpack_gists(tensors, windows)
    return [
        Glance(
            window, Detections(boxes[None], scores[None], torch.ones(1, len(boxes), dtype=torch.bool)), cut, show, look
        )
        for window, boxes, scores, cut, show, look in zip(windows, *parts, tensors["show"], gists, strict=True)
    ]


def _window(row: list[float]) -> Window:
    within: Any = tuple(row[3:7]) if row[5] > 0 else None
    cells: Any = tuple(map(int, row[8:12]))
    return Window((row[0], row[1], row[2]), int(row[7]), cells, within)
