"""Command lines from dataclasses: help, YAML files, dotted overrides, exit codes."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
from argparse import SUPPRESS
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from semfov.errors import InputError, SemfovError
from semfov.io.files import discard_unfinished
from semfov.io.ranges import check_settings
from semfov.runs.arguments import in_present_names, mistake, usual_form
from semfov.runs.setting_types import ListType, SettingType, setting_types
from semfov.runs.settings import Settings, load_yaml

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

_Config = TypeVar("_Config", bound=Settings)

_GOES_ON = "; give the same command again to continue"
"""What is said about an interrupted command that keeps what it has finished."""

_PACKAGES = {"sklearn": "scikit-learn", "cv2": "opencv-python-headless", "yaml": "pyyaml", "PIL": "pillow",
             "jsonargparse": "'jsonargparse[signatures]'"}  # fmt: skip
"""Names under which packages are installed, where they are not those of their modules."""

_NOT_INSTALLED = ("", "semfov", "eval", "train", "benchmarks")
"""Packages that are here without pip, and the name of a module whose loading failed in another way."""

_HANGUP = getattr(signal, "SIGHUP", signal.SIGTERM)
_ENDINGS: dict[int, str] = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", _HANGUP: "terminated"}
"""What is said after each signal: a terminal that closes ends a command (SIGHUP) as SIGTERM does."""


def make_parser(
    config: type[Settings],
    description: str | None,
    positional: tuple[str, str] | None = None,
    program: str | None = None,
) -> ArgumentParser:
    """Make a parser with an option for every field of a dataclass, and `--config FILE.yaml`.

    Args:
        config: dataclass of the settings; the options of nested settings are dotted.
        description: what the help says before the options.
        positional: the setting that has no option before it, and its help.
        program: name of the command; None for that of the module.

    Returns:
        The parser, which reports wrong arguments in one line.
    """
    import argparse

    import yaml
    from jsonargparse import ArgumentParser, DefaultHelpFormatter, set_loader, set_parsing_settings

    class Formatter(DefaultHelpFormatter, argparse.RawDescriptionHelpFormatter):
        """Keep the line breaks of the description, and print types in a readable form."""

        def _expand_help(self, action: argparse.Action) -> str:
            return _with_readable_types(super()._expand_help(action))

        def format_help(self) -> str:
            # In Python a name that is a word of the language has an underscore after it: `with_`.
            return re.sub(r"(--\w+|\b[A-Z]+)_(?!\w)", r"\1", super().format_help())

    class Parser(ArgumentParser):
        """A parser that reports wrong arguments in one line, and whose files have the names of options."""

        def parse_string(self, content: str, *arguments: Any, **options: Any) -> Namespace:
            try:
                content = in_present_names(content, config)
            except InputError as error:
                self.error(str(error), error)
            return super().parse_string(content, *arguments, **options)

        def dump(self, namespace: Namespace, *arguments: Any, **options: Any) -> str:
            # What stands at the start of a line is a name: texts of several lines are indented.
            return re.sub(r"^(\w+)_:", r"\1:", super().dump(namespace, *arguments, **options), flags=re.M)

        def error(self, message: str, ex: Exception | None = None) -> NoReturn:
            if not self.exit_on_error:  # a parser of nested settings, whose error the outer parser tells
                super().error(message, ex)
            options = [option for option in self._option_string_actions if option.startswith("--")]
            help_option = "--help-all" if self.prog.startswith("semfov") else "--help"
            print(f"error: {mistake(message, config, options, help_option)}", file=sys.stderr)
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
    parser.add_argument("--config", action="config", help="YAML file with settings; typed options override it.")
    no_options = {*config.unused}
    if positional is not None:
        name, text = positional
        _add_positional(parser, name, text, setting_types(config)[name])
        no_options.add(name)
    parser.add_class_arguments(config, as_group=True, skip=no_options)
    return parser


def _add_positional(parser: ArgumentParser, name: str, text: str, kind: SettingType) -> None:
    """Add the setting that has no option before it, with its help."""
    takes_several = isinstance(kind, ListType)
    parser.add_argument(
        name,
        help=text,
        nargs="*" if takes_several else "?",
        type=str if takes_several or kind.hint is str else Path,
        default=SUPPRESS,  # without one of its own it leaves what a file of --config says
    )


def _with_readable_types(text: str) -> str:
    """Write the types in the help of an option as people read them."""
    text = re.sub(r"<class '(\w+)'>", r"\1", text)
    # A type may have brackets of its own: int | tuple[int, int].
    text = re.sub(r"Annotated\[((?:[^][,]|\[[^]]*\])*), ([^]]*)\]", r"\1 \2", text)
    return re.sub(r"Optional\[(.*)\](?=, default)", r"\1 | null", text)


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
    """Parse arguments into settings, and call a function with them.

    Args:
        main: the function; it returns an exit code, or None for 0.
        config: dataclass of the settings.
        description: what the help says before the options.
        arguments: the words after the name of the command; None for those of this process.
        positional: the setting that has no option before it, and its help.
        program: name of the command; None for that of the module.
        goes_on: whether the same command continues after an interruption.
        words: says a message of the library in the words of the command.

    Returns:
        The exit code: 1 for an error, 2 for wrong arguments, 128 and the number of the signal after an interruption.
    """
    advice = _GOES_ON if goes_on else ""
    try:
        with _signals(advice):
            settings = _parsed(config, make_parser(config, description, positional, program), arguments, words)
            code = main(settings)
            # Here, so that a reader that is gone is noticed below, and not at the end of the process.
            sys.stdout.flush()
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in _NOT_INSTALLED:
            raise
        install = f"pip install {_PACKAGES.get(package, package)}"
        print(f"error: this command needs {package}, which is not installed: {install}", file=sys.stderr)
        return 1
    except SemfovError as error:
        print(f"error: {words(str(error))}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        # The reader of the output, such as `head`, has closed its end: discard what is still in the buffer.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141  # 128 + 13, as of a program that SIGPIPE has ended; Windows has no such signal
    except KeyboardInterrupt:
        # If the interrupt came while `exec` ran a string, as some packages do when they are imported, CPython remembers
        # it and would end by the signal although it was caught here. A string that runs to its end resets this.
        exec("")  # noqa: S102
        print(f"{_ENDINGS[signal.SIGINT]}{advice}", file=sys.stderr)
        return 128 + signal.SIGINT
    except _Terminated as ended:
        number: int = ended.args[0]
        with suppress(OSError):  # the terminal may be gone
            print(f"{_ENDINGS[number]}{advice}", file=sys.stderr)
        return 128 + number
    return code or 0


def _parsed(
    config: type[_Config], parser: ArgumentParser, arguments: Sequence[str] | None, words: Callable[[str], str]
) -> _Config:
    """Parse a command line; wrong arguments end the process with code 2, and values out of range raise `InputError`."""
    command_line = sys.argv[1:] if arguments is None else arguments
    try:
        usual = usual_form(command_line, config, parser._option_string_actions)
    except InputError as error:
        parser.error(words(str(error)))
    parsed = parser.parse_args(usual)
    parsed.pop("config", None)
    # Before nested settings are made, whose messages have no dotted names.
    check_settings(config, parsed)
    return config(**parser.instantiate(parsed).as_dict())


def command(
    main: Callable[[_Config], int | None], config: type[_Config], description: str | None
) -> Callable[..., int]:
    """Make the function `main` of a module that is a command.

    Args:
        main: function of the settings; it returns an exit code, or None for 0.
        config: dataclass of the settings.
        description: what the help says before the options.

    Returns:
        The function, which takes the arguments (none: those of this process) and returns the exit code.
    """
    return partial(run_command, main, config, description)


class _Terminated(BaseException):
    """SIGTERM or SIGHUP was received; unfinished work is cleaned up before the process ends."""


def _is_importing(frame: FrameType | None) -> bool:
    """Tell whether a command is importing a module at a frame."""
    while frame is not None and frame.f_code is not run_command.__code__:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


@contextmanager
def _signals(advice: str) -> Iterator[None]:
    """Let the first SIGINT, SIGTERM or SIGHUP end the command in good order, and the second one at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    stops: list[BaseException] = []

    def end(number: int, frame: FrameType | None) -> None:
        for ending in _ENDINGS:
            signal.signal(ending, _leave)
        if _is_importing(frame):
            # An exception from here would pass through the start of a native module, and some abort the process.
            os.write(sys.stderr.fileno(), f"{_ENDINGS[number]}{advice}\n".encode())
            _leave(number, frame)
        stop = KeyboardInterrupt() if number == signal.SIGINT else _Terminated(number)
        stops.append(stop)
        raise stop

    # Under nohup SIGHUP is ignored, and the command is to outlive its terminal.
    signals = [number for number in _ENDINGS if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, end) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if stops and _is_lost(stops[0], sys.exception()):
            raise stops[0] from None


def _is_lost(stop: BaseException, error: BaseException | None) -> bool:
    """Tell whether the exception of a signal was lost: native code that it came through makes another one of it."""
    if isinstance(stop, _Terminated):
        return error is not stop
    # Ctrl-C may have ended a stream in good order, whose own errors are told.
    return isinstance(error, Exception) and not isinstance(error, SemfovError | OSError)


def _leave(number: int, _: object) -> None:
    """End the process at once, without files that are half written."""
    discard_unfinished()
    os._exit(128 + number)
