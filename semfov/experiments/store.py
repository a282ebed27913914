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

import kornia
import torch
import torchvision
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.eye import Eye
from semfov.io.cached import read_tensors, write_tensors
from semfov.version import __version__


def see_all(eye: Eye, image: Tensor, grid: Grid) -> Detections:
    """Detections in `image` `(3, H, W)` from the centre of every cell, a batch of X·Y.

    Views go through the detector one at a time: the bits then do not depend on which views share a batch.
    """
    view = eye.open(image[None])
    with torch.inference_mode():
        looks = [eye.look(view, centre[None]) for centre in grid.centres.to(image)]
        return Detections.stack(looks)


class SceneStore:
    """A folder of tensors, one file for each scene.

    Files are written atomically and carry a checksum; one that is damaged, cut short or of another version counts
    as missing and is computed again.

    Args:
        folder: where the store lies; several runs and processes may share it.
        what: settings that the tensors depend on.
        code: sha256 of the sources that they depend on.
    """

    def __init__(self, folder: Path, what: Mapping[str, object], code: str) -> None:
        versions = {
            "semfov": __version__,
            "torch": torch.__version__,
            "torchvision": torchvision.__version__,
            "kornia": kornia.__version__,
            "machine": [platform.machine(), torch.backends.cpu.get_cpu_capability()],
            "code": code,
        }
        described = json.dumps({**what, "versions": versions}, sort_keys=True)
        self.key = hashlib.sha256(described.encode()).hexdigest()
        self.folder = folder / self.key[:16]

    def path(self, digest: str) -> Path:
        """File for the scene whose image has this sha256."""
        return self.folder / f"{digest[:32]}.safetensors"

    def read(self, digest: str) -> dict[str, Tensor] | None:
        """Tensors of a scene, or None if the store does not have them whole."""
        return read_tensors(self.path(digest), self.key)

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
    """

    def __init__(self, folder: Path, settings: Mapping[str, object], columns: int, rows: int) -> None:
        super().__init__(folder, {"settings": settings, "grid": [columns, rows]}, code_digest())

    def load(self, digest: str) -> Detections | None:
        """Detections from every cell of a scene, or None if the store does not have them whole."""
        tensors = self.read(digest)
        return None if tensors is None else unpack(tensors)

    def save(self, digest: str, detections: Detections) -> None:
        """Keep the detections of a scene."""
        self.write(digest, pack(detections))


@cache
def code_digest(*more: str) -> str:
    """sha256 over the sources that turn an image into detections: a store never outlives a change of them.

    Args:
        more: patterns of further files of the package.
    """
    package = Path(__file__).parents[1]
    patterns = ("sensor/*.py", "detection/*.py", "eye.py", *more)
    files = sorted(file for pattern in patterns for file in package.glob(pattern))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


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
