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
from itertools import pairwise
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING

from semfov.cli.commands import OVERVIEW, SUBCOMMANDS
from semfov.version import __version__
from semfov.words import (
    ADVICE,
    ADVICE_FOR_BOXES,
    ADVICE_OF,
    COMMANDS,
    FORMER,
    NEGATIONS,
    OPTIONS,
    SHORT,
    SWITCHED_OFF,
    dashed,
    meant_options,
    note_of_former,
    parts_of,
)

if TYPE_CHECKING:
    from semfov.runs.settings import Settings

_LOOKING = tuple(name for name, command in SUBCOMMANDS.items() if command.looking)
"""Subcommands that look at pictures or frames."""


def _options_of(name: str) -> "type[Settings]":
    """Import the options of a subcommand when they are asked for: help and mistakes need no tensors."""
    return resolve_name(f"semfov.{SUBCOMMANDS[name].options}")


def _run(name: str, options: "Settings") -> int | None:
    """Run a subcommand, without its texts if it is to be quiet, or with them beside results in standard output."""
    command = SUBCOMMANDS[name]
    stream = sys.stdout
    # With `--out -` programs read the results in standard output, where no text may be among them.
    texts = sys.stderr if str(getattr(options, "out", None)) == "-" else stream
    with ExitStack() as stack:
        nowhere = stack.enter_context(open(os.devnull, "w", encoding="utf-8"))
        stack.enter_context(redirect_stdout(nowhere if getattr(options, "quiet", False) else texts))
        # What it needs is imported now.
        run: Callable[..., int | None] = resolve_name(f"semfov.{command.function}")
        return run(options, stream) if command.writes_rows else run(options)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: the words after `semfov`; None for those of this process.

    Returns:
        The exit code.
    """
    if isinstance(sys.stdout, TextIOWrapper):
        # Files of Windows may have another encoding, without the signs of a text or the letters of a picture's name.
        sys.stdout.reconfigure(errors="backslashreplace")
    name, *rest = _in_usual_order(sys.argv[1:] if arguments is None else arguments)
    text = _text(name, rest)
    if text is not None:
        print(text, end="")
        return 0
    if name not in SUBCOMMANDS:
        return _refuse(_unknown(name))
    rest = _with_present_names(name, rest)
    refusal = _of_others(name, rest)
    if refusal is not None:
        return _refuse(refusal)
    if {"--help-all", "--help_all"}.intersection(rest):
        _print_all_options(name)
        return 0
    return _parse_and_run(name, rest)


def _in_usual_order(words: Sequence[str]) -> Sequence[str]:
    """Write `semfov help NAME` as `semfov NAME --help`; without words it asks for help, too."""
    if list(words[:1]) == ["help"]:
        words = [*words[1:2], "--help"]
    return words or ["--help"]


def _refuse(message: str) -> int:
    """Print what is wrong with a command line; returns the exit code."""
    print(f"error: {message}", file=sys.stderr)
    return 2


def _positional(name: str) -> tuple[str, str] | None:
    """Find the setting of a subcommand that has no option before it, and its help; None where all have."""
    command = SUBCOMMANDS[name]
    return None if command.positional is None else (command.positional, command.positional_help)


def _print_all_options(name: str) -> None:
    """Print the help of a subcommand with all of its options."""
    from semfov.runs.command import make_parser

    description = SUBCOMMANDS[name].help.partition("\nusage:")[0]
    make_parser(_options_of(name), description, _positional(name), f"semfov {name}").print_help()


def _parse_and_run(name: str, rest: Sequence[str]) -> int:
    """Read the options of a subcommand, and run it; returns the exit code."""
    from semfov.errors import printable
    from semfov.runs.command import run_command

    words = partial(_in_command_words, options=_message_options(name))
    with warnings.catch_warnings():  # each is one line in the words of the command, without the place in the code
        warnings.showwarning = lambda message, *_, **__: print(
            f"warning: {printable(words(str(message)))}", file=sys.stderr
        )
        return run_command(
            partial(_run, name),
            _options_of(name),
            SUBCOMMANDS[name].help,
            rest,
            positional=_positional(name),
            program=f"semfov {name}",
            words=words,
            goes_on=name == "fit",
        )


def _text(name: str, rest: Sequence[str]) -> str | None:
    """Find the text of a command line that asks for one: the version, help, or the script of a shell."""
    if name in ("--version", "-V", "version"):
        return f"semfov {__version__}\n"
    if name in ("--help", "-h", "--help-all"):
        return OVERVIEW
    if name == "completion":
        return _completion("".join(rest[:1]), {command: _option_names(command) for command in SUBCOMMANDS})
    if name in SUBCOMMANDS and {"--help", "-h"}.intersection(rest):
        return SUBCOMMANDS[name].help
    return None


_BASH = """\
_semfov() {{
  local words=""
  case "${{COMP_WORDS[1]}}" in
{cases}
  esac
  if [ "$COMP_CWORD" -eq 1 ]; then words="{commands}"; fi
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o bashdefault -o default -F _semfov semfov
"""

_SHELLS = {
    "bash": _BASH,
    # zsh reads scripts of bash once it is told to.
    "zsh": f"autoload -Uz compinit bashcompinit && compinit && bashcompinit\n{_BASH}",
    "fish": """\
complete -c semfov -n __fish_use_subcommand -a "{commands}"
{lines}
""",
}
"""Scripts of shells that complete commands and options."""


def _completion(shell: str, options: Mapping[str, Iterable[str]]) -> str:
    """Write the script with which a shell completes the command.

    Args:
        shell: `bash`, `zsh` or `fish`; empty where none is named.
        options: names of the options of each subcommand.

    Returns:
        The script; how to ask for one, where it is no such shell.
    """
    script = _SHELLS.get(shell)
    if script is None:
        return "usage: semfov completion bash|zsh|fish, for example: semfov completion bash >> ~/.bashrc\n"
    bash_cases = []
    fish_lines = []
    for command, names in options.items():
        words = [dashed(name) for name in names]
        completions = " ".join(f"--{word}" for word in words)
        bash_cases.append(f'    {command}) words="{completions}";;')
        fish_start = f'complete -c semfov -n "__fish_seen_subcommand_from {command}" -l'
        fish_lines += [f"{fish_start} {word}" for word in words]
    cases = "\n".join(bash_cases)
    lines = "\n".join(fish_lines)
    return script.format(cases=cases, commands=" ".join(options), lines=lines)


def _unknown(name: str) -> str:
    """Say what to type instead of a name that is no subcommand."""
    if Path(name).exists() and name not in COMMANDS:
        return f"expected a command before {name!r}; try `semfov search {name} --target CLASS`"
    if name.startswith("-"):
        return f"expected a command before {name}: {', '.join(SUBCOMMANDS)}"
    matches = [COMMANDS[name]] if name in COMMANDS else get_close_matches(name, SUBCOMMANDS, n=1)
    hint = f"did you mean {matches[0]!r}?" if matches else f"known: {', '.join(SUBCOMMANDS)}"
    hint = ADVICE.get(name.replace("-", "_"), hint)
    return f"unknown command {name!r}; {hint}"


def _option_names(name: str) -> list[str]:
    """Names of the options of a subcommand, without the positional one."""
    options = _options_of(name)
    no_options = {SUBCOMMANDS[name].positional, *options.unused}
    return [field.name.rstrip("_") for field in fields(options) if field.name not in no_options]  # `try_` is --try


def _message_options(name: str) -> list[str]:
    """List the options that messages may name; those of `semfov fit` for a detector are dotted."""
    names = [field.name for field in fields(_options_of(name))]
    if name != "fit":
        return names
    detector = resolve_name("semfov.runs.config:DetectorConfig")
    names_of_detector = [field.name for field in fields(detector)]
    return [*(f"detector.{setting}" for setting in names_of_detector if setting not in names), *names]


def _with_present_names(command: str, words: Sequence[str]) -> list[str]:
    """Replace earlier names of options by the present ones, each with a note."""
    known = _option_names(command)
    renamed = []
    for word in words:
        option, equals, value = word.partition("=")
        present = FORMER.get(option.removeprefix("--").replace("-", "_"), "")
        if option.startswith("--") and present in known:
            present_option = f"--{dashed(present)}"
            print(f"note: {note_of_former(option, present_option)}", file=sys.stderr)
            word = present_option + equals + value
        renamed.append(word)
    return renamed


def _of_others(command: str, words: Sequence[str]) -> str | None:
    """Say what is wrong with an option that other subcommands or other programs have; None if there is none."""
    options = [word[2:].partition("=")[0].replace("-", "_") for word in words if word.startswith("--")]
    refusals = (_refusal(command, option) for option in options)
    return next(filter(None, refusals), None) or _one_letter(command, words) or _without_dashes(command, words)


def _one_letter(command: str, words: Sequence[str]) -> str | None:
    """Say what is meant by an option of one letter, of which there are none; None if no word is one."""
    letters = (word[1] for word in words if re.fullmatch("-[a-z]", word))
    meant = ((letter, option) for letter in letters for option in SHORT.get(letter, "").split())
    positional = SUBCOMMANDS[command].positional
    for letter, option in meant:
        if option in _option_names(command):
            return f"unknown option -{letter}; did you mean --{dashed(option)}?"
        if positional in ("pictures", "source") and option == "picture":  # what is looked at, which may be a stream
            return _without_option(command, f"-{letter}", positional)
    return None


def _without_dashes(command: str, words: Sequence[str]) -> str | None:
    """Say how an option is written that stands as NAME=VALUE, as in other programs; None if there is none."""
    # The value of an option may have this form, too.
    others = [word for before, word in pairwise(["", *words]) if not before.startswith("-")]
    refusals = (_refusal_of_assignment(command, word) for word in others)
    return next(filter(None, refusals), None)


def _refusal_of_assignment(command: str, word: str) -> str | None:
    """Say how the option is written that a word means, NAME=VALUE; None for others, which the names of files may be."""
    name, equals, value = word.partition("=")
    # `exists` takes a word that is too long for the name of a file, too.
    if word.startswith("-") or not equals or os.path.exists(word):
        return None
    option = name.replace("-", "_")
    if option in _option_names(command):
        return f"expected --{dashed(option)} {value}, got {word}"
    is_of_others = not OPTIONS.keys().isdisjoint((option, *parts_of(option)))
    if option == SUBCOMMANDS[command].positional or is_of_others:
        return _refusal(command, option) or f"expected options with two dashes, --NAME VALUE, got {word}"
    return None


def _refusal(command: str, option: str) -> str | None:
    """Say what is wrong with one option of a subcommand; None where the parser says it, or nothing is wrong."""
    positional = SUBCOMMANDS[command].positional
    if positional is None:
        return None
    if (command, option) == ("fit", "detector"):
        # The parts of the detector are options of `semfov fit`: detector.name and others.
        return _without_option(command, f"--{option}", positional)
    if not option or option in _option_names(command):
        return None
    if _means_positional(option, positional):
        return _without_option(command, f"--{option}", positional)
    # The parser lists all options of the other subcommands, which have few.
    is_advised = command in (*_LOOKING, "gaze", "app", "compare")
    return _meant_instead(command, option) if is_advised else None


def _without_option(command: str, option: str, positional: str) -> str:
    """Say that what a subcommand is for stands after its name, without an option."""
    singular = positional.removesuffix("s")
    usage = f"semfov {command} {singular.upper()}"
    return f"unknown option {option}; the {singular} has no option before it: {usage}"


def _means_positional(option: str, positional: str) -> bool:
    """Tell whether an option is how other programs ask for what a subcommand takes without one."""
    meanings = {option, option.removesuffix("s"), *OPTIONS.get(option, "").split()}
    return not meanings.isdisjoint({positional, positional.removesuffix("s")})


def _meant_instead(command: str, option: str) -> str | None:
    """Say which option is meant by an unknown one, or which subcommands have it; None where neither is known."""
    unknown = f"unknown option --{dashed(option)}"
    remedy = _remedy(command, option) or _switched_off(command, option)
    if remedy:
        return f"{unknown}; {remedy}"
    having = _having(option)
    if having:
        return f"{unknown}; it is one of {having}"
    if option in OPTIONS or get_close_matches(option, _option_names(command), cutoff=0.7):
        return None  # the parser names the similar one, if there is one
    remedies = filter(None, (_remedy(command, part) for part in parts_of(option)))
    return next((f"{unknown}; {remedy}" for remedy in remedies), None)


def _switched_off(command: str, option: str) -> str | None:
    """Say how to ask for the opposite of an option, as `--no-closer` does elsewhere; None for all other words."""
    negation, _, positive = option.partition("_")
    if negation not in NEGATIONS or not positive:
        return None
    if positive in _option_names(command):
        return f"use {SWITCHED_OFF[positive]}" if positive in SWITCHED_OFF else f"leave --{dashed(positive)} out"
    having = _having(positive)
    # Other advice says how to do what is not wanted here.
    return f"--{dashed(positive)} is one of {having}" if having else ADVICE_FOR_BOXES.get(positive)


def _having(option: str) -> str:
    """List the subcommands that have an option; empty if none has."""
    return " and ".join(f"`semfov {name}`" for name in _LOOKING if option in _option_names(name))


def _remedy(command: str, word: str) -> str | None:
    """Say which option of a subcommand others call by a word, or what to do instead; None if it is not listed."""
    advice = ADVICE_OF.get(command, {}).get(word)
    meant = meant_options(word, _option_names(command))
    return advice or (f"did you mean --{dashed(meant[0])}?" if meant else None)


_RENAME = "give them these names in its first line (`semfov check` takes --columns x=THEIRS,y=THEIRS, too)"

_COMMANDS = {
    "agent.classes lists": "`semfov detectors NAME` lists",
    "ActivePerception.from_pretrained('mymodels')": "--models mymodels",
    "ActivePerception.recommended": "--agent recommended",
    "ActivePerception.raw": "--agent raw",
    " or semfov.fit_detector": "",
    "find_all": "`semfov find`",
    "name them by columns={…}": _RENAME,
    "name its column by columns={…}": "name the picture's column by --columns",
}
"""What the command calls that messages name as Python does."""


def _in_command_words(message: str, options: Iterable[str]) -> str:
    """Say a message of the library in the words of the command: arguments become options."""
    # Whole calls first, whose parts are options, too.
    for python, command in _COMMANDS.items():
        message = message.replace(python, command)
    # Messages have the last part of a dotted name.
    by_name = {name.rpartition(".")[2]: name for name in options}
    names = "|".join(map(re.escape, by_name))

    def option(match: re.Match[str]) -> str:
        words = [f"--{dashed(by_name[match[1]])}"]
        # A flag that is set, `half=True`, has no value in a command.
        value = (match[2] or "").strip("'\"").removeprefix("True")
        if value:
            words.append(value)
        return " ".join(words)

    # Settings of other programs stay as they are.
    return re.sub(rf"(?<![\w.-])(?<!yolo export )({names})=('[^']*'|\"[^\"]*\"|[\w.]*\w)?", option, message)
