"""Files of pictures in a folder: which of them are looked at, and warnings of those that are left out."""

import warnings
from collections.abc import Collection, Sequence
from pathlib import Path

from semfov.data.classes import amount
from semfov.errors import DataError, printable
from semfov.io.files import MADE_HERE

PHOTOGRAPHS = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".png", ".apng", ".webp", ".avif", ".avifs", ".heic", ".heif", ".hif"),
    *(".bmp", ".dib", ".tif", ".tiff", ".gif", ".jp2", ".j2k", ".jpc", ".jpf", ".jpx", ".j2c"),
    *(".ppm", ".pgm", ".pbm", ".pnm", ".pfm"),
)
"""Ends of the names of photographs."""

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")
"""Ends of the names of videos."""

_HEAD = 4096  # bytes, in which the comment of a picture is
_NAMED = 3  # largest number of files that a warning names


def picture_files(source: Path, *, recursive: bool = False, frames: bool = False) -> list[Path]:
    """List the photographs of a source, in the order of their names.

    Args:
        source: a file, which is taken whatever its name, or a folder.
        recursive: whether folders in it are searched, too; pictures that semfov has written there are left out.
        frames: whether they are the frames of a stream, for the message.

    Returns:
        The files.

    Raises:
        DataError: there are none.
    """
    if not source.exists() and not source.is_symlink():  # a link to nothing is one that cannot be read
        raise DataError(f"picture: no such file or folder: {source}; check the path")
    if not source.is_dir():
        return [source]
    entries = _visible_entries(source, recursive=recursive)
    visible = [path for path in entries if not path.is_dir()]
    files = sorted(path for path in visible if path.suffix.lower() in PHOTOGRAPHS)
    if recursive:
        files = _of_others(files, source)
        # Folders behind links are not searched: they may lead back, or to another disk.
        linked = [path for path in entries if path.is_symlink() and path.is_dir()]
        _warn_of_omitted(source, linked, "folder", "behind symbolic links (looked at by name)")
    photographs(visible, str(source))  # warns of the other files
    mosaics = [path for path in source.iterdir() if path.suffix.lower() == ".vrt"]
    _warn_of_omitted(source, mosaics, "mosaic", "whose files are there, too (looked at by name)")
    if not files:
        raise DataError(_without_photographs(source, recursive=recursive, frames=frames))
    return files


def _without_photographs(folder: Path, *, recursive: bool, frames: bool) -> str:
    """Write that a folder has no photographs; the arguments are those of `picture_files`."""
    if frames:
        return f"source: expected frames (.jpg, .png, .tif, …) in {folder}, got none"
    hint = "or in a folder in it" if recursive else "and recursive=True also searches the folders in it"
    return f"picture: expected photographs (.jpg, .png, .tif, …) in {folder}, {hint}, got none"


def _visible_entries(folder: Path, *, recursive: bool) -> list[Path]:
    """List what is in a folder, without names that begin with a dot, such as ._a.jpg, which Apple writes."""
    paths = folder.rglob("*") if recursive else folder.iterdir()
    return [path for path in paths if not _is_hidden(path.relative_to(folder))]


def _warn_of_omitted(where: object, paths: Collection[Path], noun: str, why: str, *, stacklevel: int = 3) -> None:
    """Warn of files or folders that are left out, if there are any, with the names of a few.

    Args:
        where: they are.
        paths: they.
        noun: what each of them is.
        why: they are left out, and what to do.
        stacklevel: the call that the warning points to, as of `warnings.warn`: that of `picture_files`.
    """
    if paths:
        names = printable(", ".join(map(str, sorted(paths)[:_NAMED])))
        few = "such as " if len(paths) > _NAMED else ""
        warnings.warn(f"{where}: {amount(len(paths), noun)} left out, {why}: {few}{names}", stacklevel=stacklevel)


def _is_hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def _of_others(files: Sequence[Path], source: Path) -> list[Path]:
    """Drop the figures and crops that semfov has written, with a warning."""
    written = [path for path in files if _is_made_here(path)]
    _warn_of_omitted(source, written, "picture", "written by semfov (looked at by name)", stacklevel=4)
    return [path for path in files if path not in written]


def _is_made_here(path: Path) -> bool:
    """Tell whether a picture has the comment of those that semfov writes."""
    try:
        if not path.is_file():
            return False  # to open a pipe would wait for its writer
        with path.open("rb") as file:
            return MADE_HERE.encode() in file.read(_HEAD)
    except OSError:
        return False  # it is skipped when it is opened


def photographs(paths: Sequence[Path], where: str) -> list[Path]:
    """Drop files that are no photographs (by suffix), with a warning.

    Args:
        paths: files and folders.
        where: they are, for the message.

    Returns:
        The others, among them folders, mosaics and files without a suffix.
    """
    kinds = {"", ".vrt", *PHOTOGRAPHS}
    foreign_files = {path for path in paths if path.suffix.lower() not in kinds and path.is_file()}
    # `search`, `find` and `explore` take photographs alone.
    has_videos = any(path.suffix.lower() in VIDEOS for path in foreign_files)
    remedy = " (`semfov live` takes videos)" if has_videos else ""
    _warn_of_omitted(where, foreign_files, "file", f"of another kind than photographs{remedy}", stacklevel=4)
    return [path for path in paths if path not in foreign_files]
