"""Tensors on disk that can always be computed again: whole, of the right origin, or not there."""

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from semfov.io.schema import Schema
from semfov.io.storage import read, write

_KIND = "cached-tensors"


def write_tensors(path: Path, key: str, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors atomically, with a checksum, the key of what they depend on, and the name of their file."""
    write(path, tensors, {"kind": _KIND, "key": key, "file": path.name})


def read_tensors(path: Path, key: str, schema: Schema | None = None) -> dict[str, Tensor] | None:
    """Tensors that `write_tensors` wrote to this file under this key; None where they are missing or damaged.

    A file that was written under another key or by another name, such as that of another scene, counts as missing, and
    so does one that holds something else.

    Args:
        path: the file.
        key: of what the tensors depend on.
        schema: what the file must hold.
    """
    try:
        tensors, record = read(path, _KIND)
        if schema is not None:
            schema.check(tensors)
    except Exception:  # whatever is wrong with it, it can be made again
        return None
    return tensors if (record.get("key"), record.get("file")) == (key, path.name) else None
