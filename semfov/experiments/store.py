"""Stores the detections from every cell of every scene, so that they are computed only once.

Scenes are static and the gaze rests on cell centres, so the detections are a function of scene and cell. A store keeps
them under a key of everything that they depend on. It changes the duration of a run, and never its result.
"""

import hashlib
import json
import platform
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.experiments.looks import SOURCES
from semfov.io.cached import read_tensors, write_tensors
from semfov.io.code import modules_digest
from semfov.io.schema import Field, Schema
from semfov.version import __version__


class SceneStore:
    """A folder of tensors with one file for each scene.

    Files are written atomically and carry a checksum. A file that is damaged, truncated, of another version or of
    another schema counts as missing, and its tensors are computed again.

    Args:
        folder: folder of the store; several runs and processes may share it.
        what: settings that the tensors depend on.
        code: sha256 of the source code that the tensors depend on.
        schema: schema of a file.
    """

    def __init__(self, folder: Path, what: Mapping[str, object], code: str, schema: Schema) -> None:
        described = json.dumps({**what, "versions": {**versions(), "code": code}}, sort_keys=True)
        self.key = hashlib.sha256(described.encode()).hexdigest()
        self.folder = folder / self.key[:16]
        self.schema = schema

    def path(self, digest: str) -> Path:
        """Path of the file of the scene whose image has this sha256."""
        return self.folder / f"{digest[:32]}.safetensors"

    def read(self, digest: str) -> dict[str, Tensor] | None:
        """Read the tensors of a scene; None if they are missing or damaged."""
        return read_tensors(self.path(digest), self.key, self.schema)

    def write(self, digest: str, tensors: Mapping[str, Tensor]) -> None:
        """Write the tensors of a scene."""
        write_tensors(self.path(digest), self.key, tensors)


class DetectionStore(SceneStore):
    """Detections from every cell of a scene, on disk.

    Args:
        folder: folder of the store.
        settings: `Eye.settings()`.
        columns: number of columns of the grid.
        rows: number of rows of the grid.
        components: length of the score vectors (None: any length).
    """

    def __init__(
        self, folder: Path, settings: Mapping[str, object], columns: int, rows: int, components: int | None = None
    ) -> None:
        what = {"settings": settings, **grid_settings(columns, rows)}
        schema = Schema(
            {
                "boxes": Field(("M", 4)),
                "scores": Field(("M", "C" if components is None else components), low=0, high=1),
                "count": Field((columns * rows,), torch.int64, low=0),
            }
        )
        super().__init__(folder, what, looks_digest(), schema)

    def load(self, digest: str) -> Detections | None:
        """The detections from every cell of a scene; None if they are missing or incomplete."""
        tensors = self.read(digest)
        if tensors is None or int(tensors["count"].sum()) != len(tensors["boxes"]):
            return None
        return unpack(tensors)

    def save(self, digest: str, detections: Detections) -> None:
        """Store the detections of a scene."""
        self.write(digest, pack(detections))


def grid_settings(columns: int, rows: int) -> dict[str, object]:
    """Settings of a grid on which looks from its cells depend."""
    # The cell centres in a picture of odd size identify the way in which a grid is laid out.
    return {"grid": [columns, rows], "centres": Grid(columns, rows, (641, 479)).centres.tolist()}


def versions() -> dict[str, object]:
    """Versions of semfov, of its libraries and of the machine, on which numerical results depend."""
    import kornia
    import torchvision

    return {
        "semfov": __version__,
        "torch": torch.__version__,
        "torchvision": torchvision.__version__,
        "kornia": kornia.__version__,
        "machine": [platform.machine(), torch.backends.cpu.get_cpu_capability()],
    }


@cache
def looks_digest(*more: str) -> str:
    """Digest of the source code that turns an image into detections; a store is not reused after a change of it.

    Args:
        *more: dotted names of further modules.

    Returns:
        The sha256.
    """
    return modules_digest(*SOURCES, *more)


def pack(detections: Detections) -> dict[str, Tensor]:
    """Convert detections to tensors without padding, which makes up most of a padded batch."""
    mask = detections.mask
    return {
        "boxes": detections.boxes[mask],
        "scores": detections.scores[mask],
        "count": mask.sum(-1),
    }


def unpack(tensors: dict[str, Tensor]) -> Detections:
    """Convert the tensors of `pack` back to a padded batch."""
    count = tensors["count"]
    mask = torch.arange(int(count.max()) if len(count) else 0) < count[:, None]
    boxes = tensors["boxes"].new_zeros(*mask.shape, 4)
    scores = tensors["scores"].new_zeros(*mask.shape, tensors["scores"].shape[-1])
    boxes[mask], scores[mask] = tensors["boxes"], tensors["scores"]
    return Detections(boxes, scores, mask)


def unpack_each(tensors: dict[str, Tensor]) -> list[Detections] | None:
    """Convert the tensors of `pack` back to batches of one without padding; None if they are incomplete."""
    if int(tensors["count"].sum()) != len(tensors["boxes"]):
        return None
    seen = unpack(tensors)
    return [tight(seen[number : number + 1]) for number in range(len(tensors["count"]))]


def tight(look: Detections) -> Detections:
    """Remove the padding of a batch of one."""
    mask = look.mask[0]
    return Detections(look.boxes[:, mask], look.scores[:, mask], look.mask[:, mask])
