"""Subcommands that look at pictures: search, find and explore."""

import io
import os
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import nullcontext, redirect_stdout, suppress
from dataclasses import fields, replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Literal, TextIO, get_args, get_type_hints

import torch
from tqdm import tqdm

from semfov.agent import ActivePerception
from semfov.agents.picture import How, PictureLike
from semfov.belief.grid import Grid
from semfov.cli.agent import detector_classes, make_agent, several_classes
from semfov.cli.options import (
    ALL_DRAWINGS,
    OF_ANY_LOOK,
    Drawing,
    ExploreOptions,
    FindOptions,
    PictureOptions,
    SearchOptions,
    start_of,
)
from semfov.cli.outcome import PictureOutcome
from semfov.cli.results import STDOUT, ResultsFile, held_outputs, kind_of, results_format, tell_written, unfinished
from semfov.cli.sources import PictureSource, example_source, picture_sources
from semfov.cli.truth import Truth
from semfov.data import WordVectors, class_index, spread
from semfov.data.examples import example_with
from semfov.data.large import picture_size
from semfov.errors import InputError, SemfovError, check, check_options, lookup
from semfov.head.scenes import World
from semfov.io.files import check_writable, plain_name, sha256, write_bytes
from semfov.io.manifest import FILE as MANIFEST
from semfov.io.pretrained import Pretrained
from semfov.paths import Record
from semfov.report import write_page
from semfov.report.template import page_path
from semfov.runs.config import WHERE
from semfov.runs.results import SceneResults
from semfov.runs.workers import Where, run_tasks
from semfov.threads import available_cores


class _PictureJob(ABC):
    """Looks at pictures as the options say; any process can make it from the options."""

    title: str
    target: str | None = None
    targets: Sequence[str] | None = None
    weights: dict[str, float] | None = None
    drawings: tuple[Drawing, ...] = ALL_DRAWINGS
    every = False

    def __init__(self, options: Any, agent: ActivePerception | None = None) -> None:
        self.options: Any = options
        self.sources = picture_sources(options)
        self.several = len(self.sources) > 1
        for name in ("crops", "labels"):
            places = Counter(str(source.place.with_suffix("")) for source in self.sources)
            again = [place for place, times in places.items() if times > 1]
            expected = f"pictures of different names with --{name}, whose files have their names"
            check(not again or getattr(options, name) is None, name, expected, ", ".join(again[:3]))
        self.truth = None if options.annotations is None else Truth(options.annotations)
        if self.truth is not None:
            for source in self.sources:
                self.truth.image_id(source.name)
        first = "none for find, which begins with the whole picture"
        check(not self.every or options.start is None, "start", first, repr(options.start))
        self.start = _check(options)
        self.aim(detector_classes(options) if agent is None else agent.classes[1:])
        self.agent = make_agent(options) if agent is None else agent
        self.aim(self.agent.classes[1:])
        if self.truth is not None:
            self.truth.categories(self.targets or self.agent.classes[1:])
        if not self.sources:
            name = "sheet" if self.every else example_with(self.target, self.agent.classes[1:])
            self.sources = [example_source(name, self.agent.classes[1:], self.target)]

    def aim(self, classes: Sequence[str] | None) -> None:
        """Take the target from the options; before the names of the classes are known it is not checked."""
        self.title = "exploration"

    def depends_on(self) -> dict[str, Any]:
        """What outcomes depend on beside pictures and code, by content; fitted models stand for themselves."""
        agent, folder, parts = self.agent, self.options.models, list[Any]()
        for place, part in agent.named_modules():
            # Agents that Python makes are told apart by the settings of their parts.
            numbers = {name: value for name, value in vars(part).items() if type(value) in (bool, int, float, str)}
            parts.append((place, type(part).__qualname__, numbers))
        return {
            "options": {name: value for name, value in self.options.plain().items() if name not in (*WHERE, "quiet")},
            "eye": agent.eye.settings(),
            "classes": agent.classes,
            "models": [module for module in agent.modules() if isinstance(module, Pretrained)],
            "parts": parts,
            "weights": self.weights,
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
                options: PictureOptions = self.options
                picture = source.opened(options.how)
                if self.truth is not None:
                    stored: Any = source.opened("auto")
                    self.truth.image_id(source.name, picture_size(stored))
                how: How = "auto" if isinstance(picture, World) else options.how
                shared: dict[str, Any] = {"how": how, "passes": options.passes, "seconds": options.seconds}
                shared |= {"shifts": options.shifts, "duration": options.duration}
                if not self.several and not options.quiet and sys.stderr.isatty():
                    title = Path(source.name).name
                    bar = tqdm(desc=title, unit="pass", total=options.passes, leave=False, dynamic_ncols=True)
                    shared["on_look"] = lambda record: bar.update(record.passes - bar.n)
                record = self.look(picture, shared, source)
                seconds = time.perf_counter() - began
                return PictureOutcome.of(record, picture, source, self.options, seconds, self.truth)
        except Exception as error:
            return source.fault(error, several=self.several)


def _make_again(kind: type[_PictureJob], options: PictureOptions) -> _PictureJob:
    """The job, in a process that works for another one."""
    with redirect_stdout(io.StringIO()):  # the process that was called has said it
        return kind(options)


class _PictureFiles:
    """Files that a command writes about its pictures: results, figures and a page."""

    def __init__(self, job: _PictureJob, stream: TextIO) -> None:
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
        form = results_format(out, searched=self.job.title.startswith("search"), truth=self.job.truth)
        form.check_files([source.file for source in self.job.sources])
        file = out if kind is not None else out / "results.json"
        self.results = ResultsFile(file, form, stream)
        self.folder = out if kind is None else out.with_name(out.name.partition(".")[0])
        if self.job.several and out != STDOUT:
            self.finished = unfinished(file, self.job.depends_on(), self.job.sources)

    def write_figures(self, number: int, outcome: PictureOutcome | SemfovError) -> PictureOutcome | SemfovError:
        """Write the crops, the labels and the figures of a picture; return its outcome, or why they cannot be written.

        If an earlier command finished the picture, they exist already.
        """
        if isinstance(outcome, SemfovError):
            return outcome
        source = self.job.sources[number]
        try:
            for path, content in outcome.files.items():
                write_bytes(path, content)
            if self.folder is not None:
                name = plain_name(Path(source.name).name)
                folder = self.folder / f"{number:03d}-{name}" if self.job.several else self.folder
                for file, content in outcome.figures.items():
                    write_bytes(folder / file, content)
                self.written += [folder / file for file in outcome.names]
        except Exception as error:
            return source.fault(error, several=self.job.several)
        return outcome

    def add(self, number: int, outcome: PictureOutcome, *, before: bool) -> None:
        """Write the row of a picture, and keep it for the same command, unless it was finished `before`."""
        self.rows[number] = outcome.row["picture"]
        if self.results is not None:
            self.results.add(number, outcome.row)
        if outcome.episode is not None:
            self.episodes[number] = outcome.episode
        if self.finished is not None and not before:
            # From these values the outcome is made again, without its files.
            kept = {name: getattr(outcome, name) for name in ("ended", "text", "row", "episode", "names")}
            self.finished.save(number, [kept], {})

    def skip(self, number: int, reason: str) -> None:
        """Note a picture that is left out, and the reason."""
        self.rows[number] = {"picture": self.job.sources[number].name, "error": reason}
        if self.results is not None:
            self.results.add(number, {"picture": self.rows[number]})

    def finish(self, *, complete: bool) -> None:
        """Write the results and the page of all pictures so far, and list what was written."""
        written = self.written
        if self.results is not None:
            self.results.write()
            if complete and any("error" not in row for row in self.rows.values()):
                self.results.print_judgement()
            written = [*([] if self.results.path == STDOUT else [self.results.path]), *written]
        if self.episodes:
            episodes = [self.episodes[number] for number in sorted(self.episodes)]
            written = [*written, write_page(self.job.options.report, f"semfov: {self.job.title}", episodes)]
        options = self.job.options
        written = [*written, *(folder for folder in (options.crops, options.labels) if folder is not None)]
        tell_written(written, self.finished, None if complete else f"{len(self.rows)} of {len(self.job.sources)}")


def _check_drawings(job: _PictureJob) -> None:
    """Raise `InputError` where a picture is looked at in a way that has no figure of a kind that is wanted."""
    wanted = job.options.draw or ()
    if set(wanted) <= set(OF_ANY_LOOK):
        return
    for source in job.sources:
        try:
            kind = job.agent.kind_of_look(source.opened("auto"), job.options.how, every=job.every)
        except Exception:
            continue  # it is told when the picture is looked at
        have = job.drawings if kind == "fovea" else OF_ANY_LOOK
        missing = ", ".join(name for name in wanted if name not in have)
        expected = f"{' or '.join(have)} for {source.name}, which is looked at by {kind!r}"
        check(not missing, "draw", expected, missing)


def _look_at_pictures(job: _PictureJob, stream: TextIO) -> list[dict[str, Any]]:
    """Look at all pictures, print the outcomes, and write the files that the options name; `--out -` is the stream."""
    _check_drawings(job)
    with held_outputs(job.options):
        return _look_and_write(job, stream)


def _look_and_write(job: _PictureJob, stream: TextIO) -> list[dict[str, Any]]:
    """Look at all pictures; no other command writes the same files meanwhile."""
    sources, several = job.sources, job.several
    if not job.options.pictures:
        print(f"no picture was given: looking at {sources[0].name}, which comes with semfov")
    outputs = _PictureFiles(job, stream)
    complete, endings, faults = False, Counter[str](), list[SemfovError]()
    before: dict[int, PictureOutcome] = {}
    if outputs.finished is not None:  # by an interrupted command with the same options and models
        stored = outputs.finished.items(len(sources))
        before = {number: PictureOutcome(**each["records"][0]) for number, each in stored}
    if before:
        print(f"continuing: {len(before)} of {len(sources)} pictures were looked at before")
    try:
        for number, seen in _outcomes(job, before):
            outcome = outputs.write_figures(number, seen)
            if isinstance(outcome, SemfovError):
                if not several:
                    raise outcome
                tqdm.write(f"skipped {sources[number].name}: {outcome}", file=sys.stderr)
                outputs.skip(number, str(outcome))
                faults.append(outcome)
                continue
            outputs.add(number, outcome, before=number in before)
            endings[outcome.ended] += 1
            if number not in before:
                tqdm.write(outcome.text, file=sys.stdout)
        complete = True
    finally:
        if outputs.rows:
            outputs.finish(complete=complete)
    if not endings and all(isinstance(fault, InputError) for fault in faults):
        raise faults[0]  # what no picture can be looked at with is a wrong argument
    if several:
        counts = ", ".join(f"{count} {name}" for name, count in endings.items())
        skipped = f"{len(faults)} skipped" if faults else ""
        print(f"{len(sources)} pictures: {'; '.join(filter(None, [counts, skipped]))}")
    return [outputs.rows[number] for number in range(len(sources))]


def _worth_starting(processes: int | None, tasks: int, seconds: float, start: float) -> int:
    """The number of processes for tasks of some seconds; 1 where starting them would take longer than they save."""
    most = min(available_cores() if processes is None else processes, tasks)
    return most if most > 1 and tasks * seconds * (1 - 1 / most) > start else 1


def _outcomes(
    job: _PictureJob, before: dict[int, PictureOutcome]
) -> Iterator[tuple[int, PictureOutcome | SemfovError]]:
    """The outcomes of all pictures with their numbers, first those that are there, then the others as they are made."""
    yield from before.items()
    if not job.several:
        yield 0, job.outcome(0)
        return
    left, options = [number for number in range(len(job.sources)) if number not in before], job.options
    where: Where = options.workers if options.scheduler is None else options.scheduler
    if left and where != 1 and (where is None or isinstance(where, int)):
        # A process takes as long to start as this one has taken so far. The first picture tells whether that pays.
        start = time.process_time()
        first = left.pop(0)
        yield first, job.outcome(first)
        where = _worth_starting(where, len(left), time.process_time() - start, start)
    yield from run_tasks(
        _PictureJob.outcome,
        left,
        where=where,
        make=_make_again,
        settings=(type(job), job.options),
        made=job,
        title="pictures",
        unit="picture",
        hidden=job.options.quiet,
    )


class _SearchJob(_PictureJob):
    """Searches pictures for a class."""

    drawings = get_args(Drawing)

    def aim(self, classes: Sequence[str] | None) -> None:
        """The classes that the target may mean, each with a weight."""
        options = self.options
        if not options.target:
            name = options.detector if options.models is None else options.models
            raise InputError(f"target: expected a class, --target cup, got none; `semfov detectors {name}` lists them")
        if classes is not None and self.weights is None:
            self.weights = _meant(options, classes)
            self.target = next(iter(self.weights))
            self.targets = [self.target]
            self.title = f"search for “{self.target}”"

    def look(self, picture: PictureLike, shared: dict[str, Any], source: PictureSource) -> Record:
        """Search a picture."""
        agent, options, weights = self.agent, self.options, self.weights or {}
        settings = {name: getattr(options, name) for name in ("confirm", "give_up", "closer", "prior", "seed")}
        foveal = len(weights) > 1 or self.start is not None or shared.get("shifts") is not None
        kind = agent.kind_of_look(picture, shared["how"], foveal=foveal)
        if kind != "fovea" and len(weights) > 1:
            print(f"large pictures and scenes are searched only for the most likely class: {next(iter(weights))}",
                  file=sys.stderr)  # fmt: skip
        aim = weights if kind == "fovea" and len(weights) > 1 else next(iter(weights))
        start = self.start
        if start is None and kind == "fovea" and source.scene is not None and source.scene.boxes is not None:
            # A random first cell off the target.
            height, width = source.scene.image.shape[-2:]
            grid = Grid(agent.columns, agent.rows, (width, height))
            free = (~grid.footprint(source.scene.boxes).any(0)).nonzero()[:, 0]
            generator = torch.Generator().manual_seed(options.seed)
            start = int(free[torch.randint(len(free), (1,), generator=generator)]) if len(free) else None
        return agent.search(picture, aim, start=start, **settings, **shared)


class _FindJob(_PictureJob):
    """Finds all objects in pictures."""

    every = True

    def aim(self, classes: Sequence[str] | None) -> None:
        """The classes to find; None for all."""
        self.targets = several_classes(self.options.target, classes)
        self.target = None if self.targets is None else self.targets[0]
        self.title = f"all objects{': ' if self.targets else ''}{', '.join(self.targets or [])}"

    def look(self, picture: PictureLike, shared: dict[str, Any], source: PictureSource) -> Record:
        """Find all objects in a picture."""
        settings = {name: getattr(self.options, name) for name in ("worth", "least", "batch")}
        return self.agent.find_all(picture, self.targets, **settings, **shared)


class _ExploreJob(_PictureJob):
    """Explores pictures."""

    def look(self, picture: PictureLike, shared: dict[str, Any], source: PictureSource) -> Record:
        """Explore a picture."""
        settings = {name: getattr(self.options, name) for name in ("seed", "worth", "least")}
        return self.agent.explore(picture, start=self.start, **settings, **shared)


_TASKS: dict[str, tuple[type[PictureOptions], type[_PictureJob]]] = {
    "search": (SearchOptions, _SearchJob),
    "find": (FindOptions, _FindJob),
    "explore": (ExploreOptions, _ExploreJob),
}

_turn = threading.Lock()  # calls of several threads take turns: a process has one job, and one standard output


def look_at(options: PictureOptions, stream: TextIO) -> int:
    """Search pictures, find all objects in them or explore them, as the options say; returns the exit code."""
    job = next(job for kind, job in _TASKS.values() if isinstance(options, kind))
    return int(any("error" in row for row in _look_at_pictures(job(_with_target(options)), stream)))


def _with_target(options: PictureOptions) -> PictureOptions:
    """The options, with the target that stands among the pictures: `semfov search kitchen.jpg cup`."""
    words = [name for name in options.pictures if Path(name).name == name and not Path(name).suffix]
    words = [name for name in words if not os.path.lexists(name) and not set(name) & set("*?[")]
    if not isinstance(options, SearchOptions | FindOptions) or options.target is not None or len(words) != 1:
        return options
    pictures, classes = tuple(name for name in options.pictures if name not in words), detector_classes(options)
    if not pictures or classes is None:
        return options
    try:
        several_classes(words[0], classes)
    except InputError:
        return options  # it is refused as a picture that is not there, with the way to name a class
    return replace(options, target=words[0], pictures=pictures)


def run(
    pictures: str | PathLike[str] | Sequence[str | PathLike[str]],
    target: str | Sequence[str] | None = None,
    *,
    task: Literal["search", "find", "explore"] = "find",
    agent: ActivePerception | Literal["recommended", "published", "raw"] = "recommended",
    quiet: bool = True,
    **options: Any,
) -> list[dict[str, Any]]:
    """Look at many pictures and write files, as the command `semfov search`, `find` or `explore` does.

    A picture at which anything fails is left out, with its `error`. With `out=`, a call that was stopped continues
    where it was when the same call is made again.

    Args:
        pictures: a picture, a folder, a pattern such as `"flight/*.jpg"`, or a list of these.
        target: class to search for, or to find; for `find` also several, and None for all classes.
        task: what to do.
        agent: an agent that is made already, or the kind of agent that is made of `detector=`, `models=` and others.
        quiet: print errors and warnings alone.
        options: options of the command by their names with underscores, such as `out="people.csv"`, `passes=16`,
            `recursive=True`, `report="page.html"`, `crops="crops"` and `workers=2`. More than one process takes a
            script that calls this under `if __name__ == "__main__"`, and no `agent` that is made already.

    Returns:
        For each picture, in their order, what `semfov.paths.Record.to_dict` has without its looks, or its `error`.

    Raises:
        InputError: an option is unknown or out of range.
        DataError: there is no such picture, or none of them can be read.

    Example::

        rows = semfov.run("flight", "person", out="people.csv", agent=agent, passes=16)
        print(sum(row["expected"]["person"] or 0 for row in rows if "error" not in row))
    """
    kind, job = _TASKS[lookup(task, _TASKS, "task")]
    listed = [pictures] if isinstance(pictures, str | PathLike) else list(pictures)
    fits = bool(listed) and all(isinstance(each, str | PathLike) for each in listed)
    expected = "files, folders or patterns (the methods of an agent take arrays and Pillow images)"
    check(fits, "pictures", expected, type(listed[0]).__name__ if listed else "none")
    known = {field.name for field in fields(kind)} - {"pictures", "target", "agent", "quiet", "stream"}
    check_options(options, [*known], f"semfov {task}")
    made = agent if isinstance(agent, ActivePerception) else None
    for name in {"detector", "weights", "models", "classes", "device", "half", "sensor"} & options.keys():
        check(made is None, name, "none beside an agent that is made already", options[name])
    several = options.get("workers", 1) != 1 or options.get("scheduler") is not None
    check(made is None or not several, "workers", "1 for an agent that is made already", options.get("workers"))
    hints = get_type_hints(kind)
    for name, value in options.items():
        options[name] = Path(value) if value is not None and Path in get_args(hints[name]) else value
    wanted = "a class to search for; task='find' finds all objects"
    check(task != "search" or target is not None, "target", wanted, target)
    if not isinstance(agent, ActivePerception):
        options["agent"] = agent
    if target is not None:
        names = [target] if isinstance(target, str) else target
        fits = isinstance(names, Sequence) and all(isinstance(name, str) for name in names)
        check(fits, "target", "the name of a class, or several in a list", target)
        options["target"] = ",".join(names)
    if isinstance(options.get("draw"), str):
        options["draw"] = (options["draw"],)
    settings = kind(pictures=tuple(fspath(each) for each in listed), quiet=quiet, **options)
    with _turn, open(os.devnull, "w", encoding="utf-8") as nothing:
        stream = sys.stdout
        with redirect_stdout(nothing) if quiet else nullcontext():
            return _look_at_pictures(job(settings, made), stream)


def _check(options: PictureOptions) -> Any:
    """Check what can be checked before anything is loaded; returns the first cell."""
    if options.out is not None and options.out != STDOUT:
        check_writable(options.out, folder=kind_of(options.out) is None)
    if options.report is not None:
        check_writable(page_path(options.report))
    for folder in (options.crops, options.labels):
        if folder is not None:
            check_writable(folder, folder=True)
    coco = options.out is not None and kind_of(options.out) == ".coco.json"
    check(options.annotations is None or coco, "annotations", "--out FILE.coco.json beside it", options.out)
    check(not options.draw or options.out not in (None, STDOUT), "draw", "--out FOLDER beside --draw", "none")
    return start_of(options.start)


def _meant(options: SearchOptions, classes: Sequence[str]) -> dict[str, float]:
    """The classes that a target may mean, each with a weight, the most likely first."""
    target = options.target or ""
    try:
        return {classes[class_index(target, classes, "target") - 1]: 1.0}
    except InputError as error:
        if options.embeddings is None:
            # What else a target that is no class can be.
            way = "; a description needs --embeddings, a file of word vectors" * ("did you mean" not in str(error))
            with suppress(InputError):
                several = [classes[class_index(name.strip(), classes) - 1] for name in target.split(",")]
                foveal = options.how == "fovea" or options.start is not None or options.shifts is not None
                if len(several) > 1 and foveal:
                    return dict.fromkeys(several, 1.0)
                if len(several) > 1:
                    way = "; a search is for one class, `semfov find` takes several, and --how fovea any of them"
            raise InputError(f"{error}{way}") from None
    vectors = WordVectors.read(options.embeddings, [target, *classes])
    weights = spread(target, classes, vectors)
    print(f"“{target}” may mean: {', '.join(f'{name} {weight:.2f}' for name, weight in weights.items())}")
    if vectors.missing:
        print(f"  words without a vector in {options.embeddings}: {', '.join(vectors.missing)}")
    return weights
