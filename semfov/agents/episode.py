"""An episode under way: limited, look by look, with its decision and its record at any time."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, Generic, Literal, TypeVar

import torch
from numpy.typing import ArrayLike
from torch import nn

from semfov.data.inputs import FRAME, ImageLike
from semfov.decision import Decision
from semfov.episode import Forgetting
from semfov.errors import InputError, check, check_number, check_whole
from semfov.motion import Motion
from semfov.paths import Ending, Moment, Record, RecordedLook

_Module = TypeVar("_Module", bound=nn.Module)
_Record = TypeVar("_Record", bound=Record)

MOST_PASSES = 1_000_000  # largest number of passes that can be asked for

OnLook = Callable[[Any], object]
"""Function that is called after each look with the record so far; the episode ends if it returns False."""


@dataclass(frozen=True)
class EpisodeLimits:
    """Limits of one episode. It ends at the first one that is reached."""

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


class Episode(ABC, Generic[_Record]):
    """A search or an exploration under way: it looks when it is asked to, and tells its decision and its record.

    `run` looks until the decision or a limit, which makes the record of a picture. In a stream each look is given its
    frame, and `moment` tells what is known after it. `ending` is the reason for the end, and `criterion` what a search
    needs for the decision `found`, in words, after the first look.
    """

    def __init__(
        self,
        classes: tuple[str, ...],
        target: int | None,
        targets: tuple[int, ...] = (),
        limits: EpisodeLimits | None = None,
        rate: float | None = None,
    ) -> None:
        self.classes, self.searches = classes, target is not None
        self.target = targets[0] if len(targets) == 1 else target
        self.targets = targets if len(targets) > 1 else ()
        self.limits = EpisodeLimits() if limits is None else limits
        self.forgetting = None if rate is None else Forgetting(rate)
        self.passed = FRAME
        self.pose: Motion | ArrayLike | None = None
        self.passes = 0
        self.ending: Ending | None = None
        self.criterion: str | None = None
        self._size: tuple[int, int] | None = None

    @abstractmethod
    def look(self, frame: ImageLike | None = None) -> RecordedLook | None:
        """Look once, with one pass of the detector."""

    @property
    @abstractmethod
    def decision(self) -> Decision | None:
        """The decision of a search as it stands; None where nothing is decided."""

    @abstractmethod
    def record(self) -> _Record:
        """The record of the looks so far."""

    def moment(self) -> Moment:
        """What is known at the present frame of a stream."""
        raise InputError(f"frame: expected an episode that takes frames, got a {type(self).__name__}")

    @torch.inference_mode()
    def step(self, frame: ImageLike, passed: float = FRAME, pose: Motion | ArrayLike | None = None) -> Moment:
        """Look at the next frame of a stream (`look`), and tell what is known then."""
        check_number(passed, "passed", 0, 1e9)
        self.passed, self.pose = passed, pose
        self.look(frame)
        return self.moment()

    def run(self) -> _Record:
        """Look until the decision, a limit, or the last look, and make the record."""
        limit = None
        while limit is None and self.ending is None and self.look() is not None:
            limit = self.limits.reached(self.passes, self.record)
        self._end(limit)
        return self.record()

    @abstractmethod
    def _end(self, limit: Ending | None) -> None:
        """Decide at the end, which a limit makes, or the last look, and give its reason."""

    def describe(self) -> str:
        """What is done in a few words."""
        numbers = self.targets or (() if self.target is None else (self.target,))
        names = ", ".join(f"“{self.classes[number]}”" for number in numbers)
        if not numbers:
            return "exploring"
        return f"searching for {names}" if self.searches else f"finding all {names}"

    def _check_size(self, size: tuple[int, int]) -> None:
        """Raise `InputError` unless a frame has the size `(width, height)` of the first one."""
        first = self._size = self._size or size
        expected = f"{first[0]} × {first[1]} pixels, the size of the first frame"
        check(size == first, "frame", expected, f"{size[0]} × {size[1]}")


def only_for(kind: str, suits: str, instead: str, **arguments: object) -> None:
    """Raise `InputError` for arguments that suit another kind of look."""
    by = {"fovea": "a fovea", "windows": "windows", "head": "a head that turns"}[kind]
    for name, value in arguments.items():
        if value is not None and kind != suits:
            raise InputError(
                f"{name}: expected none for a picture that is looked at by {by}, got {value}; use {instead}, or "
                f"how={suits!r}"
            )


def without_none(**values: Any) -> dict[str, Any]:
    """The arguments that are not None."""
    return {name: value for name, value in values.items() if value is not None}


def on_cpu(module: _Module) -> _Module:
    """A module on the CPU, without moving the given one, which other parts of the agent may share.

    Its tensors are copied from a GPU together, since each copy waits for it. All else is shared.
    """
    tensors = {id(each): each for each in (*module.parameters(), *module.buffers())}
    away = {key: each for key, each in tensors.items() if each.device.type != "cpu"}
    if not away:
        return module
    copies: dict[int, Any] = {}
    for dtype in {each.dtype for each in away.values()}:
        some = {key: each for key, each in away.items() if each.dtype == dtype}
        together = torch.cat([each.detach().flatten() for each in some.values()]).cpu()
        parts = together.split([each.numel() for each in some.values()])
        for (key, each), part in zip(some.items(), parts, strict=True):
            here = part.view(each.shape)
            copies[key] = nn.Parameter(here, each.requires_grad) if isinstance(each, nn.Parameter) else here
    return _with_tensors(module, copies)


def _with_tensors(module: _Module, copies: dict[int, Any]) -> _Module:
    """A module with others in the places of its tensors; both, and modules that were copied, by identity."""
    made = object.__new__(type(module))
    copies[id(module)] = made
    made.__dict__.update(module.__dict__)
    for kind in ("_parameters", "_buffers"):
        given = getattr(module, kind).items()
        made.__dict__[kind] = {name: copies.get(id(each), each) for name, each in given}
    parts = module._modules.items()
    made.__dict__["_modules"] = {
        name: each if each is None else copies.get(id(each)) or _with_tensors(each, copies) for name, each in parts
    }
    return made
