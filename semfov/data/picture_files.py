"""Files of pictures in a folder: which of them are looked at, and warnings of those that are left out."""

import warnings
from collections.abc import Sequence, Set
from pathlib import Path

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
        _warn_of_links(source, [path for path in entries if path.is_symlink() and path.is_dir()])
    photographs(visible, str(source))  # warns of the other files
    _warn_of_mosaics(source)
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


def _warn_of_links(source: Path, folders: Sequence[Path]) -> None:
    """Warn of folders behind symbolic links, which are not searched: they may lead back, or to another disk."""
    if not folders:
        return
    name = printable(str(min(folders)))
    text = f"{len(folders)} folders behind symbolic links, such as {name}, are left out; name them"
    if len(folders) == 1:
        text = f"1 folder behind a symbolic link, {name}, is left out; name it"
    warnings.warn(f"{source}: {text}, to look there", stacklevel=3)


def _is_hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def _warn_of_mosaics(folder: Path) -> None:
    """Warn of mosaics in a folder, which are left out."""
    mosaics = [path.name for path in folder.iterdir() if path.suffix.lower() == ".vrt"]
    if mosaics:
        remedy = "as their files are there, too; name them to look at them"
        warnings.warn(f"{folder}: {len(mosaics)} mosaics, such as {mosaics[0]!a}, are left out, {remedy}", stacklevel=3)


def _of_others(files: Sequence[Path], source: Path) -> list[Path]:
    """Drop the figures and crops that semfov has written, with a warning."""
    written = [path for path in files if _is_made_here(path)]
    if written:
        name = printable(str(written[0]))
        pictures = f"{len(written)} pictures that semfov has written"
        text = f"{pictures}, such as {name}, are left out; name them, or their folder"
        if len(written) == 1:
            text = f"1 picture that semfov has written, {name}, is left out; name it or its folder"
        warnings.warn(f"{source}: {text}, to look there", stacklevel=3)
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
    if foreign_files:
        warnings.warn(f"{where}: {_without_foreign(foreign_files)}", stacklevel=3)
    return [path for path in paths if path not in foreign_files]


def _without_foreign(files: Set[Path]) -> str:
    """Write that files are left out, as they are no photographs."""
    name = printable(min(files).name)
    text = f"{len(files)} files are no photographs and are left out, such as {name}"
    if len(files) == 1:
        text = f"1 file is no photograph and is left out, {name}"
    # `search`, `find` and `explore` take photographs alone.
    has_videos = any(path.suffix.lower() in VIDEOS for path in files)
    return f"{text}; `semfov live` takes videos" if has_videos else text
