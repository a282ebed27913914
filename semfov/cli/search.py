"""Subcommands that look at pictures: search, find and explore."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import nullcontext, redirect_stdout, suppress
from dataclasses import fields, replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Literal, TextIO, get_args, get_type_hints

import torch

from semfov.agent import ActivePerception
from semfov.agents.picture import PictureLike
from semfov.belief.grid import Grid
from semfov.cli.agent import detector_classes, make_agent, several_classes
from semfov.cli.episodes import PictureJob, look_at_pictures
from semfov.cli.options import Drawing, ExploreOptions, FindOptions, PictureOptions, SearchOptions, start_of
from semfov.cli.results import STDOUT, kind_of
from semfov.cli.sources import PictureSource
from semfov.data.classes import class_index
from semfov.data.word_vectors import WordVectors, spread
from semfov.errors import InputError, check, check_options, lookup
from semfov.io.files import check_writable
from semfov.paths import Record
from semfov.report.page import page_path


def _start_beside(agent: ActivePerception, source: PictureSource, seed: int) -> int | None:
    """A random first cell off the target of an embedded scene; None for other pictures."""
    if source.scene is None or source.boxes is None:
        return None
    grid = Grid(agent.columns, agent.rows, (source.scene.image.shape[-1], source.scene.image.shape[-2]))
    free = (~grid.footprint(source.boxes).any(0)).nonzero()[:, 0]
    generator = torch.Generator().manual_seed(seed)
    return int(free[torch.randint(len(free), (1,), generator=generator)]) if len(free) else None


class _SearchJob(PictureJob):
    """Searches pictures for a class."""

    drawings = get_args(Drawing)

    def __init__(self, options: SearchOptions, agent: ActivePerception | None = None) -> None:
        super().__init__(options)
        if not options.target:
            name = options.detector if options.models is None else options.models
            raise InputError(f"target: expected a class, --target cup, got none; `semfov detectors {name}` lists them")
        self.start = _check(options)
        classes = detector_classes(options) if agent is None else agent.classes[1:]
        weights = None if classes is None else _meant(options, classes)
        self.agent = make_agent(options) if agent is None else agent
        self.weights = _meant(options, self.agent.classes[1:]) if weights is None else weights
        self.target = next(iter(self.weights))
        self.title = f"search for “{self.target}”"

    def depends_on(self) -> dict[str, Any]:
        """What outcomes depend on, with the classes that word vectors tell."""
        return {**super().depends_on(), "weights": self.weights}

    def look(self, picture: PictureLike, shared: dict[str, Any], source: PictureSource) -> Record:
        """Search a picture."""
        agent, options, weights = self.agent, self.options, self.weights
        settings = {name: getattr(options, name) for name in ("confirm", "give_up", "closer", "seed")}
        foveal = len(weights) > 1 or self.start is not None or shared.get("shifts") is not None
        kind = agent.kind_of_look(picture, shared["how"], foveal=foveal)
        if kind != "fovea" and len(weights) > 1:
            print(f"large pictures and scenes are searched only for the most likely class: {next(iter(weights))}",
                  file=sys.stderr)  # fmt: skip
        aim = weights if kind == "fovea" and len(weights) > 1 else next(iter(weights))
        beside = self.start is None and kind == "fovea"
        start = _start_beside(agent, source, options.seed) if beside else self.start
        return agent.search(picture, aim, start=start, **settings, **shared)


class _FindJob(PictureJob):
    """Finds all objects in pictures."""

    every = True

    def __init__(self, options: FindOptions, agent: ActivePerception | None = None) -> None:
        if options.start is not None:
            raise InputError(
                f"start: expected none for find, which begins with the whole picture, got {options.start!r}"
            )
        super().__init__(options)
        _check(options)
        several_classes(options.target, detector_classes(options) if agent is None else None)
        self.agent = make_agent(options) if agent is None else agent
        self.targets = several_classes(options.target, self.agent.classes[1:])
        self.target = None if self.targets is None else self.targets[0]
        self.title = f"all objects{': ' if self.targets else ''}{', '.join(self.targets or [])}"

    def look(self, picture: PictureLike, shared: dict[str, Any], source: PictureSource) -> Record:
        """Find all objects in a picture."""
        settings = {name: getattr(self.options, name) for name in ("worth", "least", "batch")}
        return self.agent.find_all(picture, self.targets, **settings, **shared)


class _ExploreJob(PictureJob):
    """Explores pictures."""

    title = "exploration"

    def __init__(self, options: ExploreOptions, agent: ActivePerception | None = None) -> None:
        super().__init__(options)
        self.start = _check(options)
        if agent is None:
            detector_classes(options)
        self.agent = make_agent(options) if agent is None else agent

    def look(self, picture: PictureLike, shared: dict[str, Any], source: PictureSource) -> Record:
        """Explore a picture."""
        settings = {name: getattr(self.options, name) for name in ("seed", "worth", "least")}
        return self.agent.explore(picture, start=self.start, **settings, **shared)


_JOBS: dict[type[PictureOptions], Callable[..., PictureJob]] = {
    SearchOptions: _SearchJob,
    FindOptions: _FindJob,
    ExploreOptions: _ExploreJob,
}

_TASKS: dict[str, type[PictureOptions]] = {"search": SearchOptions, "find": FindOptions, "explore": ExploreOptions}

_turn = threading.Lock()
"""Calls of several threads take turns: a process has one job, and one standard output."""


def look_at(options: PictureOptions, stream: TextIO) -> int:
    """Search pictures, find all objects in them or explore them, as the options say; returns the exit code."""
    options = _with_target(options)
    return int(any("error" in row for row in look_at_pictures(_JOBS[type(options)](options), stream)))


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

    A picture that cannot be read is left out, with its `error`. With `out=`, a call that was stopped continues where it
    was when the same call is made again.

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
    kind = _TASKS[lookup(task, _TASKS, "task")]
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
            return look_at_pictures(_JOBS[kind](settings, made), stream)


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


def _meant(options: SearchOptions, classes: tuple[str, ...]) -> dict[str, float]:
    """The classes that a target may mean, each with a weight, the most likely first."""
    target = options.target or ""
    try:
        return {classes[class_index(target, classes, "target") - 1]: 1.0}
    except InputError as error:
        if options.embeddings is None:
            raise InputError(f"{error}{_other_ways(target, classes, str(error))}") from None
    vectors = WordVectors.read(options.embeddings, [target, *classes])
    weights = spread(target, classes, vectors)
    print(f"“{target}” may mean: {', '.join(f'{name} {weight:.2f}' for name, weight in weights.items())}")
    if vectors.missing:
        print(f"  words without a vector in {options.embeddings}: {', '.join(vectors.missing)}")
    return weights


def _other_ways(target: str, classes: tuple[str, ...], refused: str) -> str:
    """What else a target that is no class can be, after the message that refuses it."""
    names = target.split(",")
    with suppress(InputError):
        if len([class_index(name.strip(), classes) for name in names]) > 1:
            return "; a search is for one class, and `semfov find` takes several"
    return "" if "did you mean" in refused else "; a description needs --embeddings, a file of word vectors"
