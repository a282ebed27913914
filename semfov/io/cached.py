"""A cache of tensors on disk; an entry that is damaged or belongs to other inputs counts as missing."""

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from semfov.io.schema import Schema
from semfov.io.storage import read, write_file

_KIND = "cached-tensors"


def write_tensors(path: Path, key: str, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors atomically, with a checksum, the key of the inputs they depend on, and the name of their file."""
    write_file(path, tensors, {"kind": _KIND, "key": key, "file": path.name})


def read_tensors(path: Path, key: str, schema: Schema | None = None) -> dict[str, Tensor] | None:
    """Read the tensors that `write_tensors` wrote to this file under this key.

    A file that was written under another key or another file name (for another scene, for instance) counts as missing.
    So does a file that does not fit the schema.

    Args:
        path: the file.
        key: key of the inputs that the tensors depend on.
        schema: what the file must hold; None accepts anything.

    Returns:
        The tensors by name, or None where they are missing or damaged.
    """
    try:
        tensors, record = read(path, _KIND)
        if schema is not None:
            schema.check(tensors)
    except Exception:  # whatever is wrong with the file, its tensors can be computed again
        return None
    return tensors if (record.get("key"), record.get("file")) == (key, path.name) else None
