"""Messages of Python in the words of the command."""

from __future__ import annotations

import re
from collections.abc import Iterable

_COMMANDS = {
    "agent.classes lists": "`semfov detectors NAME` lists",
    "ActivePerception.from_pretrained('mymodels')": "--models mymodels",
    "ActivePerception.recommended": "--agent recommended",
    "ActivePerception.raw": "--agent raw",
    " or semfov.fit_detector": "",
    "find_all": "`semfov find`",
}
"""What the command calls that messages name as Python does."""


def in_command_words(message: str, options: Iterable[str]) -> str:
    """Say a message of the library in the words of the command: arguments become options.

    Args:
        message: the message.
        options: names of the options, as in Python.

    Returns:
        The message.

    >>> in_command_words("use how='windows' or give_up=0.1, or find_all", ["how", "give_up"])
    'use --how windows or --give-up 0.1, or `semfov find`'
    >>> in_command_words("give its path as weights=", ["weights"])
    'give its path as --weights'
    """
    for python, command in _COMMANDS.items():
        message = message.replace(python, command)
    names = "|".join(map(re.escape, options))

    def option(match: re.Match[str]) -> str:
        value = (match[2] or "").strip("'\"")
        return f"--{match[1].replace('_', '-')}{' ' if value else ''}{value}"

    return re.sub(rf"(?<![\w.-])({names})=('[^']*'|\"[^\"]*\"|[\w.]*\w)?", option, message)
