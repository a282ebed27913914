"""Annotation files in COCO's format; every entry is checked before it is used."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import Any

import torch

from semfov.errors import DataError, check_data
from semfov.io.files import read_json, sha256
from semfov.io.schema import excerpt, is_number, is_plain

Id = int | str
"""The id of an image or of a category."""

ABSENT, PARTIAL = "neg_category_ids", "not_exhaustive_category_ids"
"""Fields of an image in LVIS: categories that it surely lacks, and those of which not every object is annotated."""

_LARGEST = 2**24  # largest side in pixels for which float32 represents every whole pixel
_BEYOND = 0.2  # share of boxes that leave their pictures from which on they may be corners


@dataclass(frozen=True)
class Annotations:
    """The images, categories and objects of a file in COCO's format.

    Attributes:
        images: entry of each image by its id, with its `file_name`; `width` and `height` may be missing or None.
        categories: entry of each category by its id, with its `name`.
        objects: the objects of each image by its id: `category_id`, `bbox`, and `iscrowd`, 0 or 1.
        digest: sha256 of the file.
    """

    images: dict[Id, dict[str, Any]]
    categories: dict[Id, dict[str, Any]]
    objects: dict[Id, list[dict[str, Any]]]
    digest: str

    def size(self, image: Id) -> tuple[int, int] | None:
        """`(width, height)` of an image; None if the file does not say."""
        width, height = (self.images[image].get(side) for side in ("width", "height"))
        return None if width is None or height is None else (int(width), int(height))


def read_annotations(path: str | PathLike[str]) -> Annotations:
    """Read and check a COCO instances file; ids of images and categories are integers or strings.

    Objects need no id and no area, which nothing depends on. Where `iscrowd` is missing or null it is 0. The name of an
    image may be the end of its `coco_url`, as in LVIS.
    """
    name = f"annotations {Path(path)}"
    data = read_json(path, name=name)
    expected = "an object with images, annotations and categories"
    check_data(isinstance(data, dict), name, expected, f"{excerpt(data)}; fetch the file again")
    images = _by_id(data, "images", name, {"width": _SIDE, "height": _SIDE, ABSENT: _IDS, PARTIAL: _IDS})
    for entry in images.values():
        if entry.get("file_name") is None and isinstance(entry.get("coco_url"), str):
            entry["file_name"] = PurePosixPath(entry["coco_url"]).name
    _checked(data, "images", name, {"file_name": _TEXT})
    categories = _by_id(data, "categories", name, {"name": _TEXT})
    for key, entries in (("images", images), ("categories", categories)):
        kinds = {type(each) for each in entries}
        check_data(len(kinds) < 2, f"{name}: {key}", "ids of one kind", f"integers and strings; {_WAY}")
    fields: dict[str, _Field] = {
        "image_id": (lambda value: _ID[0](value) and value in images, "the id of one of the images"),
        "category_id": (lambda value: _ID[0](value) and value in categories, "the id of one of the categories"),
        "bbox": _BOX,
        "iscrowd": _CROWD,
    }
    objects: dict[Id, list[dict[str, Any]]] = {image: [] for image in images}
    for entry in _checked(data, "annotations", name, fields):
        category, crowd = _plain_id(entry["category_id"]), int(entry.get("iscrowd") or 0)
        objects[entry["image_id"]].append({"category_id": category, "bbox": entry["bbox"], "iscrowd": crowd})
    return Annotations(images, categories, objects, sha256(path))


_Field = tuple[Callable[[Any], object], str]  # whether a value of an entry fits, and what it is expected to be

_ID: _Field = (
    lambda value: _is_whole(value) or (isinstance(value, str) and is_plain(value)),
    "an integer or a string without control characters",
)
_IDS: _Field = (
    lambda value: value is None or (isinstance(value, list) and all(map(_ID[0], value))),
    "a list of ids of categories",
)
_TEXT: _Field = (
    lambda value: isinstance(value, str) and value and is_plain(value),
    "a string without control characters",
)
_SIDE: _Field = (
    lambda value: value is None or (is_number(value) and 1 <= value <= _LARGEST and value == int(value)),
    "a whole number of pixels",
)
_BOX: _Field = (
    lambda value: isinstance(value, list) and len(value) == 4 and all(map(is_number, value)) and min(value[2:]) >= 0,
    "[x, y, width, height] with finite numbers and a size of at least 0",
)
_WAY = "correct or replace the file"


_CROWD: _Field = (lambda value: value is None or value in (0, 1), "0 or 1")


def _checked(data: dict[str, Any], key: str, name: str, fields: Mapping[str, _Field]) -> list[dict[str, Any]]:
    """The entries of a list, whose fields are as expected."""
    entries = data.get(key)
    if not isinstance(entries, list):
        raise DataError(f"{name}: expected {key} to be a list, got {_show(data, key)}; {_WAY}")
    for place, entry in enumerate(entries):  # of which there are many, so that messages are made where they are needed
        if not isinstance(entry, dict):
            raise DataError(f"{name}: {key}[{place}]: expected an object, got {excerpt(entry)}; {_WAY}")
        for field, (fits, expected) in fields.items():
            if not fits(entry.get(field)):
                fault = f"expected {field} to be {expected}, got {_show(entry, field)}; {_WAY}"
                raise DataError(f"{name}: {key}[{place}]: {fault}")
    return entries


def _by_id(data: dict[str, Any], key: str, name: str, fields: Mapping[str, _Field]) -> dict[Id, dict[str, Any]]:
    """The checked entries of a list by their ids, which are unique."""
    found: dict[Id, dict[str, Any]] = {}
    for place, entry in enumerate(_checked(data, key, name, {"id": _ID, **fields})):
        if entry["id"] in found:
            fault = f"expected unique ids, got id {_show(entry, 'id')} more than once; {_WAY}"
            raise DataError(f"{name}: {key}[{place}]: {fault}")
        found[_plain_id(entry["id"])] = entry
    return found


def _is_whole(value: object) -> bool:
    """Whether a number is whole, also as tables with gaps write it, 7.0."""
    return type(value) is int or (type(value) is float and value.is_integer())


def _plain_id(value: Any) -> Id:
    return int(value) if isinstance(value, float) else value


def _show(entry: dict[str, Any], key: str) -> str:
    return excerpt(entry[key]) if key in entry else "nothing"


def warn_of_form(boxes: torch.Tensor, limits: torch.Tensor, path: object, *, stacklevel: int = 3) -> None:
    """Warn of boxes `(N, 4)` in pictures of sizes `(N, 4)` that look like no [x, y, width, height] in pixels."""
    if not len(boxes):
        return
    corners = bool(((boxes[:, 2:] > boxes[:, :2]) & (boxes[:, 2:] <= limits[:, 2:] + 1)).all())
    beyond = (boxes[:, :2] + boxes[:, 2:] > limits[:, 2:] + 1).any(-1).double().mean()
    seems = "corners [x1, y1, x2, y2]" if corners and float(beyond) >= _BEYOND else None
    if float(boxes.max()) <= 1 and float(limits.min()) > 2:
        seems = "fractions of the picture"
    if seems is not None:
        said = f"{path}: bbox is [x, y, width, height] in pixels, and these look like {seems}"
        warnings.warn(said, stacklevel=stacklevel)
