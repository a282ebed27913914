"""Looks of an eye in a head, computed once and kept on disk."""

from collections.abc import Callable, Mapping
from pathlib import Path

import torch

from semfov.detection.detections import Detections
from semfov.experiments.looks import SOURCES, one_thread
from semfov.experiments.store import SceneStore, pack, unpack
from semfov.head.episode import Detect
from semfov.io.code import modules_digest
from semfov.io.schema import Field, Schema


class HeadStore(SceneStore):
    """Detections by action.

    Args:
        folder: where the store lies.
        settings: of the eye, and of the views.
        classes: of the detector.
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
        """Looks at a scene; none where the store does not have them whole."""
        tensors = self.read(digest)
        if tensors is None or int(tensors["count"].sum()) != len(tensors["boxes"]):
            return {}
        seen = unpack({name: tensors[name] for name in ("boxes", "scores", "count")})
        return {action: _tight(seen[n : n + 1]) for n, action in enumerate(tensors["actions"].tolist())}

    def save(self, digest: str, looks: Mapping[int, Detections]) -> None:
        """Keep the looks at a scene."""
        actions = sorted(looks)
        together = Detections.stack([looks[action] for action in actions])
        self.write(digest, {"actions": torch.tensor(actions), **pack(together)})


def _tight(look: Detections) -> Detections:
    """A batch of one without its padding."""
    mask = look.mask[0]
    return Detections(look.boxes[:, mask], look.scores[:, mask], look.mask[:, mask])


class StoredLooksAround:
    """Looks at one scene, each taken once: from a store, or by an eye that is opened when it is first needed.

    Args:
        live: opens the scene.
        store: where looks are kept; None keeps none.
        digest: of the scene's pixels.
    """

    def __init__(self, live: Callable[[], Detect], store: HeadStore | None, digest: str) -> None:
        self._open, self._live = live, None
        self._store, self._digest = store, digest
        self._known = {} if store is None else store.load(digest)
        self._kept = len(self._known)

    _live: Detect | None

    def __call__(self, action: int) -> Detections:
        """What is seen by an action."""
        if action not in self._known:
            with one_thread(), torch.inference_mode():
                self._live = self._open() if self._live is None else self._live
                self._known[action] = _tight(self._live(action))
        return self._known[action]

    def save(self) -> None:
        """Keep what is new."""
        if self._store is not None and len(self._known) > self._kept:
            self._store.save(self._digest, self._known)
            self._kept = len(self._known)
