"""Entry point of the command `semfov`."""

import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import fields
from difflib import get_close_matches
from functools import partial
from io import TextIOWrapper
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from semfov.cli.help import HELP
from semfov.version import __version__
from semfov.words import OPTIONS, meant_options

_PICTURES = ("pictures", "photographs, large pictures, or folders of them (none: one that comes with semfov)")
_DETECTOR = "the detector: a name or a file, as for semfov.load_detector"

_SUBCOMMANDS: dict[str, tuple[tuple[str, str], str, str]] = {
    "search": (_PICTURES, "cli.options:SearchOptions", "cli.search:look_at"),
    "find": (_PICTURES, "cli.options:FindOptions", "cli.search:look_at"),
    "explore": (_PICTURES, "cli.options:ExploreOptions", "cli.search:look_at"),
    "live": (("source", "video file, or address"), "cli.options:LiveOptions", "cli.live:look_live"),
    "gaze": (_PICTURES, "cli.options:GazeOptions", "cli.gaze:predict_gaze"),
    "check": (("files", "files of fixations"), "cli.options:CheckOptions", "cli.fixations:check_fixations"),
    "fit": (("model", _DETECTOR), "fit.settings:FitDetectorConfig", "fit.detector:fit_folder"),
    "app": (("detector", _DETECTOR), "cli.options:AppOptions", "cli.app:serve"),
    "detectors": (("name", "detector, or folder of models"), "cli.options:DetectorsOptions", "cli.detectors:show"),
}
"""The positional argument of each subcommand with its text, its options, and what it calls."""

_LOOKING = "search", "find", "explore", "live"


def _options_of(name: str) -> type[Any]:
    """The options of a subcommand, imported when they are asked for: help and mistakes need no tensors."""
    return resolve_name(f"semfov.{_SUBCOMMANDS[name][1]}")


def _run(name: str, options: Any) -> int | None:
    """Run a subcommand, without its texts if it is to be quiet, or with them beside results in standard output."""
    stream, beside = sys.stdout, str(getattr(options, "out", None)) == "-"
    with ExitStack() as stack:
        nowhere = stack.enter_context(open(os.devnull, "w", encoding="utf-8"))
        quiet = getattr(options, "quiet", False)
        stack.enter_context(redirect_stdout(nowhere if quiet else sys.stderr if beside else stream))
        # What it needs is imported now.
        run: Callable[..., int | None] = resolve_name(f"semfov.{_SUBCOMMANDS[name][2]}")
        return run(options, stream) if name in ("search", "find", "explore") else run(options)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    command_line = list(sys.argv[1:] if arguments is None else arguments)
    if isinstance(sys.stdout, TextIOWrapper):
        # Files of Windows may have another encoding, without the signs of a text or the letters of a picture's name.
        sys.stdout.reconfigure(errors="backslashreplace")
    if command_line[:1] == ["help"]:
        command_line = [*command_line[1:2], "--help"]
    name, *rest = command_line or ["--help"]
    text = _text(name, rest)
    if text is not None:
        print(text, end="")
        return 0
    refused = _of_others(name, rest) if name in _SUBCOMMANDS else _unknown(name)
    if refused is not None:
        print(f"error: {refused}", file=sys.stderr)
        return 2
    from semfov.runs.command import make_parser, run_command

    options, positional, program = _options_of(name), _SUBCOMMANDS[name][0], f"semfov {name}"
    if "--help-all" in rest or "--help_all" in rest:
        make_parser(options, HELP[name].partition("\nusage:")[0], positional, program).print_help()
        return 0
    words = partial(_in_command_words, options=_told_options(name))
    names: dict[str, Any] = {"positional": positional, "program": program, "goes_on": name == "fit"}
    with warnings.catch_warnings():  # each is one line in the words of the command, without the place in the code
        warnings.showwarning = lambda message, *_, **__: print(f"warning: {words(str(message))}", file=sys.stderr)
        return run_command(partial(_run, name), options, HELP[name], rest, words=words, **names)


def _text(name: str, rest: Sequence[str]) -> str | None:
    """The text of a command line that asks for one: the version, help, or the script of a shell."""
    if name in ("--version", "-V", "version"):
        return f"semfov {__version__}\n"
    if name in ("--help", "-h", "--help-all"):
        return HELP["semfov"]
    if name in _SUBCOMMANDS and ("--help" in rest or "-h" in rest):
        return HELP[name]
    if name == "completion":
        return _completion(rest[0] if rest else None, {each: _option_names(each) for each in _SUBCOMMANDS})
    return None


_SHELLS = {
    "bash": """\
_semfov() {{
  local words=""
  case "${{COMP_WORDS[1]}}" in
{cases}
  esac
  if [ "$COMP_CWORD" -eq 1 ]; then words="{commands}"; fi
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o bashdefault -o default -F _semfov semfov
""",
    "fish": """\
complete -c semfov -n __fish_use_subcommand -a "{commands}"
{lines}
""",
}
"""Scripts of shells that complete commands and options; that of zsh is that of bash."""


def _completion(shell: str | None, options: Mapping[str, Iterable[str]]) -> str:
    """The script with which a shell completes the command, from the options of each subcommand."""
    script = _SHELLS.get("bash" if shell == "zsh" else shell or "")
    if script is None:
        return "usage: semfov completion bash|zsh|fish, for example: semfov completion bash >> ~/.bashrc\n"
    named = {name: [each.replace("_", "-") for each in several] for name, several in options.items()}
    cases = "\n".join(f'    {name}) words="{" ".join(f"--{each}" for each in some)}";;' for name, some in named.items())
    lines = "\n".join(
        f'complete -c semfov -n "__fish_seen_subcommand_from {name}" -l {each}'
        for name, some in named.items()
        for each in some
    )
    start = "autoload -Uz compinit bashcompinit && compinit && bashcompinit\n" if shell == "zsh" else ""
    return start + script.format(cases=cases, commands=" ".join(named), lines=lines)


def _unknown(name: str) -> str:
    """What to type instead of a name that is no subcommand."""
    if Path(name).exists():
        return f"expected a command before {name!r}; try `semfov search {name} --target CLASS`"
    if name.startswith("-"):
        return f"expected a command before {name}: {', '.join(_SUBCOMMANDS)}"
    near = get_close_matches(name, _SUBCOMMANDS, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(_SUBCOMMANDS)}"
    return f"unknown command {name!r}; {hint}"


def _option_names(name: str) -> list[str]:
    """Names of the options of a subcommand, without the positional one."""
    options = _options_of(name)
    names = [field.name for field in fields(options) if field.name not in (_SUBCOMMANDS[name][0][0], *options.unused)]
    return [each.rstrip("_") for each in names]  # `try_` is --try


def _told_options(name: str) -> list[str]:
    """Names of the options that messages may name; those of `semfov fit` for a detector are dotted."""
    own = [field.name for field in fields(_options_of(name))]
    if name != "fit":
        return own
    detector = resolve_name("semfov.runs.config:DetectorConfig")
    return [*(f"detector.{field.name}" for field in fields(detector) if field.name not in own), *own]


def _of_others(own: str, rest: Sequence[str]) -> str | None:
    """What to say about an option that other subcommands or other programs have; None if there is none."""
    names = {each: set(_option_names(each)) for each in (*_LOOKING, own)}
    first = _SUBCOMMANDS[own][0][0]
    singular = first.removesuffix("s")
    for word in rest:
        option = word[2:].partition("=")[0].replace("-", "_") if word.startswith("--") else ""
        whole = (own, option) == ("fit", "detector")  # its parts are options, detector.name and others
        asked = {option, option.removesuffix("s"), *OPTIONS.get(option, "").split()}
        if whole or (option and option not in names[own] and asked & {first, singular}):
            return f"unknown option --{option}; the {singular} has no option before it: semfov {own} {singular.upper()}"
        if own not in (*_LOOKING, "gaze"):
            continue
        meant = next(iter(meant_options(option, names[own])), None)
        if meant is not None and option not in names[own]:
            return f"unknown option --{option.replace('_', '-')}; did you mean --{meant.replace('_', '-')}?"
        having = [each for each in _LOOKING if option in names[each] - names[own]]
        if having:
            return f"unknown option --{option.replace('_', '-')}; it is one of `semfov {'` and `semfov '.join(having)}`"
    return None


_RENAME = "give them these names in its first line (`semfov check` takes --columns x=THEIRS,y=THEIRS, too)"

_COMMANDS = {
    "agent.classes lists": "`semfov detectors NAME` lists",
    "ActivePerception.from_pretrained('mymodels')": "--models mymodels",
    "ActivePerception.recommended": "--agent recommended",
    "ActivePerception.raw": "--agent raw",
    " or semfov.fit_detector": "",
    "find_all": "`semfov find`",
    "name them by columns={…}": _RENAME,
    "use read_table with columns={…}": f"name its columns picture, subject, x, y, width and height: {_RENAME}",
}
"""What the command calls that messages name as Python does."""


def _in_command_words(message: str, options: Iterable[str]) -> str:
    """Say a message of the library in the words of the command: arguments become options."""
    for python, command in _COMMANDS.items():
        message = message.replace(python, command)
    by_name = {name.rpartition(".")[2]: name for name in options}
    names = "|".join(map(re.escape, by_name))

    def option(match: re.Match[str]) -> str:
        value = (match[2] or "").strip("'\"").removeprefix("True")
        return f"--{by_name[match[1]].replace('_', '-')}{' ' if value else ''}{value}"

    return re.sub(rf"(?<![\w.-])({names})=('[^']*'|\"[^\"]*\"|[\w.]*\w)?", option, message)
