"""Stores the looks of an eye in a head, so that each is computed only once."""

from collections.abc import Callable, Mapping
from pathlib import Path

import torch

from semfov.detection.detections import Detections
from semfov.experiments.looks import SOURCES, one_thread
from semfov.experiments.store import SceneStore, pack, tight, unpack_each
from semfov.head.episode import Detect
from semfov.io.code import modules_digest
from semfov.io.schema import Field, Schema


class HeadStore(SceneStore):
    """Detections by action, on disk.

    Args:
        folder: folder of the store.
        settings: settings of the eye and of the views.
        classes: number of the detector's classes.
    """

    def __init__(self, folder: Path, settings: Mapping[str, object], classes: int) -> None:
        schema = Schema(
            {
                "actions": Field(("N",), torch.int64, low=0),
                "count": Field(("N",), torch.int64, low=0),
                "boxes": Field(("M", 4), torch.float32),
                "scores": Field(("M", classes + 1), torch.float32, low=0, high=1),
            }
        )
        code = modules_digest(*SOURCES, "semfov.head.views", "semfov.head.panoramas", "semfov.data.mosaics", __name__)
        super().__init__(folder, {"settings": settings}, code, schema)

    def load(self, digest: str) -> dict[int, Detections]:
        """The stored looks at a scene; empty if they are missing or incomplete."""
        tensors = self.read(digest)
        looks = None if tensors is None else unpack_each(tensors)
        return {} if tensors is None or looks is None else dict(zip(tensors["actions"].tolist(), looks, strict=True))

    def save(self, digest: str, looks: Mapping[int, Detections]) -> None:
        """Store the looks at a scene."""
        actions = sorted(looks)
        together = Detections.stack([looks[action] for action in actions])
        self.write(digest, {"actions": torch.tensor(actions), **pack(together)})


class StoredLooksAround:
    """Looks at one scene, each computed once: read from a store, or taken by an eye that is opened only when needed.

    Args:
        live: opens the scene; returns the function that looks.
        store: store of the looks; None stores none.
        digest: digest of the scene's pixels.
    """

    def __init__(self, live: Callable[[], Detect], store: HeadStore | None, digest: str) -> None:
        self._open, self._live = live, None
        self._store, self._digest = store, digest
        self._known = {} if store is None else store.load(digest)
        self._kept = len(self._known)

    _live: Detect | None

    def __call__(self, action: int) -> Detections:
        """The detections of an action."""
        if action not in self._known:
            with one_thread(), torch.inference_mode():
                self._live = self._open() if self._live is None else self._live
                self._known[action] = tight(self._live(action))
        return self._known[action]

    def save(self) -> None:
        """Store the looks at the scene if there are new ones."""
        if self._store is not None and len(self._known) > self._kept:
            self._store.save(self._digest, self._known)
            self._kept = len(self._known)
