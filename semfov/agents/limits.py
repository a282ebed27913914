"""What agents share: limits of an episode, checks of arguments, and where their parts compute."""

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, Literal, TypeVar

from torch import nn

from semfov.errors import InputError, check, check_number, check_whole

_Module = TypeVar("_Module", bound=nn.Module)

MOST_PASSES = 1_000_000
"""Largest number of passes that can be asked for."""

OnLook = Callable[[Any], object]
"""Function that is called after each look with the record so far; the episode ends if it returns False."""


@dataclass(frozen=True)
class EpisodeLimits:
    """Limits of one episode. It ends at the first one that is reached.

    >>> limits = EpisodeLimits(passes=3, on_look=lambda record: record != "enough")
    >>> [limits.reached(1, lambda: "more"), limits.reached(1, lambda: "enough"), limits.reached(3, lambda: "more")]
    [None, 'stopped', 'passes']
    """

    passes: int | None = None
    seconds: float | None = None
    on_look: OnLook | None = None
    _began: float = field(default_factory=perf_counter, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.passes is not None:
            check_whole(self.passes, "passes", 1, MOST_PASSES)
        if self.seconds is not None:
            check_number(self.seconds, "seconds", 0, float("inf"))
        check(self.on_look is None or callable(self.on_look), "on_look", "a function of the record", self.on_look)

    def reached(self, passes: int, record: Callable[[], Any]) -> Literal["stopped", "passes", "seconds"] | None:
        """The limit that is reached after a look. Call it once after each look."""
        if self.on_look is not None and self.on_look(record()) is False:
            return "stopped"
        if self.passes is not None and passes >= self.passes:
            return "passes"
        if self.seconds is not None and perf_counter() - self._began >= self.seconds:
            return "seconds"
        return None

    def room(self, passes: int) -> float:
        """Number of passes that are left after some; infinite without a limit."""
        return float("inf") if self.passes is None else self.passes - passes


def only_for(kind: str, suits: str, instead: str, **arguments: object) -> None:
    """Raise `InputError` for arguments that suit another kind of look."""
    for name, value in arguments.items():
        if value is not None and kind != suits:
            raise InputError(
                f"{name}: expected None for a picture that is looked at by {kind!r}, got {value}; use {instead}, or "
                f"how={suits!r}"
            )


def without_none(**values: Any) -> dict[str, Any]:
    """The arguments that are not None."""
    return {name: value for name, value in values.items() if value is not None}


def on_cpu(module: _Module) -> _Module:
    """A module on the CPU, without moving the given one, which other parts of the agent may share.

    >>> layer = nn.Linear(2, 1)
    >>> on_cpu(layer) is layer
    True
    """
    if all(each.device.type == "cpu" for each in (*module.parameters(), *module.buffers())):
        return module
    return copy.deepcopy(module).cpu()
