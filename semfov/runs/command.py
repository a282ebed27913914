"""Command lines from dataclasses: help, YAML files, dotted overrides, exit codes."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
from argparse import SUPPRESS
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar, get_origin

from semfov.errors import SemfovError
from semfov.io.files import discard_unfinished
from semfov.runs.arguments import in_one_line, setting_types, usual_form
from semfov.runs.settings import Settings, check_settings

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

_Config = TypeVar("_Config", bound=Settings)

GOES_ON = "; give the same command again to continue"
"""What is said about an interrupted command that keeps what it has finished."""

_PACKAGES = {"sklearn": "scikit-learn", "cv2": "opencv-python-headless", "yaml": "pyyaml", "PIL": "pillow",
             "skimage": "scikit-image", "jsonargparse": "'jsonargparse[signatures]'"}  # fmt: skip
"""Names under which packages are installed, where they are not those of their modules."""
_ENDINGS: dict[int, str] = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


def make_parser(
    config: type[Settings],
    description: str | None,
    positional: tuple[str, str] | None = None,
    program: str | None = None,
) -> ArgumentParser:
    """Make a parser with an option for every field of `config` and `--config FILE.yaml`; nested fields are dotted."""
    from jsonargparse import ArgumentParser, set_parsing_settings

    class Parser(ArgumentParser):
        """A parser that reports wrong arguments in one line."""

        def error(self, message: str, ex: Exception | None = None) -> NoReturn:
            if not self.exit_on_error:  # a parser of nested settings, whose error the outer parser tells
                super().error(message, ex)
            options = [option for option in self._option_string_actions if option.startswith("--")]
            print(f"error: {in_one_line(message, config, options)}", file=sys.stderr)
            self.exit(2)

    set_parsing_settings(docstring_parse_attribute_docstrings=False)
    parser = Parser(
        prog=program, description=description, default_env=False, formatter_class=_formatter(), exit_on_error=True
    )
    parser.add_argument("--config", action="config", help="YAML file with settings; options after it override it.")
    if positional is not None:
        hint = setting_types(config)[positional[0]]
        several = get_origin(hint) is tuple
        kind = str if several or hint is str else Path
        # Without a default of its own it leaves what a file of --config says.
        given: dict[str, Any] = {"nargs": "*" if several else "?", "type": kind, "default": SUPPRESS}
        parser.add_argument(positional[0], help=positional[1], **given)
    skip = {*config.unused, *([] if positional is None else positional[:1])}
    parser.add_class_arguments(config, as_group=True, skip=skip)
    return parser


def _formatter() -> Any:
    import argparse

    from jsonargparse import DefaultHelpFormatter

    class Formatter(DefaultHelpFormatter, argparse.RawDescriptionHelpFormatter):
        """Keep the line breaks of the description, and print the range of a number in a readable form."""

        def _expand_help(self, action: argparse.Action) -> str:
            return re.sub(r"Annotated\[(\w+), ([^]]*)\]", r"\1 \2", super()._expand_help(action))

    return Formatter


def run_command(
    main: Callable[[_Config], int | None],
    config: type[_Config],
    description: str | None,
    arguments: Sequence[str] | None = None,
    *,
    positional: tuple[str, str] | None = None,
    program: str | None = None,
    goes_on: str = GOES_ON,
    words: Callable[[str], str] = str,
) -> int:
    """Parse `arguments` into a `config` and call `main` with it."""
    try:
        with _signals(goes_on):
            parser = make_parser(config, description, positional, program)
            command_line = sys.argv[1:] if arguments is None else arguments
            parsed = parser.parse_args(usual_form(command_line, config, parser._option_string_actions))
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
        exec("")
        print(f"{_ENDINGS[signal.SIGINT]}{goes_on}", file=sys.stderr)
        return 128 + signal.SIGINT
    except _Terminated:
        print(f"{_ENDINGS[signal.SIGTERM]}{goes_on}", file=sys.stderr)
        return 128 + signal.SIGTERM
    return code or 0


def command(
    main: Callable[[_Config], int | None], config: type[_Config], description: str | None
) -> Callable[..., int]:
    """Make the function `main` of a module that is a command: it takes the arguments and returns the exit code."""

    def run(arguments: Sequence[str] | None = None) -> int:
        return run_command(main, config, description, arguments)

    return run


class _Terminated(BaseException):
    """SIGTERM was received; unfinished work is cleaned up before the process ends."""


@contextmanager
def _signals(goes_on: str) -> Iterator[None]:
    """Let the first SIGINT or SIGTERM end the command in good order, and the second one at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, _leave)
        signal.signal(signal.SIGTERM, _leave)
        if _importing(frame):
            # An exception from here would pass through the start of a native module, and some abort the process.
            os.write(sys.stderr.fileno(), f"{_ENDINGS[number]}{goes_on}\n".encode())
            _leave(number, frame)
        raise KeyboardInterrupt if number == signal.SIGINT else _Terminated

    signals = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, end) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported somewhere below `run_command` on the call stack."""
    while frame is not None and frame.f_code is not run_command.__code__:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _leave(number: int, _: object) -> None:
    discard_unfinished()
    os._exit(128 + number)
