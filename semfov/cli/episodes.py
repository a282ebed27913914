"""Searches and explorations of pictures: in this process or in many, with results, figures and a page."""

from __future__ import annotations

import io
import sys
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any, TextIO

import torch
from tqdm import tqdm

from semfov.agent import ActivePerception
from semfov.agents.picture import How, PictureLike
from semfov.cli.options import ALL_DRAWINGS, OF_ANY_LOOK, Drawing, PictureOptions
from semfov.cli.outcome import PictureOutcome, picture_outcome
from semfov.cli.results import STDOUT, ResultsFile, kind_of, tell_written, unfinished
from semfov.cli.sources import PictureSource, picture_sources
from semfov.cli.truth import read_truth
from semfov.data.sources import embedded_picture
from semfov.errors import DataError, InputError, SemfovError, check
from semfov.head.world import World
from semfov.io.files import plain_name, sha256, write_bytes
from semfov.io.manifest import FILE as MANIFEST
from semfov.io.pretrained import Pretrained
from semfov.paths import Record
from semfov.paths.georeference import georeference
from semfov.report import write_page
from semfov.runs.config import WHERE
from semfov.runs.results import SceneResults
from semfov.runs.workers import run_tasks
from semfov.threads import available_cores


class PictureJob(ABC):
    """Looks at pictures as the options say; any process can make it from the options."""

    agent: ActivePerception
    title: str
    target: str | None = None
    drawings: tuple[Drawing, ...] = ALL_DRAWINGS
    every = False

    def __init__(self, options: Any) -> None:
        self.options: Any = options
        self._sources = picture_sources(options)
        self.several = len(self._sources) > 1
        for name in ("crops", "labels"):
            places = Counter(str(source.place.with_suffix("")) for source in self._sources)
            again = [place for place, times in places.items() if times > 1]
            expected = f"pictures of different names with --{name}, whose files have their names"
            check(not again or getattr(options, name) is None, name, expected, ", ".join(again[:3]))
        self.truth = None if options.annotations is None else read_truth(options.annotations)
        if self.truth is not None:
            for source in self._sources:
                self.truth.image_id(source.name)

    @property
    def sources(self) -> list[PictureSource]:
        """The pictures; an embedded scene if none is named."""
        if not self._sources:
            scene = embedded_picture(self.agent.classes[1:], self.target, self.options.seed)
            self._sources = [PictureSource("embedded scene", scene=scene)]
        return self._sources

    def depends_on(self) -> dict[str, Any]:
        """What outcomes depend on beside pictures and code, by content; fitted models stand for themselves."""
        agent, folder = self.agent, self.options.models
        return {
            "options": {name: value for name, value in self.options.plain().items() if name not in (*WHERE, "quiet")},
            "eye": agent.eye.settings(),
            "classes": agent.classes,
            "models": [module for module in agent.modules() if isinstance(module, Pretrained)],
            "parts": [(place, type(part).__qualname__, _numbers(part)) for place, part in agent.named_modules()],
            "folder": None if folder is None else sha256(folder / MANIFEST),
            "annotations": None if self.truth is None else self.truth.digest,
        }

    @abstractmethod
    def look(self, picture: PictureLike, shared: dict[str, Any], source: PictureSource) -> Record:
        """Look at a picture, with the arguments that all subcommands share, and return the record."""

    def outcome(self, number: int) -> PictureOutcome | SemfovError:
        """Look at the picture of this number, and make its text, row and figures; an error is returned, not raised."""
        source, began = self.sources[number], time.perf_counter()
        try:
            with torch.inference_mode():
                picture = source.opened(self.options.how)
                record = self.look(picture, self._shared(picture, source), source)
                seconds = time.perf_counter() - began
                return picture_outcome(record, picture, source, self.options, seconds, self.agent.eye.settings())
        except SemfovError as error:
            return error
        except Exception as error:
            if not self.several:
                raise
            # One picture of many, whatever is wrong with it, is not the end of the command.
            reason = " ".join(str(error).split()) or "no message"
            return DataError(f"{source.name}: cannot be looked at ({type(error).__name__}: {reason})")

    def _shared(self, picture: PictureLike, source: PictureSource) -> dict[str, Any]:
        """Arguments that all subcommands share, and a bar for the passes in a single picture."""
        options: PictureOptions = self.options
        how: How = "auto" if isinstance(picture, World) else options.how
        arguments: dict[str, Any] = {"how": how, "passes": options.passes, "seconds": options.seconds}
        arguments |= {"shifts": options.shifts, "duration": options.duration}
        if not self.several and not options.quiet and sys.stderr.isatty():
            bar = tqdm(desc=Path(source.name).name, unit="pass", total=options.passes, leave=False, dynamic_ncols=True)
            arguments["on_look"] = lambda record: bar.update(record.passes - bar.n)
        return arguments


def _numbers(part: object) -> dict[str, Any]:
    """The settings of a part of an agent, by which agents that Python makes are told apart."""
    return {name: value for name, value in vars(part).items() if type(value) in (bool, int, float, str)}


def _make_again(kind: type[PictureJob], options: PictureOptions) -> PictureJob:
    """The job, in a process that works for another one."""
    with redirect_stdout(io.StringIO()):  # the process that was called has said it
        return kind(options)


def _check_places(files: Sequence[Path | None]) -> None:
    """Raise `InputError` where only some of the pictures have a place on earth, as one collection has one unit."""
    kinds: dict[bool, Path | None] = {}
    for file in files:
        with suppress(DataError):  # it is skipped when it is opened
            kinds.setdefault(file is not None and georeference(str(file)) is not None, file)
    got = f"{kinds.get(True)} with one and {kinds.get(False)} without; look at them apart, or write .json"
    check(len(kinds) < 2, "out", "pictures that all have a georeference, or none, for .geojson", got)


class _PictureFiles:
    """Files that a command writes about its pictures: results, figures and a page."""

    def __init__(self, job: PictureJob, stream: TextIO) -> None:
        self.job, self.written = job, list[Path]()
        self.episodes: dict[int, dict[str, Any]] = {}
        self.rows: dict[int, dict[str, Any]] = {}
        self.results: ResultsFile | None = None
        self.folder: Path | None = None
        self.finished: SceneResults | None = None
        out = job.options.out
        if out is None:
            return
        kind = kind_of(out)
        if kind == ".geojson":
            _check_places([source.file for source in self.job.sources])
        file = out if kind is not None else out / "results.json"
        searched = self.job.title.startswith("search")
        self.results = ResultsFile(file, kind or ".json", searched=searched, stream=stream, truth=self.job.truth)
        self.folder = out if kind is None else out.with_name(out.name.partition(".")[0])
        if self.job.several and out != STDOUT:
            self.finished = unfinished(file, self.job.depends_on(), self.job.sources)

    def before(self) -> dict[int, PictureOutcome]:
        """Outcomes of an interrupted command with the same options and models, by the numbers of the pictures."""
        if self.finished is None:
            return {}
        stored = self.finished.items(len(self.job.sources))
        return {number: PictureOutcome(**each["records"][0]) for number, each in stored}

    def add(self, number: int, outcome: PictureOutcome, *, before: bool) -> None:
        """Write the row and the figures of a picture; if an earlier command finished it, its figures exist already."""
        self.rows[number] = outcome.row["picture"]
        if self.results is not None:
            self.results.add(number, outcome.row)
        for path, content in outcome.files.items():
            write_bytes(path, content)
        if self.folder is not None:
            name = Path(self.job.sources[number].name).name
            folder = self.folder / f"{number:03d}-{plain_name(name)}" if self.job.several else self.folder
            for file, content in outcome.figures.items():
                write_bytes(folder / file, content)
            self.written += [folder / file for file in outcome.names]
        if outcome.episode is not None:
            self.episodes[number] = outcome.episode
        if self.finished is not None and not before:
            self.finished.save(number, [outcome.values()], {})

    def skip(self, number: int, reason: str) -> None:
        """Note a picture that could not be read, and the reason."""
        self.rows[number] = {"picture": self.job.sources[number].name, "error": reason}
        if self.results is not None:
            self.results.skip(number, self.rows[number]["picture"], reason)

    def finish(self, *, complete: bool) -> None:
        """Write the results and the page of all pictures so far, and list what was written."""
        written = self.written
        if self.results is not None:
            self.results.write()
            if complete and self.job.truth is not None and any("error" not in row for row in self.rows.values()):
                print(self.results.precision())
            written = [*([] if self.results.path == STDOUT else [self.results.path]), *written]
        if self.episodes:
            episodes = [self.episodes[number] for number in sorted(self.episodes)]
            written = [*written, write_page(self.job.options.report, f"semfov: {self.job.title}", episodes)]
        options = self.job.options
        written = [*written, *(folder for folder in (options.crops, options.labels) if folder is not None)]
        tell_written(written, self.finished, None if complete else f"{len(self.rows)} of {len(self.job.sources)}")


def look_at_pictures(job: PictureJob, stream: TextIO) -> list[dict[str, Any]]:
    """Look at all pictures, print the outcomes, and write the files that the options name; `--out -` is the stream."""
    wanted = job.options.draw or ()
    for source in job.sources if not set(wanted) <= set(OF_ANY_LOOK) else ():
        kind = job.agent.kind_of_look(source.opened("auto"), job.options.how, every=job.every)
        have = job.drawings if kind == "fovea" else OF_ANY_LOOK
        missing = ", ".join(name for name in wanted if name not in have)
        expected = f"{' or '.join(have)} for {source.name}, which is looked at by {kind!r}"
        check(not missing, "draw", expected, missing)
    sources, several = job.sources, job.several
    if not job.options.pictures:
        print("no picture was given: looking at an embedded scene")
    outputs = _PictureFiles(job, stream)
    complete, endings = False, Counter[str]()
    before = outputs.before()
    if before:
        print(f"continuing: {len(before)} of {len(sources)} pictures were looked at before")
    try:
        for number, outcome in _outcomes(job, before):
            name = sources[number].name
            if isinstance(outcome, SemfovError):
                # A wrong argument is not the fault of a picture.
                if not several or (isinstance(outcome, InputError) and not endings):
                    raise outcome
                tqdm.write(f"skipped {name}: {outcome}", file=sys.stderr)
                outputs.skip(number, str(outcome))
                continue
            outputs.add(number, outcome, before=number in before)
            endings[outcome.ended] += 1
            if number not in before:
                tqdm.write(outcome.text, file=sys.stdout)
        complete = True
        longest = max((max(row["width"], row["height"]) for row in outputs.rows.values() if "width" in row), default=0)
        detector = job.agent.eye.detector
        if detector.settings()["name"] == "yolov3-tiny" and longest > 2 * max(detector.input_size):
            print("in large pictures yolox-nano finds more small objects, in less time: --detector yolox-nano")
    finally:
        if outputs.rows:
            outputs.finish(complete=complete)
    skipped = len(sources) - endings.total()
    if several:
        counts = ", ".join(f"{count} {name}" for name, count in endings.items())
        print(f"{len(sources)} pictures: {'; '.join(filter(None, [counts, f'{skipped} skipped' if skipped else '']))}")
    return [outputs.rows[number] for number in range(len(sources))]


def _worth_starting(processes: int | None, tasks: int, seconds: float, start: float) -> int:
    """The number of processes for tasks of some seconds; 1 where starting them would take longer than they save.

    >>> _worth_starting(2, 7, 0.5, 4.0), _worth_starting(2, 99, 0.5, 4.0)
    (1, 2)
    """
    most = min(available_cores() if processes is None else processes, tasks)
    return most if most > 1 and tasks * seconds * (1 - 1 / most) > start else 1


def _outcomes(job: PictureJob, before: dict[int, PictureOutcome]) -> Iterator[tuple[int, PictureOutcome | SemfovError]]:
    """The outcomes of all pictures with their numbers, first those that are there, then the others as they are made."""
    yield from before.items()
    if not job.several:
        yield 0, job.outcome(0)
        return
    left, where = [number for number in range(len(job.sources)) if number not in before], job.options.where
    if left and where != 1 and (where is None or isinstance(where, int)):
        # A process takes as long to start as this one has taken so far. The first picture tells whether that pays.
        start = time.process_time()
        first = left.pop(0)
        yield first, job.outcome(first)
        where = _worth_starting(where, len(left), time.process_time() - start, start)
    yield from run_tasks(
        PictureJob.outcome,
        left,
        where=where,
        make=_make_again,
        settings=(type(job), job.options),
        made=job,
        title="pictures",
        unit="picture",
        hidden=job.options.quiet,
    )
