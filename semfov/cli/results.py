"""Files of results, written while pictures are looked at, and the list of the files of a command."""

import json
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from semfov.cli.formats import FORMATS, CocoResults, JsonLines, ResultsFormat, Row, suffix_of, suffixes
from semfov.cli.options import FIGURES
from semfov.cli.sources import PictureSource
from semfov.cli.truth import Truth
from semfov.data.classes import amount
from semfov.errors import DataError, check, printable
from semfov.io.code import package_digest
from semfov.io.files import write_text, written_alone
from semfov.paths.conversion import Values

if TYPE_CHECKING:
    from semfov.runs.results import SceneResults

_SHARE = 0.05  # of the time may be spent on writing results that are not complete yet
STDOUT = Path("-")  # standard output in place of a file of results, which takes JSON lines


def kind_of(path: Path) -> str | None:
    """Find the format of a result file by its name.

    Args:
        path: the file, `STDOUT`, or a folder.

    Returns:
        Suffix of the format; None for a folder.

    Raises:
        InputError: the name is that of another file.
    """
    if path == STDOUT:
        return JsonLines.suffix
    suffix = suffix_of(path.name)
    is_folder = not path.suffix or path.is_dir()
    ends = ", ".join([*FIGURES, *suffixes()])
    check(suffix is not None or is_folder, "out", f"a folder, or a file that ends in {ends}", path)
    return suffix


def results_format(path: Path, *, searched: bool = False, truth: Truth | None) -> ResultsFormat:
    """Make the format of a file of results; that in a folder is JSON.

    Args:
        path: the file, `STDOUT`, or a folder.
        searched: whether the pictures are searched for a class.
        truth: annotations whose ids the results have; None for none.

    Returns:
        The format.
    """
    if truth is not None:
        return CocoResults(truth)  # the options take annotations with a file of COCO alone
    if path == STDOUT:
        return JsonLines(searched=searched, ascii_only=True)
    return FORMATS[kind_of(path) or ".json"](searched=searched)


class Results:
    """Results that are wanted in no file."""

    def add(self, number: int, row: Row) -> None:
        """Add a picture, or one that could not be read, with its `error`."""

    def write(self) -> Sequence[Path]:
        """Write the file, atomically; returns what was written."""
        return ()

    def print_judgement(self) -> None:
        """Print how the objects agree with the annotations, where there are any."""


class ResultsFile(Results):
    """A file of results that is complete for the pictures so far, whenever the command ends.

    `_rows` has the rows by the numbers of the pictures, which may come in any order. The file is not written again
    before the time `_due`, so that writing takes a small share of the time. A file that grows has each row at once.

    Args:
        path: the file, or `STDOUT`.
        form: its format.
        stream: standard output.
    """

    def __init__(self, path: Path, form: ResultsFormat, stream: TextIO) -> None:
        self.path = path
        self.form = form
        self._stream = stream if path == STDOUT else None
        self._rows: dict[int, Row] = {}
        self._due = 0.0
        if form.grows and self._stream is None:
            write_text(path, "")

    def add(self, number: int, row: Row) -> None:
        self._rows[number] = row
        if self.form.grows:
            self._append(self.form.text([row]))
        elif time.monotonic() >= self._due:
            self._write_whole()

    def _append(self, text: str) -> None:
        """Add text at the end of the stream or of the file."""
        if self._stream is not None:
            self._stream.write(text)
            self._stream.flush()
            return
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(text)
        except OSError as error:
            raise DataError(f"cannot write {self.path}: {error.strerror or error}") from error

    def write(self) -> Sequence[Path]:
        if not self.form.grows:
            self._write_whole()
        return () if self.path == STDOUT else (self.path,)

    def _write_whole(self) -> None:
        """Write all rows so far."""
        # The more pictures there are, the longer a file takes that is written anew, and the later it is due again.
        began = time.monotonic()
        write_text(self.path, self.form.text(self._in_order()))
        took = time.monotonic() - began
        self._due = began + took / _SHARE

    def print_judgement(self) -> None:
        judgement = self.form.judgement(self._in_order())
        if judgement is not None:
            print(judgement)

    def _in_order(self) -> list[Row]:
        """Return the rows in the order of the pictures."""
        return [self._rows[number] for number in sorted(self._rows)]


def held_outputs(options: object) -> AbstractContextManager[None]:
    """Hold all that the options name to write, in a block that is refused while another command writes any of it."""
    files: list[Path] = []
    folders: list[Path] = []
    for name in ("out", "report", "crops", "labels"):
        path = getattr(options, name, None)  # not all commands have all of them
        if path in (None, STDOUT):
            continue
        # A folder that is not there yet may have a point in its name.
        is_folder = name in ("crops", "labels") or path.is_dir() or not path.suffix
        (folders if is_folder else files).append(path)
    return written_alone(files, folders)


class FinishedWork:
    """Stored outcomes of the pictures of an unfinished command, from which it can continue."""

    def outcomes(self) -> Iterator[tuple[int, Values]]:
        """Yield what an interrupted command has kept of pictures, by their numbers."""
        yield from ()

    def keep(self, number: int, values: Mapping[str, object]) -> None:
        """Store the outcome of a picture, as JSON values."""

    def end(self, part: str) -> None:
        """End the command, and say how it continues.

        Args:
            part: which part of the pictures is done, such as `2 of 3`; empty for all, of which nothing more is kept.
        """


class _KeptWork(FinishedWork):
    """What is kept in a database beside the file of results of some pictures."""

    def __init__(self, results: "SceneResults", pictures: int) -> None:
        self._results = results
        self._pictures = pictures

    def outcomes(self) -> Iterator[tuple[int, Values]]:
        for number, values in self._results.items(self._pictures):
            yield number, values["records"][0]

    def keep(self, number: int, values: Mapping[str, object]) -> None:
        self._results.save(number, [dict(values)], {})

    def end(self, part: str) -> None:
        self._results.flush()
        if part:
            print(f"{part} pictures were looked at; the same command continues", file=sys.stderr)
        else:
            shutil.rmtree(self._results.path.parent, ignore_errors=True)


def unfinished(file: Path, depends_on: Mapping[str, object], sources: Sequence[PictureSource]) -> FinishedWork:
    """Open what a command has finished of pictures that are the same, with all that it depends on.

    Args:
        file: file of results, beside which it is kept.
        depends_on: what the outcomes depend on beside pictures and code.
        sources: the pictures.

    Returns:
        What was kept.

    Raises:
        DataError: another command was stopped, and what it has finished is kept there (`check_nothing_kept`).
    """
    from semfov.runs.results import SceneResults
    from semfov.runs.scene_run import digest_of

    # Half of a sha256 is enough to tell commands apart, and leaves room in the name of a file.
    key = digest_of([depends_on, package_digest()])[:32]
    versions = [json.dumps(source.version()) for source in sources]
    finished = SceneResults(_kept_folder(file), key, versions.__getitem__)
    # Where one picture is as before, others have changed since the same command was stopped.
    is_of_other_pictures = len(finished) > 0 and not finished.finished(len(sources))
    check_nothing_kept(file, None if is_of_other_pictures else finished.path)
    return _KeptWork(finished, len(sources))


def check_nothing_kept(file: Path, own: Path | None = None) -> None:
    """Raise `DataError` where the outcomes of another command that was stopped are kept beside its file of results.

    They would be removed with those of this command when that has ended.

    Args:
        file: the file of results.
        own: the outcomes of this command, which it continues.
    """
    folder = _kept_folder(file)
    others = [path for path in folder.glob("*.sqlite") if path != own]
    if not others:
        return
    from semfov.runs.results import SceneResults

    count = sum(len(SceneResults(folder, path.stem, str)) for path in others)
    if count:
        raise DataError(
            f"cannot write {file}: a command with other options, models or pictures, or of another version was stopped "
            f"after {amount(count, 'picture')}, which are kept in {folder}; name another output, or delete that folder"
        )


def _kept_folder(file: Path) -> Path:
    """Name the folder beside a file of results in which a command keeps what it has finished."""
    return file.with_name(f"{file.name}.unfinished")


def tell_continuing(done: int, total: int) -> None:
    """Say how many of all pictures an interrupted command has looked at; nothing if none."""
    if done:
        print(f"continuing: {done} of {total} pictures were looked at before")


def tell_written(files: Sequence[Path]) -> None:
    """List the files that a command has written, if there are any."""
    if files:
        print("written:", *(f"  {printable(str(path))}" for path in files), sep="\n")
