"""Command lines from dataclasses: help, YAML files, dotted overrides, exit codes."""

import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from jsonargparse import ArgumentParser, set_parsing_settings

from semfov.errors import SemfovError
from semfov.io.files import discard_unfinished
from semfov.runs.settings import check_settings

_Config = TypeVar("_Config")

_GOES_ON = "give the same command again to continue"
_SAID: dict[int, str] = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


def make_parser(
    config: type[Any], description: str | None, positional: tuple[str, str] | None = None
) -> ArgumentParser:
    """Make a parser with an option for every field of `config` and `--config FILE.yaml`; nested fields are dotted.

    Args:
        config: dataclass of the settings.
        description: description for `--help`.
        positional: name and help of a path field that becomes an optional positional argument.

    Returns:
        The parser.
    """
    set_parsing_settings(docstring_parse_attribute_docstrings=False)
    parser = ArgumentParser(
        prog=None, description=description, default_env=False, formatter_class=_formatter(), exit_on_error=True
    )
    parser.add_argument("--config", action="config", help="YAML file with settings; options after it override it.")
    if positional is not None:
        parser.add_argument(positional[0], nargs="?", type=Path, help=positional[1])
    parser.add_class_arguments(config, as_group=True, skip=set() if positional is None else {positional[0]})
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
    main: Callable[[_Config], None],
    config: type[_Config],
    description: str | None,
    arguments: Sequence[str] | None = None,
    *,
    positional: tuple[str, str] | None = None,
) -> int:
    """Parse `arguments` into a `config` and call `main` with it.

    Args:
        main: the function to run.
        config: dataclass of its settings.
        description: description for `--help`.
        arguments: command-line arguments (None: those of the process).
        positional: name and help of a path field that becomes an optional positional argument.

    Returns:
        The exit code: 0, or 1 after a `SemfovError` (printed in one line), 130 after Ctrl-C, 143 after SIGTERM, or 141
        if the reader of the output has closed its pipe. Usage errors exit with 2.
    """
    try:
        with _signals():
            parser = make_parser(config, description, positional)
            parsed = parser.parse_args(arguments)
            parsed.pop("config", None)
            check_settings(config, parsed)
            settings = parser.instantiate(parsed)
            main(config(**settings.as_dict()))
            sys.stdout.flush()
    except SemfovError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        # The reader of the output, such as `head`, has closed its end: discard what is still in the buffer.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt:
        # If the interrupt came while `exec` ran a string, as some packages do when they are imported, CPython remembers
        # it and would end by the signal although it was caught here. A string that runs to its end resets this.
        exec("")
        print(f"{_SAID[signal.SIGINT]}; {_GOES_ON}", file=sys.stderr)
        return 128 + signal.SIGINT
    except _Terminated:
        print(f"{_SAID[signal.SIGTERM]}; {_GOES_ON}", file=sys.stderr)
        return 128 + signal.SIGTERM
    return 0


class _Terminated(BaseException):
    """SIGTERM was received; unfinished work is cleaned up before the process ends."""


@contextmanager
def _signals() -> Iterator[None]:
    """Let the first SIGINT or SIGTERM end the command in good order, and the second one at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, _leave)
        signal.signal(signal.SIGTERM, _leave)
        if _importing(frame):
            # An exception from here would pass through the start of a native module, and some abort the process.
            os.write(sys.stderr.fileno(), f"{_SAID[number]}; {_GOES_ON}\n".encode())
            _leave(number, frame)
        raise KeyboardInterrupt if number == signal.SIGINT else _Terminated

    wanted = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, end) for number in wanted}
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
