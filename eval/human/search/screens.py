"""Pictures as people saw them: letterboxed on a grey screen, with the box of the target."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from semfov.data.classes import class_index
from semfov.data.fixations import Fixations, Letterbox, coco_name
from semfov.data.reading import read_image
from semfov.data.scene import Annotation, Scene, Scenes
from semfov.detection.placement import resize
from semfov.errors import InputError
from semfov.io.files import sha256

GREY = 0.5
"""Grey value of the screen around the picture."""


class Screens(Scenes):
    """Screens with one picture each, as scenes whose only object is the target (a `Scenes`).

    Args:
        folders: folders in which pictures are looked for, under their own name or under that of COCO
            (`semfov.data.fixations.coco_name`).
        searches: one search for each picture, in screen pixels. A search is left out if its picture is in no folder, or
            if the detector does not know its target class.
        classes: classes of the detector.
    """

    ids: list[str]

    def __init__(self, folders: Sequence[Path], searches: Mapping[str, Fixations], classes: tuple[str, ...]) -> None:
        self.classes = classes
        self._files: dict[str, Path] = {}
        for name in sorted(searches):
            file = next((path for folder in folders for path in _candidates(folder, name) if path.is_file()), None)
            if file is not None and _class(searches[name], classes) is not None:
                self._files[name] = file
        self.ids = list(self._files)
        self.searches = {name: searches[name] for name in self.ids}

    @property
    def fingerprint(self) -> str:  # type: ignore[override]
        """sha256 of pictures, screens and targets."""
        what = [(self.digest(i), self.searches[n].target, self.searches[n].box) for i, n in enumerate(self.ids)]
        return hashlib.sha256(json.dumps(what).encode()).hexdigest()

    def __getitem__(self, index: int) -> Scene:
        name, annotation = self.ids[index], self.annotation(index)
        return Scene(name, name, self._screen(index), annotation.boxes, annotation.labels)

    def digest(self, index: int) -> str:
        """sha256 of what the pixels of a screen depend on."""
        name = self.ids[index]
        what = [sha256(self._files[name]), self.searches[name].size, GREY, "letterbox"]
        return hashlib.sha256(json.dumps(what).encode()).hexdigest()

    def annotation(self, index: int) -> Annotation:
        """Return the target's box."""
        search = self.searches[self.ids[index]]
        label = _class(search, self.classes)
        assert label is not None
        assert search.box is not None
        labels = torch.tensor([label])
        return Annotation(torch.tensor([search.box]), labels, torch.zeros(1, dtype=torch.bool), search.size)

    def targets(self, index: int) -> list[int]:
        """Return the target."""
        return self.annotation(index).labels.tolist()

    def _screen(self, index: int) -> Tensor:
        search = self.searches[self.ids[index]]
        picture = read_image(self._files[self.ids[index]])
        width, height = search.size
        placed = Letterbox(search.size, (picture.shape[-1], picture.shape[-2]))
        left, top = (round(edge) for edge in placed.offset)
        size = round(picture.shape[-1] * placed.scale), round(picture.shape[-2] * placed.scale)
        size = min(size[0], width - left), min(size[1], height - top)
        screen = torch.full((3, height, width), GREY)
        screen[:, top : top + size[1], left : left + size[0]] = resize(picture[None], size)[0]
        return screen


def _candidates(folder: Path, name: str) -> list[Path]:
    try:
        return [folder / name, folder / coco_name(name)]
    except InputError:
        return [folder / name]


def _class(search: Fixations, classes: tuple[str, ...]) -> int | None:
    try:
        return class_index(search.target or "", classes)
    except InputError:
        return None
