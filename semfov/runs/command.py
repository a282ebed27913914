"""Command lines from dataclasses: help, YAML files, dotted overrides, exit codes."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
from argparse import SUPPRESS
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from functools import partial
from keyword import iskeyword
from pathlib import Path
from types import FrameType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    NoReturn,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from semfov.errors import InputError, SemfovError
from semfov.io.files import discard_unfinished
from semfov.runs.settings import Settings, check_settings, load_yaml

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

_Config = TypeVar("_Config", bound=Settings)

_GOES_ON = "; give the same command again to continue"
"""What is said about an interrupted command that keeps what it has finished."""

_PACKAGES = {"sklearn": "scikit-learn", "cv2": "opencv-python-headless", "yaml": "pyyaml", "PIL": "pillow",
             "jsonargparse": "'jsonargparse[signatures]'"}  # fmt: skip
"""Names under which packages are installed, where they are not those of their modules."""
_HANGUP = getattr(signal, "SIGHUP", signal.SIGTERM)
_ENDINGS: dict[int, str] = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", _HANGUP: "terminated"}
"""What is said after each signal: a terminal that closes ends a command (SIGHUP) as SIGTERM does."""


def make_parser(
    config: type[Settings],
    description: str | None,
    positional: tuple[str, str] | None = None,
    program: str | None = None,
) -> ArgumentParser:
    """Make a parser with an option for every field of `config` and `--config FILE.yaml`; nested fields are dotted."""
    import argparse

    import yaml
    from jsonargparse import ArgumentParser, DefaultHelpFormatter, set_loader, set_parsing_settings

    class Formatter(DefaultHelpFormatter, argparse.RawDescriptionHelpFormatter):
        """Keep the line breaks of the description, and print types in a readable form."""

        def _expand_help(self, action: argparse.Action) -> str:
            text = re.sub(r"<class '(\w+)'>", r"\1", super()._expand_help(action))
            text = re.sub(r"Annotated\[(\w+), ([^]]*)\]", r"\1 \2", text)
            return re.sub(r"Optional\[(.*)\](?=, default)", r"\1 | null", text)

    class Parser(ArgumentParser):
        """A parser that reports wrong arguments in one line."""

        def error(self, message: str, ex: Exception | None = None) -> NoReturn:
            if not self.exit_on_error:  # a parser of nested settings, whose error the outer parser tells
                super().error(message, ex)
            options = [option for option in self._option_string_actions if option.startswith("--")]
            every = "--help-all" if self.prog.startswith("semfov") else "--help"
            print(f"error: {_in_one_line(message, config, options, every)}", file=sys.stderr)
            self.exit(2)

    set_loader("settings", load_yaml, exceptions=(yaml.YAMLError,))
    set_parsing_settings(docstring_parse_attribute_docstrings=False)
    module = sys.modules["__main__"].__spec__
    parser = Parser(
        prog=program or (module and f"python -m {module.name.removesuffix('.__main__')}"),
        description=description,
        default_env=False,
        parser_mode="settings",
        formatter_class=Formatter,
        exit_on_error=True,
        allow_abbrev=False,  # --conf would be --config
    )
    parser.add_argument("--config", action="config", help="YAML file with settings; options after it override it.")
    if positional is not None:
        hint = _setting_types(config)[positional[0]]
        several = get_origin(hint) is tuple
        kind = str if several or hint is str else Path
        # Without a default of its own it leaves what a file of --config says.
        given: dict[str, Any] = {"nargs": "*" if several else "?", "type": kind, "default": SUPPRESS}
        parser.add_argument(positional[0], help=positional[1], **given)
    skip = {*config.unused, *([] if positional is None else positional[:1])}
    parser.add_class_arguments(config, as_group=True, skip=skip)
    return parser


def run_command(
    main: Callable[[_Config], int | None],
    config: type[_Config],
    description: str | None,
    arguments: Sequence[str] | None = None,
    *,
    positional: tuple[str, str] | None = None,
    program: str | None = None,
    goes_on: bool = True,
    words: Callable[[str], str] = str,
) -> int:
    """Parse `arguments` into a `config` and call `main` with it; one that is interrupted may go on (`goes_on`)."""
    more = _GOES_ON if goes_on else ""
    try:
        with _signals(more):
            parser = make_parser(config, description, positional, program)
            command_line = sys.argv[1:] if arguments is None else arguments
            try:
                usual = _usual_form(command_line, config, parser._option_string_actions)
            except InputError as error:
                parser.error(words(str(error)))
            parsed = parser.parse_args(usual)
            parsed.pop("config", None)
            check_settings(config, parsed)
            settings = parser.instantiate(parsed)
            code = main(config(**settings.as_dict()))
            sys.stdout.flush()
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if not missing or missing in ("semfov", "eval", "train", "benchmarks"):
            raise
        install = f"pip install {_PACKAGES.get(missing, missing)}"
        print(f"error: this command needs {missing}, which is not installed: {install}", file=sys.stderr)
        return 1
    except SemfovError as error:
        print(f"error: {words(str(error))}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        # The reader of the output, such as `head`, has closed its end: discard what is still in the buffer.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt:
        # If the interrupt came while `exec` ran a string, as some packages do when they are imported, CPython remembers
        # it and would end by the signal although it was caught here. A string that runs to its end resets this.
        exec("")  # noqa: S102
        print(f"{_ENDINGS[signal.SIGINT]}{more}", file=sys.stderr)
        return 128 + signal.SIGINT
    except _Terminated as ended:
        number: int = ended.args[0]
        with suppress(OSError):  # the terminal may be gone
            print(f"{_ENDINGS[number]}{more}", file=sys.stderr)
        return 128 + number
    return code or 0


def command(
    main: Callable[[_Config], int | None], config: type[_Config], description: str | None
) -> Callable[..., int]:
    """Make the function `main` of a module that is a command: it takes the arguments and returns the exit code."""
    return partial(run_command, main, config, description)


class _Terminated(BaseException):
    """SIGTERM or SIGHUP was received; unfinished work is cleaned up before the process ends."""


@contextmanager
def _signals(goes_on: str) -> Iterator[None]:
    """Let the first SIGINT, SIGTERM or SIGHUP end the command in good order, and the second one at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        for each in _ENDINGS:
            signal.signal(each, _leave)
        below = frame
        while below is not None and below.f_code is not run_command.__code__:
            if below.f_code.co_filename.startswith("<frozen importlib"):
                # An exception from here would pass through the start of a native module, and some abort the process.
                os.write(sys.stderr.fileno(), f"{_ENDINGS[number]}{goes_on}\n".encode())
                _leave(number, frame)
            below = below.f_back
        raise KeyboardInterrupt if number == signal.SIGINT else _Terminated(number)

    signals = [number for number in _ENDINGS if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, end) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _leave(number: int, _: object) -> None:
    discard_unfinished()
    os._exit(128 + number)


_FLAGS = ("true", "false", "yes", "no", "True", "False")
_WORDS = {int: "a whole number", float: "a number", bool: "true or false"}


def _usual_form(arguments: Sequence[str], config: type[Any], options: Iterable[str]) -> list[str]:
    """Bring arguments into the form that the parser understands; an option is given once, but for flags and --config.

    Names of options may have dashes, a flag needs no value, a list of words no brackets, and `none` is the empty list.
    """
    hints, option_names, usual = _setting_types(config), set(options), list[str]()
    rest = list(arguments)
    while rest:
        word = rest.pop(0)
        name, equals, value = word.partition("=")
        option = "--" + name[2:].replace("-", "_")
        option += "_" if iskeyword(option[2:]) else ""  # --try, which Python cannot name so
        if word == "--":
            return [*usual, word, *rest]
        if not word.startswith("--") or option not in option_names:
            usual.append(word)
            continue
        hint, given = hints.get(option[2:]), value if equals else None
        again = any(each.partition("=")[0] == option for each in usual)
        if again and hint is not bool and option != "--config":
            several = "; where it takes several, as a,b" if hint is str or _is_list(hint) else ""
            raise InputError(f"{option[2:]}: expected once, got it again{several}")
        if hint is Path and (rest[:1] == [""] if given is None else given == ""):
            raise InputError(f"{option[2:]}: expected the name of a file or folder, got an empty one")
        if given is None and hint is bool:
            given = rest.pop(0) if rest and rest[0] in _FLAGS else "true"
        elif given is None and _is_list(hint) and rest and not rest[0].startswith("--"):
            given = rest.pop(0)
        if given is not None and _is_list(hint) and not given.startswith("["):
            given = f"[{'' if given in ('none', '') else given}]"
        usual.append(option if given is None else f"{option}={given}")
    return usual


def _in_one_line(message: str, config: type[Any], options: Iterable[str], every: str) -> str:
    """Say in one line what is wrong with the arguments, and suggest names, or the option that lists all (`every`)."""
    unknown = re.match(r"unrecognized arguments: (.*)", message, re.DOTALL)
    if unknown:
        words = unknown[1].split()
        option = next((word.partition("=")[0] for word in words if word.startswith("-")), None)
        if option is None:
            return f"unexpected argument {unknown[1]!r}; put a name with spaces in quotes, and commas in a list"
        plain = [each[2:].replace("_", "-") for each in options]
        near = get_close_matches(option.lstrip("-").replace("_", "-"), plain, n=1, cutoff=0.6)
        remedy = f"did you mean --{near[0]}?" if near else f"{every} lists all options"
        return f"unknown option {option}; {remedy}"
    missing = re.match(r"argument (--\S+): expected one argument", message)
    if missing:
        return f"{missing[1].replace('_', '-')}: expected a value, got none"
    key, got = re.search(r'Parser key "([\w.]+)"', message), re.search(r"(?:Given|Got) value: (.*)", message)
    hint = _setting_types(config).get(key[1]) if key else None
    expected = None if hint is None else _expected(hint)
    if key is None or got is None or expected is None:
        return " ".join(message.split())
    value = got[1].strip()
    close = get_close_matches(value, _options_of(hint), n=1, cutoff=0.5)
    return f"{key[1]}: expected {expected}, got {value!r}" + (f"; did you mean {close[0]!r}?" if close else "")


def _setting_types(config: type[Any]) -> dict[str, Any]:
    """Types of settings, without None, by their dotted names."""
    types: dict[str, Any] = {}
    hints = get_type_hints(config, include_extras=True)
    for field in fields(config):
        hint = hints[field.name]
        if get_origin(hint) in (Union, UnionType):
            some = [each for each in get_args(hint) if each is not type(None)]
            hint = some[0] if len(some) == 1 else hint
        types[field.name] = hint
        if is_dataclass(hint) and isinstance(hint, type):
            types |= {f"{field.name}.{name}": each for name, each in _setting_types(hint).items()}
    return types


def _is_list(hint: Any) -> bool:
    """Whether a type is a list of words, paths or numbers of any length."""
    item, *more = get_args(hint) or (None,)
    item = get_args(item)[0] if get_origin(item) is Annotated else item
    words = item in (str, Path, float) or get_origin(item) is Literal
    return get_origin(hint) is tuple and more == [Ellipsis] and words


def _options_of(hint: Any) -> list[str]:
    """The words that a setting may be."""
    if get_origin(hint) is Literal:
        return [str(each) for each in get_args(hint)]
    return [word for each in get_args(hint) for word in _options_of(each)] if _is_list(hint) else []


def _expected(hint: Any) -> str | None:
    """What a setting must be, in words; None for types that need more of them."""
    words = _options_of(hint)
    if words:
        named = " or ".join(repr(word) for word in words)
        return f"some of {named.replace(' or ', ', ')}" if _is_list(hint) else named
    if get_origin(hint) is Annotated:
        base, *ranges = get_args(hint)
        return " ".join([_WORDS.get(base, "a name"), *map(repr, ranges)])
    return _WORDS.get(hint)
