"""Annotation files in COCO's format; every entry is checked before it is used."""

import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, TypeGuard, cast

import torch

from semfov.data.scene import Annotation
from semfov.errors import DataError, check_data
from semfov.io.files import read_json, sha256
from semfov.io.schema import excerpt, is_number, is_plain
from semfov.words import FROM_YOLO

Id = int | str
"""The id of an image or of a category."""

Entry = dict[str, Any]
"""An object of the file, by its fields."""

ABSENT = "neg_category_ids"
"""Field of an image in LVIS: categories that it surely lacks."""

PARTIAL = "not_exhaustive_category_ids"
"""Field of an image in LVIS: categories of which not every object is annotated."""

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

    images: dict[Id, Entry]
    categories: dict[Id, Entry]
    objects: dict[Id, list[Entry]]
    digest: str

    def size(self, image: Id) -> tuple[int, int] | None:
        """Tell `(width, height)` of an image; None if the file does not say."""
        width = self.images[image].get("width")
        height = self.images[image].get("height")
        if width is None or height is None:
            return None
        return int(width), int(height)


def annotation_of(entries: Sequence[Entry], labels: Mapping[Id, int], size: tuple[int, int]) -> Annotation:
    """Convert the objects of an image.

    Args:
        entries: its objects, whose boxes are `[x, y, width, height]`.
        labels: class 1..K of each category.
        size: `(width, height)` of the image in pixels.

    Returns:
        The objects, with both corners of their boxes.
    """
    boxes = torch.tensor([entry["bbox"] for entry in entries], dtype=torch.float32).view(-1, 4)  # (N, 4)
    boxes[:, 2:] += boxes[:, :2]
    numbers = torch.tensor([labels[entry["category_id"]] for entry in entries], dtype=torch.long)
    crowd = torch.tensor([bool(entry["iscrowd"]) for entry in entries], dtype=torch.bool)
    return Annotation(boxes, numbers, crowd, size)


_OF_YOLO = f"labels of YOLO; {FROM_YOLO}"
_OF_LABEL_STUDIO = "tasks of Label Studio, whose menu Export also offers COCO"


def read_annotations(path: str | PathLike[str]) -> Annotations:
    """Read and check a COCO instances file.

    Ids of images and categories are integers or strings. Objects need no id and no area, which nothing depends on.
    Where `iscrowd` is missing or null it is 0, and where `bbox` is missing, null or empty it is around the polygons of
    `segmentation`. The name of an image may be the end of its `coco_url`, as in LVIS, and numbers may be written as
    texts.

    Args:
        path: the file.

    Returns:
        What it holds.

    Raises:
        DataError: the file is missing or damaged; the message names the entry and the field.
    """
    name = f"annotations {Path(path)}"
    expected = "an object with images, annotations and categories"
    try:
        data = read_json(path, name=name)
    except DataError:
        check_data(not _is_of_yolo(Path(path)), name, "a file in COCO's format, .json", _OF_YOLO)
        raise
    is_of_label_studio = isinstance(data, list) and bool(data) and isinstance(data[0], dict) and "data" in data[0]
    check_data(not is_of_label_studio, name, expected, _OF_LABEL_STUDIO)
    check_data(isinstance(data, dict), name, expected, f"{excerpt(data)}; fetch the file again")
    images = _images(data, name)
    categories = _by_id(data, "categories", name, {"name": _NAME})
    _check_one_kind(images, f"{name}: images")
    _check_one_kind(categories, f"{name}: categories")
    image_ids = _by_text(images)
    category_ids = _by_text(categories)
    fields = {
        "image_id": _reference(image_ids, "the id of one of the images"),
        "category_id": _reference(category_ids, "the id of one of the categories"),
        "bbox": _BOX,
        "iscrowd": _CROWD,
    }
    objects: dict[Id, list[Entry]] = {image: [] for image in images}
    _box_polygons(data)
    for entry in _checked(data, "annotations", name, fields):
        category = category_ids[_id_text(entry["category_id"])]
        crowd = int(entry.get("iscrowd") or 0)
        box = {"category_id": category, "bbox": entry["bbox"], "iscrowd": crowd}
        objects[image_ids[_id_text(entry["image_id"])]].append(box)
    return Annotations(images, categories, objects, sha256(path))


def _box_polygons(data: Entry) -> None:
    """Give the objects without `bbox` the box around their polygons, where they have some."""
    entries = data.get("annotations")
    if not isinstance(entries, list):
        return  # it is refused where all entries are checked
    for entry in entries:
        if isinstance(entry, dict) and entry.get("bbox") in (None, []):
            polygons = entry.get("segmentation")
            if _are_polygons(polygons):
                entry["bbox"] = _box_around(polygons)


def _box_around(polygons: Sequence[Sequence[float]]) -> list[float]:
    """Find the box `[x, y, width, height]` around polygons `[x, y, x, y, …]`."""
    xs: list[float] = []
    ys: list[float] = []
    for polygon in polygons:
        xs += polygon[::2]
        ys += polygon[1::2]
    left = min(xs)
    top = min(ys)
    return [left, top, max(xs) - left, max(ys) - top]


def _are_polygons(value: object) -> TypeGuard[list[list[float]]]:
    """Tell whether a segmentation is a list of polygons, each as `[x, y, x, y, …]`; it may be run lengths, too."""
    if not isinstance(value, list) or not value:
        return False
    return all(isinstance(polygon, list) and len(polygon) > 1 and all(map(is_number, polygon)) for polygon in value)


def _is_of_yolo(path: Path) -> bool:
    """Tell by its name whether what is no JSON is a file of YOLO, or the folder of its labels."""
    is_named_so = path.suffix.lower() in (".txt", ".yaml", ".yml")
    return (path.is_file() and is_named_so) or any(path.glob("*.txt"))


def _images(data: Entry, name: str) -> dict[Id, Entry]:
    """Index the checked entries of images by their ids, each with its `file_name`."""
    images = _by_id(data, "images", name, {"width": _SIDE, "height": _SIDE, ABSENT: _IDS, PARTIAL: _IDS})
    for image in images.values():
        # LVIS names images by their addresses alone.
        if image.get("file_name") is None and isinstance(image.get("coco_url"), str):
            image["file_name"] = PurePosixPath(image["coco_url"]).name
    _checked(data, "images", name, {"file_name": _NAME})
    return images


class _Field(NamedTuple):
    """What the value of a field has to be: a test of it, and the same in words."""

    accepts: Callable[[object], object]
    expected: str


def _is_id(value: object) -> bool:
    return _is_whole(value) or (isinstance(value, str) and is_plain(value))


def _are_ids(value: object) -> bool:
    return value is None or (isinstance(value, list) and all(map(_is_id, value)))


def _id_text(value: float | str) -> str:
    """Write an id as a text, so that 7, 7.0 and "7" are the same."""
    return str(_plain_id(value))


def _by_text(ids: Iterable[Id]) -> dict[str, Id]:
    """Index ids, which are of one kind, by their texts: some files have them as numbers in one place alone."""
    return {str(number): number for number in ids}


def _reference(ids: Mapping[str, Id], expected: str) -> _Field:
    """Return what a field has to be that names one of some ids."""
    return _Field(lambda value: _is_id(value) and _id_text(cast(float | str, value)) in ids, expected)


def _is_name(value: object) -> bool:
    return isinstance(value, str) and bool(value) and is_plain(value)


def _is_side(value: object) -> bool:
    if value is None:
        return True
    return _is_whole(value) and 1 <= cast(float, value) <= _LARGEST


def _is_box(value: object) -> bool:
    if not isinstance(value, list) or len(value) != 4:
        return False
    return all(map(is_number, value)) and min(value[2:]) >= 0


_ID = _Field(_is_id, "an integer or a string without control characters")
_IDS = _Field(_are_ids, "a list of ids of categories")
_NAME = _Field(_is_name, "a string without control characters")
_SIDE = _Field(_is_side, "a whole number of pixels")
_BOX = _Field(_is_box, "[x, y, width, height] with finite numbers and a size of at least 0")
_CROWD = _Field(lambda value: value is None or value in (0, 1), "0 or 1")
_REMEDY = "correct or replace the file"


def _checked(data: Entry, key: str, name: str, fields: Mapping[str, _Field]) -> list[Entry]:
    """List the entries of the file under a key; raises `DataError` unless their fields are as expected."""
    entries = data.get(key)
    if not isinstance(entries, list):
        raise DataError(f"{name}: expected {key} to be a list, got {_shown(data, key)}; {_REMEDY}")
    for place, entry in enumerate(entries):
        fault = _fault_of(entry, fields)
        if fault is not None:
            raise DataError(f"{name}: {key}[{place}]: {fault}; {_REMEDY}")
    return entries


def _fault_of(entry: object, fields: Mapping[str, _Field]) -> str | None:
    """Say which field of an entry is not as expected; None if all are. Numbers in texts take their place."""
    if not isinstance(entry, dict):
        return f"expected an object, got {excerpt(entry)}"
    # There are many entries, so that the message is made where it is needed.
    for field, (accepts, expected) in fields.items():
        value = entry.get(field)
        if accepts(value):
            continue
        numbers = _numbers_of(value)
        if not accepts(numbers):
            return f"expected {field} to be {expected}, got {_shown(entry, field)}"
        entry[field] = numbers
    return None


def _numbers_of(value: object) -> object:
    """Read a number, or a list of them, from texts, as programs that read tables write them; other values stay."""
    if isinstance(value, list):
        return [_number_of(item) for item in value]
    return _number_of(value)


def _number_of(value: object) -> object:
    """Read a number that is written as a text; another value stays."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _by_id(data: Entry, key: str, name: str, fields: Mapping[str, _Field]) -> dict[Id, Entry]:
    """Index the checked entries under a key by their ids, which are unique."""
    entries: dict[Id, Entry] = {}
    for place, entry in enumerate(_checked(data, key, name, {"id": _ID, **fields})):
        if entry["id"] in entries:
            fault = f"expected unique ids, got id {_shown(entry, 'id')} more than once; {_REMEDY}"
            raise DataError(f"{name}: {key}[{place}]: {fault}")
        entries[_plain_id(entry["id"])] = entry
    return entries


def _check_one_kind(ids: Collection[Id], where: str) -> None:
    """Raise `DataError` for ids of which some are numbers and others are strings, which have no order."""
    kinds = {type(number) for number in ids}
    check_data(len(kinds) < 2, where, "ids of one kind", f"integers and strings; {_REMEDY}")


def _is_whole(value: object) -> bool:
    """Tell whether a number is whole, also as tables with gaps write it, 7.0."""
    return type(value) is int or (type(value) is float and value.is_integer())


def _plain_id(value: float | str) -> Id:
    """Convert an id that is a number to an integer, so that 7.0 is 7."""
    return int(value) if isinstance(value, float) else value


def _shown(entry: Entry, key: str) -> str:
    return excerpt(entry[key]) if key in entry else "nothing"


def warn_of_form(boxes: torch.Tensor, limits: torch.Tensor, path: object, *, stacklevel: int = 3) -> None:
    """Warn of boxes that look like no `[x, y, width, height]` in pixels.

    Args:
        boxes: `(N, 4)`, as the file has them.
        limits: `(N, 4)`, width and height of the picture of each box, twice.
        path: the file, for the message.
        stacklevel: as for `warnings.warn`.
    """
    form = _other_form(boxes, limits) if len(boxes) else None
    if form is not None:
        text = f"{path}: bbox is [x, y, width, height] in pixels, and these look like {form}"
        warnings.warn(text, stacklevel=stacklevel)


def _other_form(boxes: torch.Tensor, limits: torch.Tensor) -> str | None:
    """Say what boxes look like that are no `[x, y, width, height]` in pixels; arguments as for `warn_of_form`."""
    # A picture of one or two pixels may have such boxes in pixels.
    if float(boxes.max()) <= 1 and float(limits.min()) > 2:
        return "fractions of the picture"
    first = boxes[:, :2]  # x and y
    last = boxes[:, 2:]  # width and height, or the lower right corner
    size = limits[:, 2:]
    are_corners = bool(((last > first) & (last <= size + 1)).all())
    leaves_picture = (first + last > size + 1).any(-1)  # (N,)
    # A few boxes leave their pictures in good files, too.
    if are_corners and float(leaves_picture.double().mean()) >= _BEYOND:
        return "corners [x1, y1, x2, y2]"
    return None
