"""Subcommand `check`: reports what is suspicious in files of fixations."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from semfov.cli.options import CheckOptions
from semfov.data.classes import amount
from semfov.data.fixations import Fixations
from semfov.data.large import picture_size
from semfov.data.picture_files import PHOTOGRAPHS, picture_files
from semfov.errors import DataError, InputError, SemfovError, check, printable
from semfov.human.density_check import damage_lines, suspicions_by_content
from semfov.human.fixations.reading import DATA_SETS, frame_of, read_by, reader_of
from semfov.human.fixations.suspicions import other_frame_of, suspicions
from semfov.human.fixations.table import FrameError, PictureError, read_table

_Reader = Callable[..., list[Fixations]]

_FRAMES_NAMED = 3  # largest number of sizes of frames that are named
_WITHOUT_FRAMES = ("OSIE", "COCO-Search18")  # data sets whose files need not have the size of their frames


class _PictureSizes(Mapping[str, tuple[int, int]]):
    """`(width, height)` of a picture or those in a folder, by names as tables have them: with any path and ending.

    Attributes:
        damage: why pictures that were asked for have no size, by their files.
    """

    def __init__(self, folder: Path, keep: Callable[[Path], bool] | None = None) -> None:
        self._files: dict[str, Path] = {}
        for path in filter(keep, picture_files(folder, recursive=True)):
            for name in (path.stem, path.name, path.relative_to(folder).as_posix()):
                self._files[name.lower()] = path
        self._sizes: dict[Path, tuple[int, int]] = {}
        self.damage: dict[Path, SemfovError] = {}

    def path(self, name: str) -> Path:
        """Find the file of a picture by its name; `KeyError` where there is none."""
        parts = name.lower().replace("\\", "/").split("/")
        # A table may have other folders before the name than there are here, or no ending.
        candidates = [*("/".join(parts[first:]) for first in range(len(parts))), Path(parts[-1]).stem]
        for candidate in candidates:
            if candidate in self._files:
                return self._files[candidate]
        raise KeyError(name)

    def __getitem__(self, name: str) -> tuple[int, int]:
        path = self.path(name)
        if path not in self._sizes and path not in self.damage:
            try:
                self._sizes[path] = picture_size(path)
            except SemfovError as error:
                self.damage[path] = error
        if path in self.damage:
            raise KeyError(name)
        return self._sizes[path]

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


def check_fixations(options: CheckOptions) -> int:
    """Print what files of fixations contain, and what is suspicious in them.

    Args:
        options: the files, and what they do not say themselves.

    Returns:
        The exit code, 1 if anything is suspicious or a file cannot be read.
    """
    check(len(options.files) > 0, "file", "a file of fixations, such as people.csv", "none")
    reading = _Reading.of(options)
    wrong = False
    for name in options.files:
        try:
            report = reading.report(Path(name))
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
    """Report about a file of fixations: its contents, and what is suspicious.

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
        """Lines of the report: one for each suspicion, or one that says that there is none."""
        if self.suspicious:
            return [f"suspicious: {line}" for line in self.suspicious]
        not_compared = "" if self.was_compared else "; frames were not compared with pictures (--picture FOLDER)"
        return [f"nothing is suspicious{not_compared}"]


def fixation_report(path: Path, options: CheckOptions, keep: Callable[[Path], bool] | None = None) -> FixationReport:
    """Read one file of fixations, and report what is suspicious.

    Args:
        path: the file.
        options: what the file does not tell itself; its `files` are not read.
        keep: whether a picture of the folder may be opened; None for all of them.

    Returns:
        The report.

    Raises:
        SemfovError: the file cannot be read.
    """
    return _Reading.of(options, keep).report(path)


class _FileContent(NamedTuple):
    """What was read of a file.

    Attributes:
        records: the fixations.
        has_frames: whether their frames are those of the file; otherwise they are the pictures.
    """

    records: list[Fixations]
    has_frames: bool = True


class _Reading:
    """What files of fixations do not tell themselves, without their pictures.

    Attributes:
        options: as a command gives them.
        arguments: the same, as arguments of a reader of fixations.
        sizes: sizes of the pictures that the options name; None where they name none.
    """

    def __init__(self, options: CheckOptions, sizes: _PictureSizes | None = None) -> None:
        self.options = options
        self.arguments = _reading_arguments(options)
        self.sizes = sizes

    @staticmethod
    def of(options: CheckOptions, keep: Callable[[Path], bool] | None = None) -> "_Reading":
        """Find the pictures that options name; `keep` tells which of a folder may be opened, None for all."""
        if options.picture is not None and _shows_pictures(Path(options.picture)):
            return _ReadingBesidePictures(options, _PictureSizes(Path(options.picture), keep))
        return _Reading(options)

    def report(self, path: Path) -> FixationReport:
        """Read one file of fixations, and report what is suspicious."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what the lines below say
            warnings.filterwarnings("always", message=".*(is not UTF-8|is not read)")  # which they do not say
            reader = reader_of(path, self.arguments.get("columns"))
            records, has_frames = self._content_of(reader, path)
        lines = [*suspicions(records, self.sizes), *self._suspicions_by_pictures(records)]
        usual_frames = ""
        data_set = DATA_SETS.get(reader)
        if data_set in _WITHOUT_FRAMES and "size" not in self.arguments:
            usual_frames = f" (those of {data_set}, or give --size)"
        if not has_frames:
            usual_frames = " (the pictures, as the file has no frame; if they were shown on a screen, give its --size)"
        return FixationReport(_content(records, usual_frames), lines, was_compared=self.sizes is not None)

    def _suspicions_by_pictures(self, records: Sequence[Fixations]) -> list[str]:
        """Say what is suspicious in fixations beside their pictures, and in these."""
        return []

    def _content_of(self, reader: _Reader, path: Path) -> _FileContent:
        """Read the records of a file; of one picture of several, those that were made in it."""
        # Tables are tried without it first: those of several pictures have a column of their names.
        takes_name = reader is not read_table and "picture" in signature(reader).parameters
        if "picture" not in self.arguments or takes_name:
            return self._in_frames(reader, path, self.arguments)
        return self._of_picture(reader, path)

    def _of_picture(self, reader: _Reader, path: Path) -> _FileContent:
        """Read the records of a file that were made in the picture that the options name."""
        without_picture = {name: value for name, value in self.arguments.items() if name != "picture"}
        try:
            content = self._in_frames(reader, path, without_picture)
        except PictureError:
            # The file names no picture, so this is the one.
            return self._in_frames(reader, path, self.arguments)
        return content._replace(records=self._in_picture(content.records))

    def _in_picture(self, records: list[Fixations]) -> list[Fixations]:
        """Take the records that were made in the picture; raises `InputError` where there is none."""
        picture = self.arguments["picture"]
        raise InputError(f"picture: expected a picture or folder that exists, got {picture}")

    def _in_frames(self, reader: _Reader, path: Path, arguments: dict[str, Any]) -> _FileContent:
        """Read the records of a file; where it has no frames, they are the pictures."""
        try:
            return _FileContent(read_by(reader, path, arguments))
        except FrameError as error:
            raise DataError(f"{error}, or give its pictures by --picture FOLDER") from None


class _ReadingBesidePictures(_Reading):
    """What files of fixations do not tell themselves, with their pictures."""

    sizes: _PictureSizes

    def report(self, path: Path) -> FixationReport:
        self.sizes.damage.clear()  # what is said of a file is of its own pictures
        return super().report(path)

    def _suspicions_by_pictures(self, records: Sequence[Fixations]) -> list[str]:
        damage = damage_lines([*self.sizes.damage.values()])
        # Where points look like those of another frame or unit, that is said by the rules alone, in one way.
        if self.options.rules_alone or not records or other_frame_of(records) is not None:
            return damage
        by_content = suspicions_by_content(records, self.sizes.path, self.sizes, quiet=self.options.quiet)
        return [*damage, *by_content]

    def _content_of(self, reader: _Reader, path: Path) -> _FileContent:
        if "picture" not in self.arguments:
            return self._in_frames(reader, path, self.arguments)
        return self._of_picture(reader, path)

    def _in_picture(self, records: list[Fixations]) -> list[Fixations]:
        # A file with other names is compared as it is, and the report says that their pictures are not there.
        return [record for record in records if record.picture in self.sizes] or records

    def _in_frames(self, reader: _Reader, path: Path, arguments: dict[str, Any]) -> _FileContent:
        try:
            return _FileContent(read_by(reader, path, arguments))
        except FrameError:
            return _FileContent(_read_in_pictures(reader, path, arguments, self.sizes), has_frames=False)


def _read_in_pictures(
    reader: _Reader, path: Path, arguments: Mapping[str, object], sizes: _PictureSizes
) -> list[Fixations]:
    """Read the records of a file whose frames are its pictures; raises `DataError` where one cannot be opened."""
    try:
        return read_by(reader, path, {**arguments, "size": sizes})
    except InputError:
        if not sizes.damage:
            raise
        damage = next(iter(sizes.damage.values()))
        raise DataError(f"{damage}; or leave out the lines of this picture, or give --size") from None


def _content(records: list[Fixations], usual: str) -> str:
    """Say what is in the records, in a line; `usual` is said of frames that the file does not tell."""
    if not records:
        return "no fixations"
    counts = {
        "fixation": sum(map(len, records)),
        "scanpath": len(records),
        "person": len({record.subject for record in records}),
        "picture": len({record.picture for record in records}),
    }
    amounts = ", ".join(amount(count, noun) for noun, count in counts.items())
    return f"{amounts}, frames of {_frames_text(records)}{usual}; {_durations_text(records)}"


def _frames_text(records: Sequence[Fixations]) -> str:
    """List the sizes of the frames, of many the smallest."""
    sizes = sorted({record.size for record in records})
    texts = [f"{width} × {height}" for width, height in sizes[:_FRAMES_NAMED]]
    if len(sizes) > _FRAMES_NAMED:
        texts.append("…")
    return ", ".join(texts)


def _durations_text(records: Sequence[Fixations]) -> str:
    """Say how long the fixations take, as far as it is known."""
    durations = [record.durations for record in records if record.durations is not None]
    if not durations:
        return "without durations"
    return f"they take {np.median(np.concatenate(durations)):g} ms in the median"
