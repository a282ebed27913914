"""Reading COCO annotation files, with every entry checked before it is used."""

import contextlib
import hashlib
import io
import json
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any

from semfov.errors import DataError
from semfov.io.files import check_regular
from semfov.io.schema import excerpt, is_number, is_plain

_LARGEST = 2**24  # largest side in pixels for which float32 represents every whole pixel


def read_annotations(path: str | PathLike[str]) -> tuple[Any, str]:
    """Read and check a COCO instances file.

    Ids are integers or strings, the same kind for all images. Every image needs `id`, `file_name`, `width` and
    `height`. Every category needs `id` and `name`. Every annotation needs `id`, `image_id`, `category_id` and `bbox` =
    `[x, y, width, height]`, and may have `iscrowd`. Other keys are ignored.

    Args:
        path: the file.

    Returns:
        A `pycocotools.coco.COCO` index, and the sha256 of the file.

    Raises:
        DataError: the file is missing or not JSON, or an entry lacks a key, has a value of the wrong type, repeats an
            id or refers to an id that does not exist.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "instances.json")
    ...     _ = path.write_text('{"images": [], "annotations": [], "categories": []}')
    ...     coco, digest = read_annotations(path)
    >>> coco.getImgIds()
    []
    """
    name = f"annotations {Path(path)}"
    raw = _read(path, name)
    try:
        data = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{name}: not a JSON file ({error}); fetch it again") from None
    if not isinstance(data, dict):
        raise DataError(f"{name}: expected an object with images, annotations and categories, got {_kind(data)}")
    try:
        _check(data)
    except _Fault as fault:
        raise DataError(f"{name}: {fault}; correct or replace the file") from None
    return _index(data), hashlib.sha256(raw).hexdigest()


class _Fault(Exception):
    """An error in an entry; the message describes it."""


def _read(path: str | PathLike[str], name: str) -> bytes:
    check_regular(path, name)
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise DataError(
            f"{name}: no such file; check data.annotations, or fetch COCO with python -m semfov.data.coco"
        ) from None
    except (OSError, ValueError) as error:
        raise DataError(f"{name}: cannot be read ({error})") from None


def _index(data: dict[str, Any]) -> Any:
    from pycocotools.coco import COCO

    coco = COCO()
    coco.dataset = data
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        coco.createIndex()
    return coco


def _check(data: dict[str, Any]) -> None:
    categories = _ids(data, "categories", {"name": str})
    images = _ids(data, "images", {"file_name": str})
    if len({type(i) for i in images}) > 1:
        raise _Fault("images: expected ids of one kind, got integers and strings")
    for where, image in _entries(data, "images"):
        for key in ("width", "height"):
            if not (is_number(image.get(key)) and 1 <= image[key] <= _LARGEST and image[key] == int(image[key])):
                raise _Fault(f"{where}: expected {key} to be a whole number of pixels, got {_show(image, key)}")
    _ids(data, "annotations", {})
    for where, annotation in _entries(data, "annotations"):
        _check_reference(where, annotation, "image_id", images, "images")
        _check_reference(where, annotation, "category_id", categories, "categories")
        box = annotation.get("bbox")
        if not (isinstance(box, list) and len(box) == 4 and all(map(is_number, box)) and min(box[2:]) >= 0):
            raise _Fault(
                f"{where}: expected bbox to be [x, y, width, height] with finite numbers and a size of at least 0, "
                f"got {_show(annotation, 'bbox')}"
            )
        if annotation.get("iscrowd", 0) not in (0, 1):
            raise _Fault(f"{where}: expected iscrowd to be 0 or 1, got {_show(annotation, 'iscrowd')}")


def _entries(data: dict[str, Any], key: str) -> Iterator[tuple[str, dict[str, Any]]]:
    entries = data.get(key)
    if not isinstance(entries, list):
        raise _Fault(f"expected {key} to be a list, got {_kind(entries) if key in data else 'nothing'}")
    for position, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise _Fault(f"{key}[{position}]: expected an object, got {_kind(entry)}")
        yield f"{key}[{position}]", entry


def _ids(data: dict[str, Any], key: str, fields: dict[str, type]) -> set[int | str]:
    """Ids of the entries, checked to be unique; further fields are checked to have their type and not to be empty."""
    ids: set[int | str] = set()
    for where, entry in _entries(data, key):
        identity = entry.get("id")
        if not isinstance(identity, int | str) or isinstance(identity, bool):
            raise _Fault(f"{where}: expected id to be an integer or a string, got {_show(entry, 'id')}")
        if isinstance(identity, str) and not is_plain(identity):
            raise _Fault(f"{where}: expected id to have no control characters, got {_show(entry, 'id')}")
        if identity in ids:
            raise _Fault(f"{where}: expected unique ids, got id {_show(entry, 'id')} more than once")
        ids.add(identity)
        for field, kind in fields.items():
            if not isinstance(entry.get(field), kind) or not entry[field]:
                raise _Fault(f"{where}: expected {field} to be a string, got {_show(entry, field)}")
            if not is_plain(entry[field]):
                raise _Fault(f"{where}: expected {field} to have no control characters, got {_show(entry, field)}")
    return ids


def _check_reference(where: str, entry: dict[str, Any], key: str, ids: set[int | str], what: str) -> None:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int | str) or value not in ids:
        raise _Fault(f"{where}: expected {key} to be the id of one of the {what}, got {_show(entry, key)}")


def _kind(value: object) -> str:
    names = {dict: "an object", list: "a list", str: "a string", type(None): "null"}
    return names.get(type(value), "a number" if is_number(value) else type(value).__name__)


def _show(entry: dict[str, Any], key: str) -> str:
    """A value as error messages print it: on one line and short."""
    return excerpt(entry[key]) if key in entry else "nothing"
