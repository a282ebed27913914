"""Files that are whole or not there: atomic writes and checksums."""

import hashlib
import os
import re
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from semfov.errors import DataError

_unfinished: set[Path] = set()


def discard_unfinished() -> None:
    """Remove what was being written, for a process that is about to leave without coming to its end."""
    for path in list(_unfinished):
        path.unlink(missing_ok=True)


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to, and move it there once the block has ended without error.

    Readers see the old file or the new one, never a part of it; a killed or failed writer leaves `path` alone.

    Raises:
        DataError: the folder cannot be written to or the disk is full (the message names the file).
    """
    path = Path(path)
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        _unfinished.add(temporary)
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        raise DataError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
            _unfinished.discard(temporary)


def inside(folder: str | Path, name: str) -> Path:
    """The path of a file by this name in `folder` or below it.

    Raises:
        DataError: the name leads out of the folder, also through a link.
    """
    folder = Path(folder)
    try:
        path = folder / name
        lies = path.resolve().is_relative_to(folder.resolve()) and path.resolve() != folder.resolve()
    except (OSError, ValueError, RuntimeError):
        lies = False
    if not lies:
        raise DataError(f"{folder}: expected the name of a file in this folder, got {name!a}, which leads out of it")
    return path


def clean(text: str) -> str:
    """Text as a part of a file's name: letters, digits, `_`, `.` and `-`, at most 60 of them, no dot in front.

    >>> clean("dining table"), clean("/../../x/evil"), clean("")
    ('dining-table', 'x-evil', 'none')
    """
    return re.sub(r"[^A-Za-z0-9_.-]+|\.\.+", "-", text)[:200].strip("-.")[:60] or "none"


def check_regular(path: str | os.PathLike[str], name: str | None = None) -> None:
    """Raise `DataError` where `path` is there and is no regular file: a pipe or a device may never end.

    Args:
        path: the file.
        name: what messages call it; None is its path.

    >>> check_regular(__file__)
    """
    name = ascii(str(path))[1:-1] if name is None else name
    try:
        mode = Path(path).stat().st_mode
    except ValueError:
        raise DataError(f"{name}: not the name of a file") from None
    except OSError:
        return
    kinds = {stat.S_ISDIR: "a folder", stat.S_ISFIFO: "a pipe", stat.S_ISSOCK: "a socket"}
    if not stat.S_ISREG(mode):
        got = next((name for is_kind, name in kinds.items() if is_kind(mode)), "a device")
        raise DataError(f"{name}: expected a file, got {got}")


def write_text(path: str | Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def sha256(path: str | Path) -> str:
    """Hexadecimal sha256 of a file's content."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
