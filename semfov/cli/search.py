"""Subcommands that look at pictures: search, find and explore."""

import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext, redirect_stdout
from dataclasses import fields, replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Literal, TextIO, get_args, get_type_hints

from tqdm import tqdm

from semfov.agent import ActivePerception
from semfov.cli.agent import detector_classes, note_of_detector, several_classes
from semfov.cli.jobs import ExploreJob, FindJob, PictureJob, SearchJob, make_again
from semfov.cli.options import AgentKind, ExploreOptions, FindOptions, PictureOptions, SearchOptions
from semfov.cli.outcome import PictureOutcome
from semfov.cli.results import held_outputs, tell_continuing
from semfov.cli.sources import EXAMPLE
from semfov.cli.totals import found_in_all
from semfov.cli.written import PictureFiles
from semfov.errors import InputError, SemfovError, check, check_options, lookup, rename_former
from semfov.io.files import is_pattern
from semfov.paths.conversion import Values
from semfov.runs.workers import Where, run_tasks
from semfov.threads import available_cores

_TASKS: dict[str, tuple[type[PictureOptions], type[PictureJob[PictureOptions]]]] = {
    "search": (SearchOptions, SearchJob),
    "find": (FindOptions, FindJob),
    "explore": (ExploreOptions, ExploreJob),
}

_turn = threading.Lock()  # calls of several threads take turns: a process has one job, and one standard output


def look_at(options: PictureOptions, stream: TextIO) -> int:
    """Search pictures, find all objects in them or explore them.

    Args:
        options: the options of one of the commands.
        stream: standard output, which takes results with `--out -`.

    Returns:
        The exit code, 1 if a picture was left out.
    """
    job = next(job for kind, job in _TASKS.values() if isinstance(options, kind))
    rows = _look_at_pictures(job(with_target(options)), stream)
    return int(any("error" in row for row in rows))


def with_target(options: PictureOptions) -> PictureOptions:
    """Read the target from the list of pictures, as in `semfov search kitchen.jpg cup`.

    Args:
        options: the options of a command.

    Returns:
        The options, with the target if exactly one word among the pictures can be one.
    """
    if not isinstance(options, SearchOptions | FindOptions) or options.target is not None:
        return options
    words = [name for name in options.pictures if _may_be_class(name)]
    pictures = tuple(name for name in options.pictures if name not in words)
    if len(words) != 1 or not pictures:
        return options
    try:
        # The names of some files are known only after they are loaded; then the word is taken for a class.
        several_classes(words[0], detector_classes(options))
    except InputError:
        return options  # it is refused as a picture that is not there, with the way to name a class
    return replace(options, target=words[0], pictures=pictures)


def _may_be_class(name: str) -> bool:
    """Tell whether a word among the pictures looks like a class: no path, no pattern, no file, and no example."""
    is_bare = Path(name).name == name and not Path(name).suffix and not name.startswith(EXAMPLE)
    return is_bare and not os.path.lexists(name) and not is_pattern(name)


def run(
    pictures: str | PathLike[str] | Sequence[str | PathLike[str]],
    target: str | Sequence[str] | None = None,
    *,
    task: Literal["search", "find", "explore"] = "find",
    agent: ActivePerception | AgentKind = "recommended",
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
    names = _names_of(pictures)
    positional = ("pictures", "target", "agent", "quiet", "stream")
    names_of_options = [setting.name for setting in fields(kind) if setting.name not in (*positional, *kind.unused)]
    rename_former(options, names_of_options)
    check_options(options, names_of_options, f"semfov {task}")
    has_target = task != "search" or target is not None
    check(has_target, "target", "a class to search for; task='find' finds all objects", target)
    values = _as_settings(options, kind)
    made_agent = None
    if isinstance(agent, ActivePerception):
        made_agent = agent
        _check_agent_is_made(options)
    else:
        values["agent"] = agent
    if target is not None:
        values["target"] = ",".join(_classes_of(target))
    settings = kind(pictures=names, quiet=quiet, **values)
    with _turn, open(os.devnull, "w", encoding="utf-8") as nothing:
        stream = sys.stdout
        with redirect_stdout(nothing) if quiet else nullcontext():
            return _look_at_pictures(job(settings, made_agent), stream)


def _names_of(pictures: str | PathLike[str] | Sequence[str | PathLike[str]]) -> tuple[str, ...]:
    """Check the names of files, folders and patterns."""
    listed = [pictures] if isinstance(pictures, str | PathLike) else list(pictures)
    expected = "files, folders or patterns (the methods of an agent take arrays and Pillow images)"
    check(bool(listed), "pictures", expected, "none")
    check(all(isinstance(name, str | PathLike) for name in listed), "pictures", expected, type(listed[0]).__name__)
    return tuple(fspath(name) for name in listed)


def _classes_of(target: str | Sequence[str]) -> Sequence[str]:
    """Check the names of the classes of a target."""
    names = [target] if isinstance(target, str) else target
    are_names = isinstance(names, Sequence) and all(isinstance(name, str) for name in names)
    check(are_names, "target", "the name of a class, or several in a list", target)
    return names


def _as_settings(options: Mapping[str, Any], kind: type[PictureOptions]) -> dict[str, Any]:
    """Bring the options of a call to the types that the command has: paths, and one figure or cell as it is written."""
    hints = get_type_hints(kind)
    values = dict(options)
    for name, value in options.items():
        if value is not None and Path in get_args(hints[name]):
            values[name] = Path(value)
    # A tuple of one figure or one cell is written in Python as the command has it.
    if isinstance(values.get("draw"), str):
        values["draw"] = (values["draw"],)
    if isinstance(values.get("start"), str):
        values["start"] = _start_of(values["start"])
    return values


def _start_of(text: str) -> int | tuple[int, ...]:
    """Read a cell by its number, `5`, or by its column and row, `3,2`."""
    numbers = tuple(int(number) for number in text.strip("()[] ").split(","))
    return numbers if len(numbers) > 1 else numbers[0]


def _check_agent_is_made(options: Mapping[str, Any]) -> None:
    """Raise `InputError` for options that have no place beside an agent that is made already."""
    for name in ("detector", "weights", "models", "classes", "device", "half", "sensor"):
        if name in options:
            raise InputError(f"{name}: expected none beside an agent that is made already, got {options[name]}")
    is_one = options.get("workers", 1) == 1 and options.get("scheduler") is None
    check(is_one, "workers", "1 for an agent that is made already", options.get("workers"))


def _look_at_pictures(job: PictureJob[PictureOptions], stream: TextIO) -> list[Values]:
    """Look at all pictures, print the outcomes, and write the files that the options name; `--out -` is the stream."""
    job.check_drawings()
    with held_outputs(job.options):  # no other command writes the same files meanwhile
        return _look_and_write(job, stream)


def _look_and_write(job: PictureJob[PictureOptions], stream: TextIO) -> list[Values]:
    """Look at all pictures, and write what is known of those so far, whenever the command ends."""
    if not job.options.pictures:
        job.sources[0].tell_example()
    print(note_of_detector(job.options), end="")
    files = PictureFiles(job, stream)
    before = files.take_up()
    tell_continuing(len(before), len(job.sources))
    numbers = [number for number in range(len(job.sources)) if number not in before]
    endings = Counter(before.values())
    faults = list[SemfovError]()
    complete = False
    try:
        for number, outcome in _outcomes(job, numbers):
            written = files.write_figures(number, outcome)
            if isinstance(written, SemfovError):
                _skip(job, files, number, written)
                faults.append(written)
            else:
                files.add(number, written)
                tqdm.write(written.text, file=sys.stdout)
                endings[written.ended] += 1
        complete = True
    finally:
        # Also after Ctrl-C: the results so far are written, and the same command continues.
        if files.rows:
            files.finish(complete=complete)
    if not endings and all(isinstance(fault, InputError) for fault in faults):
        raise faults[0]  # what no picture can be looked at with is a wrong argument
    if job.several:
        print(_totals(files, endings, len(faults)), end="")
    return [files.rows[number] for number in range(len(job.sources))]


def _totals(files: PictureFiles, endings: Counter[str], skipped: int) -> str:
    """Say how all pictures ended, what was found in them, how many were skipped, and what the searches assume."""
    totals = [
        ", ".join(f"{times} {name}" for name, times in endings.items()),
        found_in_all(files.job, files.rows.values()),
    ]
    if skipped:
        totals.append(f"{skipped} skipped")
    return f"{len(files.job.sources)} pictures: {'; '.join(filter(None, totals))}\n{_assumed_in_all(files)}"


def _assumed_in_all(files: PictureFiles) -> str:
    """Say how many pictures the probabilities of searches assume to hold the target; empty where it is not known."""
    shares = {row["assumed"] for row in files.rows.values() if row.get("assumed") is not None}
    if len(shares) != 1:
        return ""
    (share,) = shares
    how_many = "half" if share == 0.5 else f"{100 * share:.3g} %"
    options = files.job.options
    is_given = isinstance(options, SearchOptions) and options.prior is not None
    hint = "" if is_given else " If you know better, give `semfov search --prior`."
    return f"The probabilities assume that {how_many} of the pictures hold it.{hint}\n"


def _skip(job: PictureJob[PictureOptions], files: PictureFiles, number: int, fault: SemfovError) -> None:
    """Leave out one picture of several, and say why; the fault of a single picture is raised."""
    if not job.several:
        raise fault
    job.sources[number].tell_skipped(fault)
    files.skip(number, str(fault))


def _outcomes(
    job: PictureJob[PictureOptions], numbers: list[int]
) -> Iterator[tuple[int, PictureOutcome | SemfovError]]:
    """Yield the outcomes of pictures of some numbers, with these, as they are made."""
    if not job.several:
        yield 0, job.outcome(0)
        return
    options = job.options
    where: Where = options.workers if options.scheduler is None else options.scheduler
    if options.scheduler is None and options.workers != 1:
        # A process takes as long to start as this one has taken so far. The first picture that can be looked at tells
        # whether that pays: a damaged one takes no time.
        start = time.process_time()
        seconds = 0.0
        while numbers:
            began = time.process_time()
            first = numbers.pop(0)
            outcome = job.outcome(first)
            seconds = time.process_time() - began
            yield first, outcome
            if not isinstance(outcome, SemfovError):
                break
        where = _worth_starting(options.workers, len(numbers), seconds, start)
    yield from run_tasks(
        PictureJob.outcome,
        numbers,
        where=where,
        make=make_again,
        settings=(type(job), options),
        made=job,
        title="pictures",
        unit="picture",
        hidden=options.quiet,
    )


def _worth_starting(processes: int | None, tasks: int, seconds: float, start: float) -> int:
    """Choose the number of processes for tasks of some seconds; 1 where to start them takes longer than they save."""
    most = min(available_cores() if processes is None else processes, tasks)
    if most <= 1:
        return 1
    # Alone the tasks take `tasks * seconds`, and shared out the `most`-th part of it.
    seconds_saved = tasks * seconds * (1 - 1 / most)
    return most if seconds_saved > start else 1
