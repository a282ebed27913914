"""What is seen from every cell of every scene, computed once and kept on disk.

Scenes are static and the gaze sits on cell centres, so what is seen is a function of (scene, cell). A store remembers
it under a key of everything that it depends on; it changes how long a run takes and nothing else.
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
    """A folder of tensors, one file for each scene.

    Files are written atomically and carry a checksum; one that is damaged, cut short, of another version or not of
    this store's schema counts as missing and is computed again.

    Args:
        folder: where the store lies; several runs and processes may share it.
        what: settings that the tensors depend on.
        code: sha256 of the sources that they depend on.
        schema: what a file holds.
    """

    def __init__(self, folder: Path, what: Mapping[str, object], code: str, schema: Schema) -> None:
        described = json.dumps({**what, "versions": {**versions(), "code": code}}, sort_keys=True)
        self.key = hashlib.sha256(described.encode()).hexdigest()
        self.folder = folder / self.key[:16]
        self.schema = schema

    def path(self, digest: str) -> Path:
        """File for the scene whose image has this sha256."""
        return self.folder / f"{digest[:32]}.safetensors"

    def read(self, digest: str) -> dict[str, Tensor] | None:
        """Tensors of a scene, or None if the store does not have them whole."""
        return read_tensors(self.path(digest), self.key, self.schema)

    def write(self, digest: str, tensors: Mapping[str, Tensor]) -> None:
        """Keep the tensors of a scene."""
        write_tensors(self.path(digest), self.key, tensors)


class DetectionStore(SceneStore):
    """Detections from every cell.

    Args:
        folder: where the store lies.
        settings: `Eye.settings()`.
        columns: cells in a row.
        rows: cells in a column.
        components: length of the score vectors; None where it is not known.
    """

    def __init__(
        self, folder: Path, settings: Mapping[str, object], columns: int, rows: int, components: int | None = None
    ) -> None:
        # Where the cells of a picture of odd sizes have their centres stands for how a grid is laid.
        centres = Grid(columns, rows, (641, 479)).centres.tolist()
        what = {"settings": settings, "grid": [columns, rows], "centres": centres}
        schema = Schema(
            {
                "boxes": Field(("M", 4)),
                "scores": Field(("M", "C" if components is None else components), low=0, high=1),
                "count": Field((columns * rows,), torch.int64, low=0),
            }
        )
        super().__init__(folder, what, looks_digest(), schema)

    def load(self, digest: str) -> Detections | None:
        """Detections from every cell of a scene, or None if the store does not have them whole."""
        tensors = self.read(digest)
        if tensors is None or int(tensors["count"].sum()) != len(tensors["boxes"]):
            return None
        return unpack(tensors)

    def save(self, digest: str, detections: Detections) -> None:
        """Keep the detections of a scene."""
        self.write(digest, pack(detections))


def versions() -> dict[str, object]:
    """Of everything besides this package that numbers depend on."""
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
    """sha256 over the sources that turn an image into detections: a store never outlives a change of them.

    Args:
        more: dotted names of further modules.
    """
    return modules_digest(*SOURCES, *more)


def pack(detections: Detections) -> dict[str, Tensor]:
    """Detections without their padding, which is most of a padded batch."""
    mask = detections.mask
    return {
        "boxes": detections.boxes[mask],
        "scores": detections.scores[mask],
        "count": mask.sum(-1),
    }


def unpack(tensors: dict[str, Tensor]) -> Detections:
    """The padded batch that `pack` made the tensors from."""
    count = tensors["count"]
    mask = torch.arange(int(count.max()) if len(count) else 0) < count[:, None]
    boxes = tensors["boxes"].new_zeros(*mask.shape, 4)
    scores = tensors["scores"].new_zeros(*mask.shape, tensors["scores"].shape[-1])
    boxes[mask], scores[mask] = tensors["boxes"], tensors["scores"]
    return Detections(boxes, scores, mask)
