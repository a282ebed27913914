"""Progress bars: one for each task, or a single one for several tasks together."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from contextvars import ContextVar
from time import monotonic
from typing import Any, TextIO, TypeVar

from tqdm import tqdm

_Item = TypeVar("_Item")

_TRUST = 0.02  # share of the work for which the pace that was expected counts beside the pace so far

_SELDOM = 60.0  # seconds between two lines of a bar in a log

_open_bar: ContextVar[WholeBar | None] = ContextVar("open bar", default=None)


class WholeBar:
    """One bar for several stages of different duration, each of which consists of tasks.

    The bar shows `_position` of `_total` seconds, and never moves back. Of these, `_worked` seconds were work, and not
    stages that were done before. `_tasks` holds the tasks of the present stage that have not begun.

    Args:
        title: title of the bar.
        stages: the stages in their order, each with the seconds that its tasks are expected to take.
    """

    def __init__(self, title: str, stages: Mapping[str, Mapping[str, float]]) -> None:
        self.title = title
        self.stages = stages
        self._total = sum(sum(tasks.values()) for tasks in stages.values()) or 1.0
        self._position = 0.0
        self._worked = 0.0
        self._began = monotonic()
        self._tasks = dict[str, float]()
        form = "{desc} {percentage:3.0f} % |{bar}| {elapsed} < {left}{postfix}"
        self._bar = _Bar(self, total=1.0, desc=title, bar_format=form, **_place())
        self._closed = threading.Event()
        threading.Thread(target=self._tick, daemon=True).start()

    @property
    def done(self) -> float:
        """The share of the work that is done."""
        return self._position / self._total

    @property
    def seconds_left(self) -> float:
        """Estimate the seconds that are left: those expected, at the pace of all work so far.

        The pace of a single task would be that of its own estimate, which may be wrong by a factor.
        """
        at_first = _TRUST * self._total  # at the pace that was expected, so that the first item tells little
        pace = (monotonic() - self._began + at_first) / (self._worked + at_first)
        return max(self._total - self._position, 0.0) * pace

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Work on a stage; at its end it counts as done, whatever its tasks have reported."""
        before = 0.0
        for other, tasks in self.stages.items():
            if other == name:
                break
            before += sum(tasks.values())
        self._tasks = dict(self.stages[name])
        self._bar.set_description(f"{self.title}: {name}", refresh=True)
        self._move(before)
        yield
        self._move(before + sum(self.stages[name].values()))

    def task(self, title: str, total: float) -> tqdm[Any]:
        """Open a task with this title, which moves the bar."""
        return _Task(self, self._tasks.pop(title, 0.0) / max(total, 1))

    def _tick(self) -> None:
        """Draw the bar anew each second, so that its clock goes on while a task takes long."""
        while sys.stderr.isatty() and not self._closed.wait(1.0):
            self._bar.refresh()

    def _move(self, to: float) -> None:
        # Not back: the tasks of a stage may have done more than it was expected to.
        self._position = max(self._position, to)
        self._bar.update(min(self.done, 1.0) - self._bar.n)

    def _work(self, seconds: float) -> None:
        """Count work that was expected to take so many seconds."""
        self._worked += seconds
        self._move(self._position + seconds)

    def __enter__(self) -> WholeBar:
        self._token = _open_bar.set(self)
        return self

    def __exit__(self, *_: object) -> None:
        _open_bar.reset(self._token)
        self._closed.set()
        self._bar.close()


class _Bar(tqdm):  # type: ignore[type-arg]
    """The bar of a `WholeBar`, which knows the time that is left."""

    def __init__(self, whole: WholeBar, **options: Any) -> None:
        self._whole = whole
        super().__init__(**options)

    @property
    def format_dict(self) -> dict[str, Any]:
        """What the format of the bar may name."""
        return {**super().format_dict, "left": self.format_interval(self._whole.seconds_left)}


class _Task(tqdm):  # type: ignore[type-arg]
    """A task that moves the bar of a `WholeBar`, and shows no bar or values of its own."""

    def __init__(self, whole: WholeBar, step: float) -> None:
        super().__init__(disable=True)
        self._whole = whole
        self._step = step

    def update(self, n: float | None = 1) -> None:
        """Move the bar by so many items."""
        self._whole._work((n or 0) * self._step)


def task_bar(total: float, title: str, unit: str, *, hidden: bool = False) -> tqdm[Any]:
    """Open a bar for a task; if a `WholeBar` is open, the task moves its bar instead."""
    bar = _open_bar.get()
    if bar is not None:
        return bar.task(title, total)
    return tqdm(total=total, desc=title, unit=unit, disable=hidden, **_place())


def _place() -> dict[str, Any]:
    """Options of a bar for where it is drawn: on a terminal often, and in a log as few lines, as it keeps each."""
    if sys.stderr.isatty():
        return {"dynamic_ncols": True, "mininterval": 0.1}
    return {"file": _LinesOfLog(sys.stderr), "mininterval": _SELDOM}


class _LinesOfLog:
    """A log that has a line for each drawing of a bar, which would return to the beginning of its line otherwise.

    Args:
        log: the file.
    """

    def __init__(self, log: TextIO) -> None:
        self._log = log
        self._last = ""  # the last drawing, which is drawn again when a bar is closed

    def write(self, text: str) -> None:
        """Write a drawing as a line; what only moves the cursor is left out."""
        line = text.strip()
        is_drawing = line and "\x1b" not in line
        if is_drawing and line != self._last:
            self._last = line
            self._log.write(f"{line}\n")

    def flush(self) -> None:
        """Flush the log."""
        self._log.flush()


def track(items: Iterable[_Item], title: str, unit: str) -> Iterator[_Item]:
    """Iterate over items and show a bar that moves with them (`task_bar`)."""
    listed = list(items)
    with closing(task_bar(len(listed), title, unit)) as bar:
        for item in listed:
            yield item
            bar.update()
