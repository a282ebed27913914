"""Subcommand check: says what is suspicious in files of fixations."""

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from semfov.cli.options import CheckOptions
from semfov.data.fixations import Fixations
from semfov.data.large import picture_size
from semfov.data.sources import PHOTOGRAPHS, picture_files
from semfov.errors import DataError, SemfovError, check, printable
from semfov.human.density_check import suspicions_by_content
from semfov.human.fixations.reading import DATA_SETS, frame_of, read_by, reader_of
from semfov.human.fixations.suspicions import other_frame_of, suspicions
from semfov.human.fixations.table import FrameError, PictureError, read_table

_FRAMES_NAMED = 3  # largest number of sizes of frames that are named


class _PictureSizes(Mapping[str, tuple[int, int]]):
    """`(width, height)` of a picture or those in a folder, by names as tables have them: with any path and ending."""

    def __init__(self, folder: Path, keep: Callable[[Path], bool] | None = None) -> None:
        self._files: dict[str, Path] = {}
        for path in filter(keep, picture_files(folder, recursive=True)):
            for name in (path.stem, path.name, path.relative_to(folder).as_posix()):
                self._files[name.lower()] = path
        self._sizes: dict[Path, tuple[int, int]] = {}

    def path(self, name: str) -> Path:
        """Find the file of a picture by its name; `KeyError` where there is none."""
        parts = name.lower().replace("\\", "/").split("/")
        # A table may have other folders before the name than there are here, or no ending.
        candidates = [*("/".join(parts[first:]) for first in range(len(parts))), Path(parts[-1]).stem]
        path = next((self._files[candidate] for candidate in candidates if candidate in self._files), None)
        if path is None:
            raise KeyError(name)
        return path

    def __getitem__(self, name: str) -> tuple[int, int]:
        path = self.path(name)
        if path not in self._sizes:
            self._sizes[path] = picture_size(path)
        return self._sizes[path]

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


def check_fixations(options: CheckOptions) -> int:
    """Print what is in files of fixations, and what is suspicious.

    Args:
        options: the files, and what they do not tell themselves.

    Returns:
        The exit code, 1 if anything is suspicious or a file cannot be read.
    """
    check(len(options.files) > 0, "file", "a file of fixations, such as people.csv", "none")
    arguments = _reading_arguments(options)
    sizes = _sizes(options)
    wrong = False
    for name in options.files:
        try:
            report = _report(Path(name), options, arguments, sizes)
        except SemfovError as error:
            if len(options.files) == 1:
                raise
            print(f"{printable(name)}: cannot be read: {error}")
            wrong = True
        else:
            print(f"{printable(name)}: {report.content}")
            print(*(f"  {line}" for line in report.lines), sep="\n")
            wrong |= len(report.suspicious) > 0
    return int(wrong)


def _reading_arguments(options: CheckOptions) -> dict[str, Any]:
    """Take the arguments of the readers of fixations that are given: `size`, `picture`, `subject` and `columns`."""
    arguments: dict[str, Any] = {}
    if options.size is not None:
        arguments["size"] = frame_of(options.size)
    if options.picture is not None and not Path(options.picture).is_dir():  # a folder is no picture's name
        arguments["picture"] = options.picture
    if options.subject is not None:
        arguments["subject"] = options.subject
    if options.columns is not None:
        arguments["columns"] = _columns_of(options.columns)
    return arguments


def _columns_of(text: str) -> dict[str, str]:
    """Read the file's names of columns by ours: `x=FPOGX,y=FPOGY`."""
    columns = {}
    for pair in text.split(","):
        ours, _, theirs = (word.strip() for word in pair.partition("="))
        check(bool(theirs), "columns", f"the file's name of {ours}, as in x=FPOGX,y=FPOGY", "none")
        columns[ours] = theirs
    return columns


def _shows_pictures(place: Path) -> bool:
    """Tell whether a place is a folder of pictures or a photograph; otherwise it is the name of a picture."""
    return place.is_dir() or (place.is_file() and place.suffix.lower() in PHOTOGRAPHS)


class FixationReport(NamedTuple):
    """What is in a file of fixations.

    Attributes:
        content: what it holds, in a line.
        suspicious: what is suspicious, a line each.
        was_compared: whether frames were compared with pictures.
    """

    content: str
    suspicious: list[str]
    was_compared: bool

    @property
    def lines(self) -> list[str]:
        """What is suspicious, a line each, or that nothing is."""
        if self.suspicious:
            return [f"suspicious: {line}" for line in self.suspicious]
        not_compared = "" if self.was_compared else "; frames were not compared with pictures (--picture FOLDER)"
        return [f"nothing is suspicious{not_compared}"]


def fixation_report(path: Path, options: CheckOptions, keep: Callable[[Path], bool] | None = None) -> FixationReport:
    """Read one file of fixations, and say what is suspicious.

    Args:
        path: the file.
        options: what the file does not tell itself; its `files` are not read.
        keep: whether a picture of the folder may be opened; None for all of them.

    Returns:
        The report.

    Raises:
        SemfovError: the file cannot be read.
    """
    return _report(path, options, _reading_arguments(options), _sizes(options, keep))


def _sizes(options: CheckOptions, keep: Callable[[Path], bool] | None = None) -> _PictureSizes | None:
    """Find the sizes of the pictures that the options name; None where they name none."""
    place = None if options.picture is None else Path(options.picture)
    return _PictureSizes(place, keep) if place is not None and _shows_pictures(place) else None


def _report(
    path: Path, options: CheckOptions, arguments: dict[str, Any], sizes: _PictureSizes | None
) -> FixationReport:
    """Read one file of fixations, and say what is suspicious.

    Args:
        path: the file.
        options: what the file does not tell itself.
        arguments: the same, as arguments of a reader.
        sizes: sizes of the pictures; None where there are none.

    Returns:
        The report.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what the lines below say
        warnings.filterwarnings("always", message=".*(is not UTF-8|is not read)")  # which they do not say
        reader = reader_of(path, arguments.get("columns"))
        records = _records(reader, path, arguments, sizes)
    if sizes is not None and "picture" in arguments:  # a single one is compared with what was looked at in it
        records = [record for record in records if record.picture in sizes] or records
    suspicious = suspicions(records, sizes)
    if sizes is not None and records and not options.rules_alone:
        # Where points look like those of another frame or unit, that is said by the rules alone, in one way.
        is_own_frame = other_frame_of(records) is None
        if is_own_frame:
            suspicious += suspicions_by_content(records, sizes.path, sizes, quiet=options.quiet)
    data_set = DATA_SETS.get(reader)
    usual_frames = ""
    if data_set in ("OSIE", "COCO-Search18") and "size" not in arguments:
        usual_frames = f" (those of {data_set}, or give --size)"
    return FixationReport(_content(records, usual_frames), suspicious, was_compared=sizes is not None)


def _records(
    reader: Callable[..., list[Fixations]], path: Path, arguments: dict[str, Any], sizes: _PictureSizes | None
) -> list[Fixations]:
    """Read the records of a file; where it has no frames, they are the pictures."""
    unnamed = {name: value for name, value in arguments.items() if name != "picture"}
    names_pictures = reader is read_table or "picture" not in signature(reader).parameters
    if "picture" in arguments and (names_pictures or sizes is not None):
        # A photograph may be one of those that the file names; any other name is for a file that names none.
        with suppress(PictureError):
            records = _records(reader, path, unnamed, sizes)
            is_used = sizes is not None or not names_pictures
            check(is_used, "picture", "a picture or folder that exists", arguments["picture"])
            return records
    try:
        return read_by(reader, path, arguments)
    except FrameError as error:
        if sizes is None:
            raise DataError(f"{error}, or give its pictures by --picture FOLDER") from None
        return read_by(reader, path, {**arguments, "size": sizes})


def _content(records: list[Fixations], usual: str) -> str:
    """Say what is in the records, in a line; `usual` is said of frames that the file does not tell."""
    if not records:
        return "no fixations"
    people = {record.subject for record in records}
    pictures = {record.picture for record in records}
    words = [
        _counted(sum(map(len, records)), "fixation", "fixations"),
        _counted(len(records), "scanpath", "scanpaths"),
        _counted(len(people), "person", "people"),
        _counted(len(pictures), "picture", "pictures"),
    ]
    sizes = sorted({record.size for record in records})
    frames = ", ".join(f"{width} × {height}" for width, height in sizes[:_FRAMES_NAMED])
    more = ", …" if len(sizes) > _FRAMES_NAMED else ""
    times = [record.durations for record in records if record.durations is not None]
    lasting = f"they take {np.median(np.concatenate(times)):g} ms in the median" if times else "without durations"
    return f"{', '.join(words)}, frames of {frames}{more}{usual}; {lasting}"


def _counted(number: int, one: str, several: str) -> str:
    """Write a number of things in words."""
    return f"{number} {one if number == 1 else several}"
