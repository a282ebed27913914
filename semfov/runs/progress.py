"""Progress bars: one for each task, or a single one for several tasks together."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

from tqdm import tqdm

_Item = TypeVar("_Item")

_open_bar: ContextVar[WholeBar | None] = ContextVar("open bar", default=None)


class WholeBar:
    """One bar for several stages of different duration, each of which consists of tasks.

    The bar shows `_position` of `_total` seconds, and never moves back. `_tasks` holds the tasks of the present stage
    that have not begun.

    Args:
        title: title of the bar.
        stages: the stages in their order, each with the seconds that its tasks are expected to take.
    """

    def __init__(self, title: str, stages: Mapping[str, Mapping[str, float]]) -> None:
        self.title = title
        self.stages = stages
        self._total = sum(sum(tasks.values()) for tasks in stages.values()) or 1.0
        self._position = 0.0
        self._tasks = dict[str, float]()
        form = "{desc} {percentage:3.0f} % |{bar}| {elapsed} < {remaining}{postfix}"
        self._bar = tqdm(total=1.0, desc=title, bar_format=form, dynamic_ncols=True)
        self._closed = threading.Event()
        threading.Thread(target=self._tick, daemon=True).start()

    @property
    def done(self) -> float:
        """The share of the work that is done."""
        return self._position / self._total

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
        self._position = max(self._position, to)
        self._bar.update(min(self.done, 1.0) - self._bar.n)

    def __enter__(self) -> WholeBar:
        self._token = _open_bar.set(self)
        return self

    def __exit__(self, *_: object) -> None:
        _open_bar.reset(self._token)
        self._closed.set()
        self._bar.close()


class _Task(tqdm):  # type: ignore[type-arg]
    """A task that moves the bar of a `WholeBar`, and shows no bar or values of its own."""

    def __init__(self, whole: WholeBar, step: float) -> None:
        super().__init__(disable=True)
        self._whole = whole
        self._step = step

    def update(self, n: float | None = 1) -> None:
        """Move the bar by so many items."""
        self._whole._move(self._whole._position + (n or 0) * self._step)


def task_bar(total: float, title: str, unit: str, *, hidden: bool = False) -> tqdm[Any]:
    """Open a bar for a task; if a `WholeBar` is open, the task moves its bar instead."""
    bar = _open_bar.get()
    if bar is not None:
        return bar.task(title, total)
    return tqdm(total=total, desc=title, unit=unit, dynamic_ncols=True, disable=hidden)


def track(items: Iterable[_Item], title: str, unit: str) -> Iterator[_Item]:
    """Iterate over items and show a bar that moves with them (`task_bar`)."""
    listed = list(items)
    with closing(task_bar(len(listed), title, unit)) as bar:
        for item in listed:
            yield item
            bar.update()
