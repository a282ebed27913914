"""Photographs in a folder, without annotations."""

from collections.abc import Iterable
from os import PathLike
from pathlib import Path

import torch

from semfov.data.reading import read_image
from semfov.data.scene import Annotation, Scene, Scenes
from semfov.errors import DataError
from semfov.io.files import inside, json_sha256, sha256


class Pictures(Scenes):
    """Photographs by the names of their files, as `Scenes` without objects.

    Args:
        root: their folder.
        names: of the files.
        classes: names of the detector's classes.

    Private attribute: `_sizes` has `(width, height)` of the photographs that were asked for, by their positions.
    """

    ids: list[str]

    def __init__(self, root: str | PathLike[str], names: Iterable[str], classes: tuple[str, ...]) -> None:
        self.root = Path(root)
        self.classes = classes
        self.ids = sorted(set(names))
        self._sizes: dict[int, tuple[int, int]] = {}
        missing = [name for name in self.ids if not self._path(name).is_file()]
        if missing:
            found = len(self.ids) - len(missing)
            raise DataError(
                f"{self.root}: expected {len(self.ids)} pictures, got {found}: {missing[0]} is missing; "
                "check the folder and the names"
            )

    @property
    def fingerprint(self) -> str:  # type: ignore[override]
        """sha256 of the names and contents of the files."""
        return json_sha256([(name, self.digest(index)) for index, name in enumerate(self.ids)])

    def __getitem__(self, index: int) -> Scene:
        name = self.ids[index]
        image = read_image(self._path(name))
        height, width = image.shape[-2:]
        objects = _no_objects((width, height))
        return Scene(name, name, image, objects.boxes, objects.labels)

    def digest(self, index: int) -> str:
        """Compute the sha256 of a file's content."""
        path = self._path(self.ids[index])
        return sha256(path, f"image {path}")

    def annotation(self, index: int) -> Annotation:
        """Return an annotation without objects, with the size of the picture."""
        if index not in self._sizes:
            height, width = read_image(self._path(self.ids[index])).shape[-2:]
            self._sizes[index] = width, height
        return _no_objects(self._sizes[index])

    def targets(self, index: int) -> list[int]:
        """Return an empty list: no objects are known."""
        return []

    def _path(self, name: str) -> Path:
        """Find the file of a name; one's own folder may hold links to photographs elsewhere."""
        return inside(self.root, name, links=True)


def _no_objects(size: tuple[int, int]) -> Annotation:
    """Make the annotation of a picture of `(width, height)` whose objects are not known."""
    labels = torch.zeros(0, dtype=torch.int64)
    return Annotation(torch.zeros(0, 4), labels, labels.bool(), size)
