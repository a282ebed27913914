"""Base classes of episodes of a picture or a stream; looks, decision and record are available at any time.

An `Episode` has a goal, and the looks, the decision and the record so far. A `PictureEpisode` looks when it is asked,
and `run` looks until the decision or a limit. A `StreamEpisode` looks once at each frame that `step` is given, and its
`moment` is what is known then. Each kind of look has its own (`semfov.agents.fovea_episode`, `window_episode`, `head`).
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from time import perf_counter
from typing import Generic, Literal, Self, TypeVar
from weakref import ref

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from semfov.data.inputs import FRAME, ImageLike
from semfov.decision import Decision
from semfov.episode import Forgetting
from semfov.errors import InputError, check, check_number, check_whole, type_of
from semfov.motion import Motion
from semfov.paths import Ending, Moment, Record, RecordedLook
from semfov.paths.outcome import sought_classes
from semfov.settings import MOST_PASSES, LookSettings, OnLook, value_or

_UNREDUCED = 2  # largest number of moments that hold their whole frames

_Module = TypeVar("_Module", bound=nn.Module)
_Record_co = TypeVar("_Record_co", bound=Record, covariant=True)
_Moment_co = TypeVar("_Moment_co", bound=Moment, covariant=True)


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
            check_number(self.seconds, "seconds", 0, inf)
        check(self.on_look is None or callable(self.on_look), "on_look", "a function of the record", self.on_look)

    @classmethod
    def of(cls, settings: LookSettings, usual: int | None = None) -> Self:
        """Make the limits from the settings of an episode, and start its clock.

        Args:
            settings: the settings of its task.
            usual: largest number of passes where the settings have none; None for no limit.

        Returns:
            The limits.
        """
        return cls(value_or(settings.passes, usual), settings.seconds, settings.on_look)

    def reached(self, passes: int, record: Callable[[], Record]) -> Literal["stopped", "passes", "seconds"] | None:
        """Return the limit that the last look has reached, if any. Call it once after each look.

        Args:
            passes: number of passes of the detector so far.
            record: makes the record so far, for the caller's function.
        """
        # First, so that it gets every look; False alone stops, as many functions return None.
        if self.on_look is not None and self.on_look(record()) is False:
            return "stopped"
        if self.room(passes) <= 0:
            return "passes"
        if self.elapsed() >= value_or(self.seconds, inf):
            return "seconds"
        return None

    def elapsed(self) -> float:
        """Seconds since the episode began, when its limits were made."""
        return perf_counter() - self._began

    def room(self, passes: int) -> float:
        """Compute how many passes of the detector remain; infinite without a limit."""
        return value_or(self.passes, inf) - passes


@dataclass(frozen=True)
class Goal:
    """What an episode looks for.

    Attributes:
        classes: names of the classes, background first.
        target: class 1..K that looks are chosen for; None for all classes.
        targets: classes 1..K whose objects are all to be found, if they are several; otherwise empty.
        searches: whether one object of the target is searched for, and a decision is made.
    """

    classes: tuple[str, ...]
    target: int | None
    targets: tuple[int, ...] = ()
    searches: bool = False

    @classmethod
    def of(cls, classes: Sequence[str], target: int | None = None, targets: Sequence[int] = ()) -> "Goal":
        """Make the goal: to search for a target, or to find all objects of the given classes, or of every class."""
        searches = target is not None
        if len(targets) > 1:
            return cls(tuple(classes), target, tuple(targets), searches)
        # Looks for all objects of one class are chosen for it, as those of a search are.
        return cls(tuple(classes), targets[0] if targets else target, searches=searches)

    @property
    def searched(self) -> int | None:
        """The class of which a search looks for one object; None for other goals."""
        return self.target if self.searches else None

    @property
    def sought(self) -> tuple[int, ...]:
        """The classes that are looked for; an empty tuple stands for every class."""
        return sought_classes(self.target, self.targets)

    def describe(self) -> str:
        """Describe what is done in a few words."""
        names = ", ".join(f"“{self.classes[number]}”" for number in self.sought)
        if not names:
            return "exploring"
        return f"searching for {names}" if self.searches else f"finding all {names}"


class Episode(ABC, Generic[_Record_co]):
    """Base of running episodes: searches, finds of all objects, and explorations.

    Looks, decision, record and criterion hold at any time: before the first look, after any, and after the end.

    Attributes:
        goal: what is looked for.
    """

    goal: Goal

    @property
    @abstractmethod
    def passes(self) -> int:
        """Number of passes of the detector so far."""

    @property
    @abstractmethod
    def looks(self) -> tuple[RecordedLook, ...]:
        """The looks so far that have not been forgotten, as in the record."""

    @property
    @abstractmethod
    def decision(self) -> Decision | None:
        """The present decision of a search; None before the first look, and in episodes without a decision."""

    @property
    @abstractmethod
    def criterion(self) -> str | None:
        """What a search needs to say `found`, in words; None in episodes without a decision."""

    @abstractmethod
    def record(self) -> _Record_co:
        """Make the record of the looks so far."""

    def moment(self) -> Moment:
        """Make the record of the present frame of a stream."""
        raise InputError(f"frame: expected an episode that takes frames, got {type_of(self)}")

    def describe(self) -> str:
        """Describe what is done in a few words."""
        return self.goal.describe()


class PictureEpisode(Episode[_Record_co]):
    """Base of the episodes of a picture, or of a scene that stands still.

    Attributes:
        limits: where the episode ends, unless it decides before.
        ending: reason for the end; None as long as it goes on.
    """

    def __init__(self, goal: Goal, limits: EpisodeLimits | None = None) -> None:
        self.goal = goal
        self.limits = EpisodeLimits() if limits is None else limits
        self.ending: Ending | None = None

    @property
    def passes(self) -> int:
        """Number of passes of the detector so far, closer looks included."""
        return len(self.looks)

    @abstractmethod
    def look(self) -> RecordedLook | None:
        """Look once, with one pass of the detector; returns None if no look is left."""

    @abstractmethod
    def _end(self, limit: Ending | None) -> None:
        """Decide at the end, which a limit makes, or the last look, and give its reason."""

    def run(self) -> _Record_co:
        """Look until the decision, a limit, or the last look, and make the record.

        An error of a look, such as that of a camera, ends it without a record; `on_look` gets the records before.
        """
        limit = None
        while limit is None and self.ending is None and self.look() is not None:
            limit = self.limits.reached(self.passes, self.record)
        self._end(limit)
        return self.record()


class StreamEpisode(Episode[_Moment_co]):
    """Base of the episodes of a stream, which have no end: `step` takes the next frame.

    The photograph of a moment is made when it is read: most are never read, and reducing a large frame takes as long as
    half of a look.

    Attributes:
        forgetting: how evidence fades with time.

    Private attributes: `_moment` is the record of the present frame, None before the first one. `_latest` has the
    moments whose photographs may not be made yet.
    """

    def __init__(self, goal: Goal, rate: float) -> None:
        self.goal = goal
        self.forgetting = Forgetting(rate)
        self._size: tuple[int, int] | None = None  # `(width, height)` of the frames, from the first one on
        self._passes = 0
        self._moment: _Moment_co | None = None
        self._latest: deque[ref[Moment]] = deque()

    @property
    def passes(self) -> int:
        """Number of passes of the detector so far."""
        return self._passes

    @property
    def decision(self) -> Decision | None:
        return None if self._moment is None else self._moment.decision

    @torch.inference_mode()
    def step(self, frame: ImageLike, passed: float = FRAME, pose: Motion | ArrayLike | None = None) -> _Moment_co:
        """Look at the next frame, and make its record.

        Args:
            frame: the frame, in the size of the first one.
            passed: seconds since the frame before.
            pose: where the camera is, as for `semfov.live.LivePerception.step`.
        """
        check_number(passed, "passed", 0, 1e9)
        self._look_at(frame, passed, pose)
        return self.moment()

    @abstractmethod
    def _look_at(self, frame: ImageLike, passed: float, pose: Motion | ArrayLike | None) -> None:
        """Spend a frame on a look."""

    def moment(self) -> _Moment_co:
        """Return the record of the present frame; there must have been a first frame."""
        if self._moment is None:
            raise InputError("moment: expected a frame before it, got none; call step with a frame first")
        return self._moment

    def _keep(self, moment: _Moment_co) -> None:  # type: ignore[misc]
        """Make a moment the present one; kept for longer, it holds the reduced frame alone."""
        self._moment = moment
        # Weakly, so that moments which nobody keeps are freed.
        self._latest.append(ref(moment))
        # While a frame is looked at, a loop over frames still has the moment of the one before, and drops it then.
        if len(self._latest) > _UNREDUCED:
            older = self._latest.popleft()()
            if older is not None:
                _ = older.photograph

    def record(self) -> _Moment_co:
        """Return the record of the present frame (its moment), with all looks that have not been forgotten."""
        return self.moment()

    def _check_size(self, size: tuple[int, int]) -> None:
        """Raise `InputError` unless a frame has the size `(width, height)` of the first one."""
        self._size = self._size or size
        width, height = self._size
        expected = f"{width} × {height} pixels, the size of the first frame"
        check(size == self._size, "frame", expected, f"{size[0]} × {size[1]}")


def on_cpu(module: _Module) -> _Module:
    """Copy a module to the CPU; the original, which other parts of the agent may share, stays where it is.

    Its tensors are copied from a GPU together, since each copy waits for it. All else is shared.

    Args:
        module: the module.

    Returns:
        The copy; the module itself if all its tensors are on the CPU.
    """
    elsewhere: dict[torch.dtype, list[Tensor]] = {}
    # Modules list a tensor once that two layers share.
    for tensor in (*module.parameters(), *module.buffers()):
        if tensor.device.type != "cpu":
            elsewhere.setdefault(tensor.dtype, []).append(tensor)
    if not elsewhere:
        return module
    copies: dict[int, Tensor] = {}
    for of_one_dtype in elsewhere.values():
        joined = torch.cat([tensor.detach().flatten() for tensor in of_one_dtype]).cpu()
        parts = joined.split([tensor.numel() for tensor in of_one_dtype])
        for tensor, part in zip(of_one_dtype, parts, strict=True):
            copies[id(tensor)] = _shaped_as(tensor, part)
    return _with_tensors(module, copies, {})


def _shaped_as(tensor: Tensor, values: Tensor) -> Tensor:
    """Give values the shape of a tensor; those of a parameter become one."""
    shaped = values.view(tensor.shape)
    return nn.Parameter(shaped, tensor.requires_grad) if isinstance(tensor, nn.Parameter) else shaped


def _with_tensors(module: _Module, tensors: Mapping[int, Tensor], copies: dict[int, nn.Module]) -> _Module:
    """Copy a module with other tensors.

    Args:
        module: the module.
        tensors: by `id`, what takes the place of its tensors.
        copies: by `id`, the modules that were copied, to which this one is added: parts that are shared stay shared.
    """
    copy = object.__new__(type(module))
    copies[id(module)] = copy
    copy.__dict__.update(module.__dict__)
    for kind in ("_parameters", "_buffers"):
        own_tensors = getattr(module, kind)
        copy.__dict__[kind] = {name: tensors.get(id(tensor), tensor) for name, tensor in own_tensors.items()}
    parts: dict[str, nn.Module | None] = {}
    for name, part in module._modules.items():
        if part is None:
            parts[name] = None
        elif id(part) in copies:
            parts[name] = copies[id(part)]
        else:
            parts[name] = _with_tensors(part, tensors, copies)
    copy.__dict__["_modules"] = parts
    return copy
