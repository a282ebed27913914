"""Annotations in COCO's format whose ids results take, and the average precision against them."""

import warnings
from collections import defaultdict
from collections.abc import Collection, Sequence
from itertools import takewhile
from pathlib import Path, PurePosixPath
from unicodedata import normalize
from urllib.parse import unquote

import torch

from semfov.data.annotations import Id, read_annotations, warn_of_form
from semfov.data.classes import canonical_name
from semfov.errors import DataError, check, check_data
from semfov.metrics.average_precision import average_precision
from semfov.paths.conversion import Values


class Truth:
    """An annotation file in COCO's format: pictures by the ends of their paths, and categories by their names."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.annotations = read_annotations(path)
        self._images: dict[str, list[Id]] = defaultdict(list)
        for image, entry in self.annotations.images.items():
            self._images[_plain(_parts(entry["file_name"])[-1])].append(image)
        self._warn_of_boxes()

    @property
    def digest(self) -> str:
        """The sha256 of the file."""
        return self.annotations.digest

    def _warn_of_boxes(self) -> None:
        """Warn of boxes that are written in another form, and of those without area, which are not judged."""
        boxes = []
        limits = []
        empty = 0
        for image, entries in self.annotations.objects.items():
            size = self.annotations.size(image)
            empty += sum(min(entry["bbox"][2:]) == 0 for entry in entries)
            if size is not None:
                boxes += [entry["bbox"] for entry in entries]
                limits += [size * 2] * len(entries)
        corners = torch.tensor(boxes).view(-1, 4).double()
        warn_of_form(corners, torch.tensor(limits).view(-1, 4).double(), self.path)
        if empty:
            warnings.warn(f"{self.path}: {empty} boxes have no area, and are not judged", stacklevel=3)

    def image_id(self, name: str, size: tuple[int, int] | None = None) -> Id:
        """Find the id of a picture; of several of one name that whose folders agree best, letter by letter if need be.

        Names agree in any letter case, and as other systems and addresses write them: `K%C3%BCche.JPG` for `Küche.jpg`.

        Args:
            name: path of the picture.
            size: `(width, height)` that the annotations must have; None checks nothing.

        Returns:
            The id of the image in the annotations.

        Raises:
            DataError: no image, or several, have this name, or its size is another one.
        """
        parts = _parts(name)

        def agreement(image: Id) -> tuple[int, int]:
            """Count the last parts of both paths that agree, and those that are equal."""
            image_parts = _parts(self.annotations.images[image]["file_name"])
            pairs = [*zip(reversed(parts), reversed(image_parts), strict=False)]
            agreeing = takewhile(lambda pair: _plain(pair[0]) == _plain(pair[1]), pairs)
            equal = takewhile(lambda pair: pair[0] == pair[1], pairs)
            return len([*agreeing]), len([*equal])

        images = sorted(self._images.get(_plain(parts[-1]), ()), key=agreement)
        is_ambiguous = len(images) > 1 and agreement(images[-1]) == agreement(images[-2])
        expected = f"one image with the file_name of {name}"
        check_data(bool(images) and not is_ambiguous, f"annotations {self.path}", expected, len(images))
        best = images[-1]
        stated = self.annotations.size(best)
        if size is not None and stated is not None and stated != size:
            raise DataError(
                f"annotations {self.path}: expected {name} to have {stated[0]} × {stated[1]} px, got {size[0]} × "
                f"{size[1]}; its boxes are in another frame"
            )
        return best

    def categories(self, classes: Collection[str]) -> dict[str, Id]:
        """Find the categories of the file that are among some classes.

        Args:
            classes: names of the classes.

        Returns:
            The first id of each category, by its canonical name.

        Raises:
            InputError: none of the classes is a category.
        """
        names = {canonical_name(name) for name in classes}
        categories = self.annotations.categories
        ids = [(canonical_name(category["name"]), id_) for id_, category in categories.items()]
        found = {name: id_ for name, id_ in reversed(ids) if name in names}
        examples = ", ".join(category["name"] for category in [*categories.values()][:5])
        check(bool(found), "annotations", f"some of the classes {', '.join([*classes][:5])} as categories", examples)
        return found

    def judge(self, results: Sequence[Values], images: Sequence[Id], classes: Collection[str]) -> str:
        """AP and AP50 of results over some images and classes, in words."""
        precision = average_precision(self.annotations, results, images=images, classes=classes)
        counts = f"({len(images)} pictures, {len(results)} boxes)"
        if precision is None:
            return f"no AP: {self.path} has no boxes of these classes in these pictures {counts}"
        return f"AP {precision[0]:.3f}, AP50 {precision[1]:.3f} against {self.path} {counts}"


def _plain(part: str) -> str:
    """Write a part of a path without what differs between systems: letter case, composed letters, percent signs."""
    return normalize("NFC", unquote(part)).casefold()


def _parts(name: str) -> tuple[str, ...]:
    """Split a path into its parts, of Windows or not."""
    return PurePosixPath(name.replace("\\", "/")).parts or (name,)
