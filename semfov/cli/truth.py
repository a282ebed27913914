"""Annotations in COCO's format whose ids results take, and the average precision against them."""

import re
import warnings
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from operator import eq
from pathlib import Path, PurePosixPath
from unicodedata import normalize
from urllib.parse import unquote

import torch

from semfov.data.annotations import Id, read_annotations, warn_of_form
from semfov.data.classes import canonical_name
from semfov.data.images import SWAPPED, file_orientation
from semfov.errors import DataError, check, check_data
from semfov.metrics.average_precision import average_precision
from semfov.paths.conversion import Values


class Truth:
    """An annotation file in COCO's format: pictures by the ends of their paths, and categories by their names.

    Boxes refer to the upright picture, as viewers and programs for annotation show it; but if only the stored picture
    has the size that the file states, they refer to the stored one (as in `semfov.data.CocoScenes`). Where the size
    does not tell (none is stated, or the stored picture is square, upside down or mirrored), boxes are those of the
    upright picture.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.annotations = read_annotations(path)
        self._images: dict[str, list[Id]] = defaultdict(list)
        for image, entry in self.annotations.images.items():
            for spelled in _spellings(_parts(entry["file_name"])[-1]):
                self._images[spelled].append(image)
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
                limits += [size * 2] * len(entries)  # width, height, width, height
        corners = torch.tensor(boxes).view(-1, 4).double()  # (M, 4), as other programs write them
        warn_of_form(corners, torch.tensor(limits).view(-1, 4).double(), self.path)
        if empty:
            warnings.warn(f"{self.path}: {empty} boxes have no area, and are not judged", stacklevel=3)

    def image_id(self, name: str) -> Id:
        """Find the id of a picture by its name; among equal names, the path that agrees in most folders.

        Where no image is named as the picture is, names agree in any letter case, and as other systems and addresses
        write them: `K%C3%BCche.JPG` for `Küche.jpg`. Then come the names that programs give to uploaded pictures, on
        one side alone, and last those of pictures that were saved in another format.

        Args:
            name: path of the picture.

        Returns:
            The id of the image in the annotations.

        Raises:
            DataError: no image, or several, have this name.
        """
        for agree in (eq, _agree_plainly, _agree_after_upload, _agree_after_export):
            images = self._named(name, agree)
            if len(images) == 1:
                break
        expected = f"one image with the file_name of {name}"
        names = [entry["file_name"] for entry in self.annotations.images.values()]
        got = f"{len(images)} of {len(names)}, which are named as {names[0]!r:.100}" if names else "no images"
        check_data(len(images) == 1, f"annotations {self.path}", expected, got)
        return images[0]

    def orientation(self, image: Id, name: str, size: tuple[int, int], file: Path | None) -> int:
        """Return the EXIF orientation to which a picture's boxes refer: 1 (upright), or that of the stored file.

        Args:
            image: id of the image.
            name: of the picture, for messages.
            size: `(width, height)` of the upright picture.
            file: the picture's file; None for one that has none.

        Returns:
            The orientation, for `semfov.data.images.stored_boxes`.

        Raises:
            DataError: neither the upright picture nor its stored pixels have the size that the file states.
        """
        stated = self.annotations.size(image)
        if stated is None or stated == size:
            return 1
        width, height = size
        orientation = 1 if file is None else file_orientation(file)
        if stated == (height, width) and orientation >= SWAPPED:
            return orientation
        raise DataError(
            f"annotations {self.path}: expected {name} to have {stated[0]} × {stated[1]} px, got {width} × {height}; "
            "its boxes are in another frame"
        )

    def _named(self, name: str, agree: Callable[[str, str], bool]) -> list[Id]:
        """List the images of a picture's name, those whose folders agree best.

        Args:
            name: path of the picture.
            agree: tells whether two parts of paths are the same.
        """
        parts = _parts(name)
        agreements = {}
        for spelled in _spellings(parts[-1]):
            for image in self._images.get(spelled, ()):
                image_parts = _parts(self.annotations.images[image]["file_name"])
                agreements[image] = _common_end(parts, image_parts, agree)
        best = max(agreements.values(), default=0)
        return [image for image, agreement in agreements.items() if agreement == best > 0]

    def check_pictures(self, names: Sequence[str]) -> None:
        """Raise `DataError` unless each of some pictures has an image of its own.

        Args:
            names: paths of the pictures.
        """
        pictures: dict[Id, str] = {}
        for name in names:
            image = self.image_id(name)
            taken = f"the same for {pictures.get(image)} and {name}"
            check_data(image not in pictures, f"annotations {self.path}", "an image for each picture", taken)
            pictures[image] = name

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
        # Reversed, so that of two categories of one name the first one counts.
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


def _without_address(part: str) -> str:
    """Write the name of a picture plainly, without a question behind it, or Label Studio's server before it.

    `kitchen.jpg?token=1` and `?d=photos%5Ckitchen.jpg` are both `kitchen.jpg`.
    """
    address, _, question = part.partition("?")
    asked_for = question[2:] if question.startswith("d=") else address
    return re.split(r"[/\\]", _plain(asked_for))[-1]


def _uploaded(part: str) -> str:
    """Write a part of a path plainly, without what programs add to the names of pictures that are uploaded to them.

    Label Studio puts eight digits before a name, `0b51f2a7-kitchen.jpg`, and Roboflow its own suffix behind it,
    `kitchen_jpg.rf.4a1cdeb7f3.jpg`.
    """
    plain = re.sub(r"^[0-9a-f]{8}-(?=.)", "", _without_address(part))
    return re.sub(r"_(jpe?g|png|bmp|tiff?|webp)\.rf\.[0-9a-z]+\.[a-z]+$", r".\1", plain)


def _stem(plain: str) -> str:
    """Leave out the suffix of a picture."""
    return re.sub(r"(?<=.)\.(jpe?g|png|bmp|tiff?|webp)$", "", plain)


def _letters(plain: str) -> str:
    """Leave out the suffix and all but letters and digits, since uploads replace or drop blanks and brackets."""
    return re.sub(r"[\W_]", "", _stem(plain))


def _spellings(part: str) -> set[str]:
    """Write a part of a path in all its ways: two parts that `_agree_plainly` or in another way share one of them."""
    plain, uploaded = _plain(part), _uploaded(part)
    return {plain, uploaded, _stem(plain), _letters(plain), _letters(uploaded)}


def _agree_plainly(part: str, other: str) -> bool:
    """Tell whether two parts of paths are the same but for what differs between systems."""
    return _plain(part) == _plain(other)


def _agree_after_upload(part: str, other: str) -> bool:
    """Tell whether a part of a path is another one, or what programs made of it.

    Eight digits are also a date: `20240109-cam1.jpg` and `20240101-cam1.jpg` are two pictures.
    """
    return _plain(other) in (_plain(part), _uploaded(part)) or _plain(part) == _uploaded(other)


def _agree_after_export(part: str, other: str) -> bool:
    """Tell whether parts are the same but for the format, or of an uploaded picture in letters and digits."""
    if _stem(_plain(part)) == _stem(_plain(other)):
        return True
    return _is_upload_of(part, other) or _is_upload_of(other, part)


def _is_upload_of(part: str, other: str) -> bool:
    """Tell whether a program made a part of a path of another one, whose marks it replaced or dropped."""
    letters = _letters(_uploaded(part))
    return _uploaded(part) != _plain(part) and letters == _letters(_plain(other)) != ""


def _common_end(parts: Sequence[str], others: Sequence[str], agree: Callable[[str, str], bool]) -> int:
    """Count the last parts in which two paths agree."""
    count = 0
    for part, other in zip(reversed(parts), reversed(others), strict=False):
        if not agree(part, other):
            break
        count += 1
    return count


def _parts(name: str) -> tuple[str, ...]:
    """Split a path into its parts, of Windows or not."""
    return PurePosixPath(name.replace("\\", "/")).parts or (name,)
