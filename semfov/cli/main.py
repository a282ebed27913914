"""Entry point of the command `semfov`."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from semfov.cli import help as texts
from semfov.cli.options import DetectorsOptions, ExploreOptions, FindOptions, GazeOptions, LiveOptions, SearchOptions
from semfov.runs.command import GOES_ON, make_parser, run_command
from semfov.version import __version__


@dataclass(frozen=True)
class _Subcommand:
    """A subcommand."""

    text: str
    options: Callable[[], type[Any]]
    run: Callable[[Any], int | None]
    positional: tuple[str, str]
    goes_on: str = ""


def _pictures(options: Any) -> int:
    from semfov.cli.search import look_at

    return look_at(options)


def _live(options: Any) -> int:
    from semfov.cli.live import look_live

    return look_live(options)


def _gaze(options: Any) -> int:
    from semfov.cli.gaze import predict_gaze

    return predict_gaze(options)


def _fit_options() -> type[Any]:
    from semfov.fit.detector_settings import FitDetectorConfig

    return FitDetectorConfig


def _fit(options: Any) -> None:
    from semfov.fit.detector import fit_folder

    fit_folder(options)


def _detectors(options: Any) -> int:
    from semfov.cli.detectors import list_detectors

    return list_detectors(options)


_PICTURES = ("pictures", "photographs, large pictures, or folders of them (none: an embedded scene)")
_MODEL = ("model", "the detector: a name or a file, as for semfov.load_detector")

_SUBCOMMANDS: dict[str, _Subcommand] = {
    "search": _Subcommand(texts.SEARCH, lambda: SearchOptions, _pictures, _PICTURES),
    "find": _Subcommand(texts.FIND, lambda: FindOptions, _pictures, _PICTURES),
    "explore": _Subcommand(texts.EXPLORE, lambda: ExploreOptions, _pictures, _PICTURES),
    "live": _Subcommand(texts.LIVE, lambda: LiveOptions, _live, ("source", "video file, or address")),
    "gaze": _Subcommand(texts.GAZE, lambda: GazeOptions, _gaze, _PICTURES),
    "fit": _Subcommand(texts.FIT, _fit_options, _fit, _MODEL, GOES_ON),
    "detectors": _Subcommand(
        texts.LIST_DETECTORS, lambda: DetectorsOptions, _detectors, ("name", "detector, or folder of models")
    ),
}
"""The subcommands by name. What they need is imported when they run."""

_LOOKING = "search", "find", "explore", "live"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    command_line = list(sys.argv[1:] if arguments is None else arguments)
    if command_line[:1] == ["help"]:
        command_line = [*command_line[1:2], "--help"]
    name, *rest = command_line or ["--help"]
    if name in ("--version", "-V"):
        print(f"semfov {__version__}")
        return 0
    if name in ("--help", "-h", "--help-all"):
        print(texts.OVERVIEW, end="")
        return 0
    refused = _of_other_commands(_SUBCOMMANDS[name], rest) if name in _SUBCOMMANDS else _unknown(name)
    if refused is not None:
        print(f"error: {refused}", file=sys.stderr)
        return 2
    command = _SUBCOMMANDS[name]
    if "--help" in rest or "-h" in rest:
        print(command.text, end="")
        return 0
    options, program = command.options(), f"semfov {name}"
    if "--help-all" in rest or "--help_all" in rest:
        usage = command.text.partition("\nusage:")[0]
        make_parser(options, usage, command.positional, program).print_help()
        return 0
    words = partial(texts.in_command_words, options=[field.name for field in fields(options)])
    names: dict[str, Any] = {"positional": command.positional, "program": program, "goes_on": command.goes_on}
    with _plain_warnings(words):
        return run_command(command.run, options, command.text, rest, words=words, **names)


def _unknown(name: str) -> str:
    """What to type instead of a name that is no subcommand."""
    if Path(name).exists():
        return f"expected a command before {name!r}; try `semfov search {name} --target CLASS`"
    if name.startswith("-"):
        return f"expected a command before {name}: {', '.join(_SUBCOMMANDS)}"
    near = get_close_matches(name, _SUBCOMMANDS, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(_SUBCOMMANDS)}"
    return f"unknown command {name!r}; {hint}"


def _of_other_commands(command: _Subcommand, rest: Sequence[str]) -> str | None:
    """What to say about an option that only other subcommands have; None if there is none."""
    for word in rest:
        option = word[2:].partition("=")[0].replace("-", "_") if word.startswith("--") else ""
        having = [
            name for name in _LOOKING if option in _options(_SUBCOMMANDS[name]) and option not in _options(command)
        ]
        if having and command in map(_SUBCOMMANDS.get, _LOOKING):
            return f"unknown option --{option.replace('_', '-')}; it is one of `semfov {'` and `semfov '.join(having)}`"
    return None


def _options(command: _Subcommand) -> set[str]:
    """Names of the options of a subcommand."""
    return {field.name for field in fields(command.options())} - {command.positional[0]}


@contextmanager
def _plain_warnings(words: Callable[[str], str]) -> Iterator[None]:
    """Print each warning as one line in the words of the command, without the place in the code."""

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        print(f"warning: {words(str(message))}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield
