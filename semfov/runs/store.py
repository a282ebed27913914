"""Looks at scenes, each computed only once: in memory and, with a store, on disk.

Scenes are static, so what a look shows is a function of scene and action: the cell, the pose and cell, the box or the
window that the eye looks at. A store keeps looks under a key of everything that they depend on. It changes the duration
of a run, and never its result.
"""

import hashlib
import json
import platform
from collections.abc import Callable, Hashable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.eye import Eye
from semfov.io.code import modules_digest
from semfov.io.schema import Field, Schema
from semfov.io.storage import read_tensors, write_tensors
from semfov.runs.looks import LOOK_SOURCES, photograph_looks
from semfov.threads import one_thread
from semfov.version import __version__

_Action = TypeVar("_Action", bound=Hashable)
_StoredLook = TypeVar("_StoredLook")


class SceneStore:
    """A folder of tensors with a file for each scene; one that is damaged or of another version counts as missing."""

    def __init__(self, folder: Path, what: Mapping[str, object], code: str, schema: Schema) -> None:
        described = json.dumps({**what, "versions": {**versions(), "code": code}}, sort_keys=True)
        self.key = hashlib.sha256(described.encode()).hexdigest()
        self.folder = folder / self.key[:16]
        self.schema = schema

    def path(self, digest: str) -> Path:
        """Path of the file of the scene whose image has this sha256."""
        return self.folder / digest[:2] / f"{digest[:32]}.safetensors"

    def read(self, digest: str) -> dict[str, Tensor] | None:
        """Read the tensors of a scene; None if they are missing or damaged."""
        return read_tensors(self.path(digest), self.key, self.schema)

    def write(self, digest: str, tensors: Mapping[str, Tensor]) -> None:
        write_tensors(self.path(digest), self.key, tensors)


class DetectionStore(SceneStore):
    """Looks at scenes, detections by action: a number, such as that of a cell, or the box of a closer look."""

    width = 5
    """Number of numbers of an action."""

    more: Mapping[str, Field] = {}  # names, shapes and ranges of the tensors that a look has besides its detections

    def __init__(self, folder: Path, what: Mapping[str, object], sources: Sequence[str], components: int) -> None:
        fields = {
            "actions": Field(("N", self.width), torch.float64),
            "count": Field(("N",), torch.int64, low=0),
            "boxes": Field(("M", 4)),
            "scores": Field(("M", components), low=0, high=1),
            "confidence": Field(("M",), low=0, high=1),
            "highest": Field(("N", components), low=0, high=1),
        }
        super().__init__(folder, what, modules_digest(*sources, __name__), Schema(fields | {**self.more}))

    def load(self, digest: str) -> dict[Any, Any]:
        tensors = self.read(digest)
        if tensors is None:
            return {}
        # The schema cannot tell this: the looks together have as many boxes as the file.
        boxes = int(tensors["count"].sum())
        if boxes != len(tensors["boxes"]):
            return {}
        actions = [self.decode(row) for row in tensors["actions"].tolist()]
        return dict(zip(actions, self.unpack(tensors, actions), strict=True))

    def save(self, digest: str, looks: Mapping[Any, Any]) -> None:
        rows = {action: tuple(map(float, self.encode(action))) for action in looks}
        # In a fixed order, so that the same looks give the same bytes.
        actions = sorted(looks, key=rows.__getitem__)
        numbers = torch.tensor([rows[action] for action in actions], dtype=torch.float64)
        packed = self.pack([looks[action] for action in actions])
        self.write(digest, {"actions": numbers, **packed})

    def encode(self, action: Any) -> Sequence[float]:
        """Write an action as numbers: itself, or -1 and the corners of a box."""
        return (-1, *action) if isinstance(action, tuple) else (action, 0, 0, 0, 0)

    def decode(self, row: Sequence[float]) -> Any:
        """Read the action of some numbers."""
        return tuple(row[1:]) if row[0] < 0 else int(row[0])

    def pack(self, looks: Sequence[Any]) -> dict[str, Tensor]:
        """Join the detections of looks without padding, which makes up most of a padded batch."""
        return {
            "count": torch.cat([look.mask.sum(-1) for look in looks]),  # (N,), one for each look; they sum to M
            "boxes": torch.cat([look.boxes[look.mask] for look in looks]),  # (M, 4)
            "scores": torch.cat([look.scores[look.mask] for look in looks]),  # (M, C)
            "confidence": torch.cat([look.confidence[look.mask] for look in looks]),  # (M,)
            "highest": torch.cat([look.highest for look in looks]),  # (N, C)
        }

    def unpack(self, tensors: Mapping[str, Tensor], actions: Sequence[Any]) -> list[Any]:
        """Split the tensors of `pack` into the detections of each look, a batch of one without padding."""
        counts = tensors["count"].tolist()
        columns = [tensors[name].split(counts) for name in ("boxes", "scores", "confidence")]
        looks = []
        for parts in zip(*columns, tensors["highest"], strict=True):
            boxes, scores, confidence, highest = (part[None].clone() for part in parts)
            mask = torch.ones(1, boxes.shape[1], dtype=torch.bool)
            looks.append(Detections(boxes, scores, mask, confidence, highest))
        return looks


def cell_store(
    folder: Path,
    settings: Mapping[str, object],
    columns: int,
    rows: int,
    components: int,
) -> DetectionStore:
    """Open a store of looks from the cells of a grid, and of closer looks."""
    # The cell centres in a picture of odd size identify the way in which a grid is laid out.
    centres = Grid(columns, rows, (641, 479)).centres.tolist()
    what = {"settings": settings, "grid": [columns, rows], "centres": centres}
    return DetectionStore(folder, what, LOOK_SOURCES, components)


class RememberedLooks(Generic[_Action, _StoredLook]):
    """Looks at one scene by action, each made once, one at a time and on one thread, on which its last bits depend."""

    def __init__(
        self,
        open_scene: Callable[[], Callable[[_Action], _StoredLook]],
        store: DetectionStore | None = None,
        digest: Callable[[], str] = lambda: "",
    ) -> None:
        self._open = open_scene
        self._store = store
        self._digest = digest
        self._look: Callable[[_Action], _StoredLook] | None = None
        self._looks: dict[_Action, _StoredLook] | None = None
        self._stored = 0

    @property
    def looks(self) -> dict[_Action, _StoredLook]:
        if self._looks is None:
            self._looks = {} if self._store is None else self._store.load(self._digest())
            self._stored = len(self._looks)
        return self._looks

    def __call__(self, action: _Action) -> _StoredLook:
        """Look, or remember."""
        looks = self.looks
        if action not in looks:
            with one_thread(), torch.inference_mode():
                self._look = self._open() if self._look is None else self._look
                looks[action] = self._look(action)
        return looks[action]

    def save(self) -> None:
        """Store the looks at the scene if there are new ones."""
        looks = self._looks or {}
        if self._store is not None and len(looks) > self._stored:
            self._store.save(self._digest(), looks)
            self._stored = len(looks)

    def close(self) -> None:
        """Store new looks, and free the opened scene and the stored looks; a later look reads them again."""
        self._look = None
        self.save()
        # Without a store they could not be read again, and are kept.
        if self._store is not None:
            self._looks = None


def look_everywhere(
    eye: Eye,
    image: Callable[[], Tensor],
    grid: Grid,
    store: DetectionStore | None,
    digest: Callable[[], str],
) -> Detections:
    """Detect from every cell of a photograph `(1, 3, H, W)`, read from a store, or computed and stored."""
    looks = RememberedLooks(lambda: photograph_looks(eye, image, grid), store, digest)
    detections = Detections.stack([looks(cell) for cell in range(len(grid))])
    looks.save()
    return detections


def versions() -> dict[str, object]:
    """Versions of semfov, of its libraries and of the machine, on which numerical results depend."""
    return {
        "semfov": __version__,
        "torch": torch.__version__,
        # To import them would take seconds.
        "torchvision": version("torchvision"),
        "kornia": version("kornia"),
        "machine": [platform.machine(), torch.backends.cpu.get_cpu_capability()],
    }
