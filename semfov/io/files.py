"""Atomic writes, checksums and checks of paths."""

import errno
import hashlib
import json
import os
import re
import secrets
import stat
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from semfov.errors import DataError, check, check_data, reason_of

_PART = re.compile(r"\..+\.[0-9a-f]{8}\.part")
_ABANDONED = 24 * 3600.0  # seconds after which a part of a file is taken for one whose writer was killed

_unfinished: set[Path] = set()

MADE_HERE = "made by semfov"
"""Comment in the first bytes of the pictures that semfov writes, by which they are told from photographs."""


def cache_folder() -> Path:
    """Name the folder of downloads, stores and digests: `$SEMFOV_CACHE`, else the platform's cache folder for semfov.

    Returns:
        The folder, which need not exist.

    Raises:
        DataError: `$SEMFOV_CACHE` is no name of a folder.
    """
    from platformdirs import user_cache_dir

    chosen = os.environ.get("SEMFOV_CACHE")
    try:
        folder = Path(chosen or user_cache_dir("semfov")).expanduser()
        is_usable = folder.is_dir() or not folder.exists()
    except (OSError, RuntimeError, ValueError) as error:  # a name that is too long, or the home of nobody
        raise DataError(f"SEMFOV_CACHE: expected a folder for downloads, got {chosen!r} ({error})") from None
    check_data(is_usable, "SEMFOV_CACHE", "a folder for downloads", f"the file {folder}")
    return folder


def discard_unfinished() -> None:
    """Remove temporary files of unfinished writes, for a process that is about to exit without cleaning up."""
    for path in list(_unfinished):
        with suppress(OSError):
            path.unlink()


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write a file atomically: a context manager that replaces `path` once its block has ended without an error.

    The new file has the permissions of the one that it replaces, or those that the process gives new files. Behind a
    symbolic link the file is replaced that it points to.

    Args:
        path: the file.

    Yields:
        A temporary file beside it, to be written in the block.

    Raises:
        DataError: it cannot be written.
    """
    path = Path(path)
    check_data(bool(path.name), f"cannot write {str(path)!r}", "the name of a file", "none")
    target = Path(os.path.realpath(path)) if os.path.islink(path) else path
    temporary = _beside(target, f"{secrets.token_hex(4)}.part")
    try:
        mode = _mode_of(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        _sweep(target.parent.resolve())
        # Known before it exists: a signal may end the process while the file is created.
        _unfinished.add(temporary)
        if mode is None:
            temporary.touch(exist_ok=False)  # with the umask of the process
            mode = _mode_of(temporary)
        else:
            temporary.touch(0o600, exist_ok=False)
        yield temporary
        # The content is on the disk before the name is: else a loss of power could leave an empty file.
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        if mode is not None and _mode_of(temporary) != mode:  # some file systems refuse to change it
            temporary.chmod(mode)
        temporary.replace(target)
    except OSError as error:
        raise DataError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            temporary.chmod(0o600)  # Windows removes no file that may only be read
            temporary.unlink()
        _unfinished.discard(temporary)


def _mode_of(path: Path) -> int | None:
    """Read the permissions of a file; None where there is none."""
    try:
        return stat.S_IMODE(path.stat().st_mode)
    except FileNotFoundError:
        return None


def _beside(path: Path, end: str) -> Path:
    """Name a hidden file beside another one, with as much of its name as every file system has room for."""
    start = path.name.encode(errors="ignore")[:120].decode(errors="ignore")
    return path.with_name(f".{start}.{end}")


def disk_is_full(error: BaseException) -> bool:
    """Tell whether an error, or one of its causes, is that of a full disk, on which no file can be written any more.

    Args:
        error: the error.

    Returns:
        Whether it is.
    """
    import sqlite3

    chain: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None and cause not in chain:  # causes may go in a circle
        chain.append(cause)
        cause = cause.__cause__
    numbers = {link.errno for link in chain if isinstance(link, OSError)}
    codes = {getattr(link, "sqlite_errorcode", None) for link in chain if isinstance(link, sqlite3.Error)}
    return not numbers.isdisjoint((errno.ENOSPC, errno.EDQUOT)) or sqlite3.SQLITE_FULL in codes


@contextmanager
def written_alone(files: Iterable[Path] = (), folders: Iterable[Path] = ()) -> Iterator[None]:
    """Hold files, and folders of files, in a block, so that no other command writes them.

    Args:
        files: the files.
        folders: the folders.

    Raises:
        DataError: another command holds one of them, or it cannot be written.
    """
    places = {_beside(path, f"{json_sha256(path.name)[:8]}.lock"): path for path in map(Path.resolve, files)}
    places |= {folder / ".lock": folder for folder in map(Path.resolve, folders)}
    with ExitStack() as held:
        for place, path in places.items():
            held.enter_context(_locked(place, path))
        yield


@contextmanager
def _locked(place: Path, path: Path) -> Iterator[None]:
    """Hold a lock of the system, which lets go of it when the process ends in any way; what is left holds nobody up."""
    from filelock import FileLock, Timeout

    lock = FileLock(place)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except Timeout:
        remedy = "wait until it has ended, or name another"
        raise DataError(f"cannot write {path}: another command is writing it; {remedy}") from None
    except OSError as error:
        raise DataError(f"cannot write {path}: {error.strerror or error}") from error
    try:
        yield
    finally:
        # While it is held: a process that has opened it meanwhile sees that it is gone, and makes another one.
        with suppress(OSError):
            place.unlink()
        lock.release()


@cache
def _sweep(folder: Path) -> None:
    """Remove old parts from a folder, once in each process: a writer that was killed could not."""
    oldest = time.time() - _ABANDONED
    with suppress(OSError), os.scandir(folder) as entries:
        for part in entries:
            if _PART.fullmatch(part.name):
                _remove_older(part, oldest)


def _remove_older(file: os.DirEntry[str], time_of_change: float) -> None:
    """Remove a file that was last changed before some time; one that another process removes meanwhile is gone."""
    with suppress(OSError):
        if file.stat(follow_symlinks=False).st_mtime < time_of_change:
            Path(file.path).unlink()


def inside(folder: str | os.PathLike[str], name: str, *, links: bool = False) -> Path:
    """Join a folder and a name from elsewhere.

    Args:
        folder: the folder.
        name: name of a file in it.
        links: whether a link in the folder may lead out of it.

    Returns:
        The path.

    Raises:
        DataError: the name leads out of the folder.
    """
    folder = Path(folder)
    try:
        path = folder / name
        target = path.resolve()
        resolved_folder = folder.resolve()
    except (OSError, ValueError, RuntimeError):  # no name of a file, or links in a circle
        target = resolved_folder = folder
    name_stays_inside = not Path(name).anchor and ".." not in Path(name).parts
    is_inside = target.is_relative_to(resolved_folder) or (links and name_stays_inside)
    is_other = target != resolved_folder
    check_data(is_inside and is_other, folder, "the name of a file in this folder", f"{name!a}, which leads out of it")
    return path


def is_pattern(name: str) -> bool:
    """Tell whether a name is a pattern of names, and not a file with brackets in its name: a[1].jpg, as of a copy."""
    return bool(set(name) & set("*?[")) and not os.path.lexists(name)


def plain_name(text: str) -> str:
    """Make a text a name that is valid on every file system.

    >>> plain_name("my cup, frame 3"), plain_name("../..")
    ('my-cup-frame-3', 'none')
    """
    return re.sub(r"[^\w.]+|\.\.+", "-", text)[:200].strip("-.")[:60] or "none"


def check_regular(path: str | os.PathLike[str], name: str | None = None) -> None:
    """Check that a path that exists is a regular file, because reading a pipe or a device might never end.

    Args:
        path: the path.
        name: its name in messages; None for the path.

    Raises:
        DataError: it is none.
    """
    name = ascii(str(path))[1:-1] if name is None else name
    try:
        mode = Path(path).stat().st_mode
    except ValueError:
        raise DataError(f"{name}: not the name of a file") from None
    except OSError:
        return
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    check_data(stat.S_ISREG(mode), name, "a file", kinds.get(stat.S_IFMT(mode), "a device"))


def check_writable(path: Path | None, *, folder: bool = False) -> None:
    """Check that a file can be written later, without making anything now.

    Args:
        path: the file, or with `folder` the folder of files; None for nothing.
        folder: whether it is a folder.

    Raises:
        DataError: it cannot.
    """
    if path is None:
        return
    path = Path(os.path.realpath(path))  # behind a link the file is written that it points to
    place = next((ancestor for ancestor in (path, *path.parents) if ancestor.exists()), Path())
    if place == path and not folder:
        check_regular(path)
        place = path.parent
    if not place.is_dir():
        raise DataError(f"cannot write {path}: {place} is not a folder")
    if not os.access(place, os.W_OK | os.X_OK):
        raise DataError(f"cannot write {path}: no permission to write in {place}")


def check_apart(path: Path | None, files: Iterable[Path | None]) -> None:
    """Raise `InputError` where what is written would take the place of a file that is read.

    Args:
        path: what is written, as the option `out` says; None for nothing.
        files: the files that are read; None is left out.
    """
    if path is None or not path.is_file():
        return
    for file in files:
        if file is not None and file.is_file():
            check(not file.samefile(path), "out", "a file other than the one that is looked at", path)


@contextmanager
def reading(path: str | os.PathLike[str], name: str | None = None) -> Iterator[None]:
    """Read a file in a block.

    Args:
        path: the file.
        name: its name in messages; None for the path.

    Raises:
        DataError: it is not there, is no regular one, or cannot be read.
    """
    check_regular(path, name)
    label = name or path
    try:
        yield
    except FileNotFoundError:
        raise DataError(f"{label}: no such file; check the path") from None
    except OSError as error:
        raise DataError(f"{label}: cannot be read ({error.strerror or error})") from None


def read_bytes(path: str | os.PathLike[str], *, most: int | None = None, name: str | None = None) -> bytes:
    """Read the content of a file.

    Args:
        path: the file.
        most: largest number of bytes; None for any.
        name: its name in messages; None for the path.

    Returns:
        The content.

    Raises:
        DataError: it cannot be read, or is larger.
    """
    with reading(path, name):
        if most is not None:
            size = Path(path).stat().st_size
            check_data(size <= most, name or path, f"at most {most:,} bytes", f"{size:,}")
        return Path(path).read_bytes()


def read_text(path: str | os.PathLike[str], otherwise: str | None = None, *, most: int | None = None) -> str:
    """Read a text in UTF-8, UTF-16 or UTF-32, with a byte order mark or without.

    Args:
        path: the file.
        otherwise: encoding of a file in none of these; None refuses it.
        most: largest number of bytes; None for any.

    Returns:
        The text.

    Raises:
        DataError: it cannot be read, is larger, or is no text.
    """
    text, _ = read_encoded(path, otherwise, most=most)
    return text


def read_encoded(
    path: str | os.PathLike[str], otherwise: str | None = None, *, most: int | None = None
) -> tuple[str, str]:
    """Read a text as `read_text` does, and name its encoding.

    Args:
        path: the file.
        otherwise: encoding of a file that is in none of those of Unicode; None refuses it.
        most: largest number of bytes; None for any.

    Returns:
        The text, and the encoding in which it was read, such as `utf-8`.

    Raises:
        DataError: it cannot be read, is larger, or is no text.
    """
    content = read_bytes(path, most=most)
    encoding = _encoding(content)
    try:
        return content.decode(encoding), encoding
    except UnicodeDecodeError as error:
        if otherwise is None:
            raise DataError(f"{path}: expected a file of text, got other bytes ({error}); save it as UTF-8") from None
        return content.decode(otherwise, "replace"), otherwise


JsonObject = dict[str, Any]
"""An object of JSON: values of JSON by name."""


def read_json(
    path: str | os.PathLike[str], *, most: int | None = None, name: str | None = None, unique: bool = False
) -> Any:
    """Read a file of JSON.

    Args:
        path: the file.
        most: largest number of bytes; None for any.
        name: its name in messages; None for the path.
        unique: refuse objects in which a name stands twice, of which Python keeps the last value alone.

    Returns:
        The value.

    Raises:
        DataError: it cannot be read, is larger, or is no JSON, or a name stands twice where it may not.
    """
    try:
        content = read_bytes(path, most=most, name=name)
        return json.loads(content, object_pairs_hook=_with_unique_names if unique else None)
    except (ValueError, RecursionError) as error:  # also numbers too long and lists too deep
        reason = reason_of(error)
        raise DataError(f"{name or path}: cannot be read as JSON ({reason}); correct or replace the file") from None


def _with_unique_names(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """Make an object of JSON from its names and values; raises `ValueError` for a name that stands twice."""
    values = dict(pairs)
    if len(values) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        twice = next(name for name, count in counts.items() if count > 1)
        raise ValueError(f"{twice!r} stands in it twice")
    return values


def _encoding(content: bytes) -> str:
    """Guess the encoding of a text by its byte order mark; without one, by the places of its zeros."""
    by_start = json.detect_encoding(content)
    has_mark = by_start in ("utf-8-sig", "utf-16", "utf-32")
    has_few_zeros = content.count(0) <= len(content) / 16
    if has_mark or has_few_zeros:
        return by_start
    # Digits, commas and Latin letters fill one byte of a character's two or four; the others are zeros. The most
    # significant byte is the first one in big-endian order (be), the last one in little-endian order (le).
    first, second, third, fourth = (content[place::4].count(0) for place in range(4))
    all_but_few = 0.9 * (len(content) // 4)
    if min(first, second) > all_but_few:
        return "utf-32-be"
    if min(third, fourth) > all_but_few:
        return "utf-32-le"
    return "utf-16-be" if first + third > second + fourth else "utf-16-le"


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file atomically in UTF-8.

    Args:
        path: the file.
        text: its content.

    Raises:
        DataError: it cannot be written.
    """
    write_bytes(path, text.encode())


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file atomically.

    Args:
        path: the file.
        content: its content.

    Raises:
        DataError: it cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def sha256(path: str | os.PathLike[str], name: str | None = None) -> str:
    """Compute the sha256 of a file's content.

    Args:
        path: the file.
        name: its name in messages; None for the path.

    Returns:
        Hexadecimal digits.

    Raises:
        DataError: it cannot be read.
    """
    with reading(path, name), Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_sha256(value: object) -> str:
    """Compute the sha256 of a value in JSON.

    Args:
        value: the value.

    Returns:
        Hexadecimal digits.
    """
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()
