"""The files that a command writes about its pictures: results, figures, crops, labels and a page."""

from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from semfov.cli.jobs import PictureJob
from semfov.cli.options import PictureOptions
from semfov.cli.outcome import PictureOutcome
from semfov.cli.results import (
    STDOUT,
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
    from semfov.runs.results import SceneResults

_KEPT = ("ended", "text", "row", "episode", "names")
"""Attributes of an outcome from which it is made again, without its files."""


class PictureFiles:
    """Files that a command writes about its pictures.

    Attributes:
        rows: the rows of the pictures so far, by number; those that were left out have an `error`.
        finished: the outcomes that the same command takes up after an interruption; None for one picture.

    Private attributes: `_results` is the file of results, and `_folder` that of the figures beside it; None without
    one. `_written` has the figures so far, and `_episodes` the parts of the page by the numbers of their pictures.

    Invariant: each picture is added or skipped once, in any order; `finish` can be called after any of them.
    """

    def __init__(self, job: PictureJob[PictureOptions], stream: TextIO) -> None:
        self.job = job
        self.rows: dict[int, Values] = {}
        self.finished: SceneResults | None = None
        self._written = list[Path]()
        self._episodes: dict[int, Data] = {}
        self._results: ResultsFile | None = None
        self._folder: Path | None = None
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

    def finished_before(self) -> dict[int, PictureOutcome]:
        """Read the outcomes of an interrupted command with the same options and models, by number."""
        if self.finished is None:
            return {}
        stored = self.finished.items(len(self.job.sources))
        return {number: PictureOutcome(**values["records"][0]) for number, values in stored}

    def write_figures(self, number: int, outcome: PictureOutcome | SemfovError) -> PictureOutcome | SemfovError:
        """Write the crops, the labels and the figures of a picture.

        Args:
            number: number of the picture.
            outcome: its outcome. If an earlier command finished the picture, the files exist already.

        Returns:
            The outcome, or why the files cannot be written.
        """
        if isinstance(outcome, SemfovError):
            return outcome
        source = self.job.sources[number]
        try:
            for path, content in outcome.files.items():
                write_bytes(path, content)
            if self._folder is not None:
                self._write_into(self._folder_of(number, self._folder), outcome, source.file)
        except Exception as error:
            return source.fault(error, several=self.job.several)
        return outcome

    def _folder_of(self, number: int, folder: Path) -> Path:
        """Name the folder of a picture's figures: one of its own within that of several pictures."""
        if not self.job.several:
            return folder
        name = plain_name(Path(self.job.sources[number].name).name)
        return folder / f"{number:03d}-{name}"

    def _write_into(self, folder: Path, outcome: PictureOutcome, picture: Path | None) -> None:
        """Write the figures of a picture into a folder, but not over the picture itself."""
        for file, content in outcome.figures.items():
            check_apart(folder / file, [picture])
            write_bytes(folder / file, content)
        # An earlier command may have written them, of which the outcome keeps the names alone.
        self._written += [folder / file for file in outcome.names]

    def add(self, number: int, outcome: PictureOutcome, *, before: bool) -> None:
        """Write the row of a picture, and keep it for the same command.

        Args:
            number: number of the picture.
            outcome: its outcome.
            before: whether an earlier command finished it, and has kept it.
        """
        self.rows[number] = outcome.row["picture"]
        if self._results is not None:
            self._results.add(number, outcome.row)
        if outcome.episode is not None:
            self._episodes[number] = outcome.episode
        if self.finished is not None and not before:
            self.finished.save(number, [{name: getattr(outcome, name) for name in _KEPT}], {})

    def skip(self, number: int, reason: str) -> None:
        """Note a picture that is left out, and the reason."""
        self.rows[number] = {"picture": self.job.sources[number].name, "error": reason}
        if self._results is not None:
            self._results.add(number, {"picture": self.rows[number]})

    def finish(self, *, complete: bool) -> None:
        """Write the results and the page of all pictures so far, and list what was written.

        Args:
            complete: whether all pictures were looked at.
        """
        options = self.job.options
        folders = [folder for folder in (options.crops, options.labels) if folder is not None]
        written = [*self._write_results(complete=complete), *self._written, *self._write_page(), *folders]
        part = None if complete else f"{len(self.rows)} of {len(self.job.sources)}"
        tell_written(written, self.finished, part)

    def _write_results(self, *, complete: bool) -> list[Path]:
        """Write the file of results, if one is wanted, and print how complete ones agree with annotations."""
        if self._results is None:
            return []
        self._results.write()
        was_looked_at = any("error" not in row for row in self.rows.values())
        if complete and was_looked_at:
            self._results.print_judgement()
        return [] if self._results.path == STDOUT else [self._results.path]

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
