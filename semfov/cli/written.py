"""The files that a command writes about its pictures: results, figures, crops, labels and a page."""

from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from semfov.cli.jobs import PictureJob
from semfov.cli.options import PictureOptions
from semfov.cli.outcome import PictureOutcome
from semfov.cli.results import (
    STDOUT,
    FinishedWork,
    Results,
    ResultsFile,
    check_nothing_kept,
    kind_of,
    results_format,
    tell_written,
    unfinished,
)
from semfov.cli.totals import found_in_all
from semfov.data.classes import amount
from semfov.errors import SemfovError
from semfov.io.files import check_apart, plain_name, write_bytes
from semfov.paths.conversion import Values

if TYPE_CHECKING:
    from semfov.report.episode import Data

_KEPT = ("ended", "text", "row", "episode", "names")
"""Attributes of an outcome from which it is made again, without its files."""


class PictureFiles:
    """Files that a command writes about its pictures.

    Attributes:
        rows: the rows of the pictures so far, by number; those that were left out have an `error`.
        finished: the outcomes that the same command takes up after an interruption.

    Private attributes: `_results` is the file of results, and `_folder` that of the figures beside it. `_written` has
    the figures so far, and `_episodes` the parts of the page by the numbers of their pictures.

    Invariant: each picture is added or skipped once, in any order; `finish` can be called after any of them.
    """

    def __init__(self, job: PictureJob[PictureOptions], stream: TextIO) -> None:
        self.job = job
        self.rows: dict[int, Values] = {}
        self.finished = FinishedWork()
        self._written = list[Path]()
        self._episodes: dict[int, Data] = {}
        self._results = Results()
        self._folder = Path()
        if job.options.figure is not None:
            self._written = [job.options.figure]
        if job.options.results is not None:
            self._open(job.options.results, stream)

    def _open(self, out: Path, stream: TextIO) -> None:
        """Open the file of results, or the one in a folder, and what an interrupted command has left of it."""
        job = self.job
        kind = kind_of(out)
        form = results_format(out, searched=job.title.startswith("search"), truth=job.truth)
        form.check_files([source.file for source in job.sources])
        if kind is None:
            file = out / "results.json"
            self._folder = out
        else:
            file = out
            # Beside a file, figures have a folder of its name: found.coco.json and found/.
            self._folder = out.with_name(out.name.partition(".")[0])
        # One picture takes seconds, and what was written to a stream is gone.
        if job.several and out != STDOUT:
            self.finished = unfinished(file, job.depends_on(), job.sources)
        elif out != STDOUT:
            check_nothing_kept(file)
        self._results = ResultsFile(file, form, stream)

    def take_up(self) -> dict[int, str]:
        """Add the pictures that an interrupted command with the same options and models has finished.

        Returns:
            How each of them ended, by number.
        """
        endings = {}
        for number, values in self.finished.outcomes():
            outcome = PictureOutcome(**values)
            self._note(number, outcome)
            endings[number] = outcome.ended
        return endings

    def write_figures(self, number: int, outcome: PictureOutcome | SemfovError) -> PictureOutcome | SemfovError:
        """Write the crops, the labels and the figures of a picture.

        Args:
            number: number of the picture.
            outcome: its outcome.

        Returns:
            The outcome, or why the files cannot be written.
        """
        if isinstance(outcome, SemfovError):
            return outcome
        source = self.job.sources[number]
        try:
            for path, content in outcome.files.items():
                write_bytes(path, content)
            for name, content in outcome.figures.items():
                figure = self._folder_of(number) / name
                check_apart(figure, [source.file])
                write_bytes(figure, content)
        except Exception as error:
            return source.fault(error, several=self.job.several)
        return outcome

    def _folder_of(self, number: int) -> Path:
        """Name the folder of a picture's figures: one of its own within that of several pictures."""
        if not self.job.several:
            return self._folder
        name = plain_name(Path(self.job.sources[number].name).name)
        return self._folder / f"{number:03d}-{name}"

    def add(self, number: int, outcome: PictureOutcome) -> None:
        """Write the row of a picture, and keep it for the same command."""
        self._note(number, outcome)
        self.finished.keep(number, {name: getattr(outcome, name) for name in _KEPT})

    def _note(self, number: int, outcome: PictureOutcome) -> None:
        """Write the row of a picture, and note what is written of it."""
        # An earlier command may have drawn its figures, of which the outcome keeps the names alone.
        self._written += [self._folder_of(number) / name for name in outcome.names]
        self.rows[number] = outcome.row["picture"]
        self._results.add(number, outcome.row)
        if outcome.episode is not None:
            self._episodes[number] = outcome.episode

    def skip(self, number: int, reason: str) -> None:
        """Note a picture that is left out, and the reason."""
        self.rows[number] = {"picture": self.job.sources[number].name, "error": reason}
        self._results.add(number, {"picture": self.rows[number]})

    def finish(self, *, complete: bool) -> None:
        """Write the results and the page of all pictures so far, and list what was written.

        Args:
            complete: whether all pictures were looked at.
        """
        options = self.job.options
        folders = [folder for folder in (options.crops, options.labels) if folder is not None]
        results = self._results.write()
        was_looked_at = any("error" not in row for row in self.rows.values())
        if complete and was_looked_at:
            self._results.print_judgement()
        tell_written([*results, *self._written, *self._write_page(), *folders])
        self.finished.end("" if complete else f"{len(self.rows)} of {len(self.job.sources)}")

    def _write_page(self) -> list[Path]:
        """Write the page of the pictures so far, if it is wanted and there are some."""
        report = self.job.options.report
        if report is None or not self._episodes:
            return []
        from semfov.report import write_page

        episodes = [self._episodes[number] for number in sorted(self._episodes)]
        totals = [found_in_all(self.job, self.rows.values())]
        skipped = sum("error" in row for row in self.rows.values())
        if skipped:
            totals.append(f"{amount(skipped, 'picture')} skipped")
        total = "; ".join(filter(None, totals))
        return [write_page(report, f"semfov: {self.job.title}", episodes, total=total)]
