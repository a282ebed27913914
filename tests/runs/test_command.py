"""Signals that end a command, also where the exception of their handler is lost."""

import signal
from contextlib import suppress
from dataclasses import dataclass

import pytest

from semfov.errors import DataError
from semfov.runs.command import run_command
from semfov.runs.settings import Settings


@dataclass(frozen=True)
class Config(Settings):
    """No settings."""


def lose(number):
    """As native code does that calls Python within: the exception of the handler goes no further."""
    with suppress(BaseException):
        signal.raise_signal(number)
        for _ in range(1000):  # the handler runs between two steps of Python
            pass


@pytest.mark.parametrize(
    ("number", "error", "code", "line"),
    [
        (signal.SIGTERM, None, 143, "terminated"),
        (signal.SIGTERM, ValueError("Invalid affine transformation matrix"), 143, "terminated"),
        (signal.SIGTERM, DataError("figure: cannot be drawn"), 143, "terminated"),
        (signal.SIGINT, ValueError("Invalid affine transformation matrix"), 130, "interrupted"),
        (signal.SIGINT, DataError("picture: cannot be read"), 1, "error: picture: cannot be read"),
        (signal.SIGINT, None, 0, ""),  # a stream that Ctrl-C has ended in good order
    ],
)
def test_a_signal_ends_a_command_in_one_line_where_its_exception_is_lost(number, error, code, line, capsys):
    def main(config):
        lose(number)
        if error is not None:
            raise error

    handlers = [signal.getsignal(other) for other in (signal.SIGINT, signal.SIGTERM)]
    assert run_command(main, Config, "", [], goes_on=False) == code
    assert capsys.readouterr().err.strip() == line
    assert [signal.getsignal(other) for other in (signal.SIGINT, signal.SIGTERM)] == handlers
