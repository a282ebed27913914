"""Work cut into tasks, shared by processes on this machine and, under torchrun, by machines."""

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from multiprocessing import resource_tracker
from typing import TypeVar

from semfov.errors import SemfovError
from semfov.experiments.progress import task_bar
from semfov.io.files import discard_unfinished

_log = logging.getLogger(__name__)

Task = TypeVar("Task")
Result = TypeVar("Result")


def rank() -> int:
    """Number of this process among those that torchrun started, 0 without torchrun."""
    return int(os.environ.get("RANK", "0"))


def world() -> int:
    """How many processes torchrun started, 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def mine(tasks: Sequence[Task]) -> list[Task]:
    """This rank's share of the tasks: every `world`-th."""
    return list(tasks[rank() :: world()])


def wait_for_others(tasks: Sequence[Task], finished: Callable[[Task], bool], *, seconds: float = 1.0) -> None:
    """Wait until the tasks of all ranks are finished, however long that takes; nothing without torchrun.

    Ranks see each other's results in the folder that they share, and know each other by nothing else. (torchrun ends
    all of them when one fails.)

    Args:
        tasks: all of them.
        finished: whether the result of a task is there.
        seconds: between two looks at the folder.
    """
    if world() == 1:
        return
    left = [task for task in tasks if not finished(task)]
    if left:
        _log.info("waiting for %d tasks of other ranks", len(left))
    while left:
        time.sleep(seconds)
        left = [task for task in left if not finished(task)]


def available_cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor_seconds() -> float:
    """Seconds that processors have spent on this process and on those that it started and that have ended.

    On a busy machine a clock on the wall tells how busy it is, and this how much there was to do.
    """
    return sum(os.times()[:4])


def run_tasks(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    workers: int,
    setup: Callable[..., None],
    settings: tuple[object, ...],
    title: str,
    unit: str,
) -> Iterator[Result]:
    """Yield `function(task)` for every task, in any order, with a progress bar.

    Args:
        function: a module-level function; it reads what `setup` left in its module.
        tasks: what to do.
        workers: processes; 1 runs everything here.
        setup: called once in each process with `settings`, before its first task.
        settings: arguments of `setup`.
        title: label of the progress bar.
        unit: what a task is called there.

    Raises:
        SemfovError: a process died. Errors of a task are raised as they are; either ends all processes.
    """
    if not tasks:
        return
    with closing(task_bar(len(tasks), title, unit, hidden=rank() > 0)) as bar:
        if workers <= 1 or len(tasks) == 1:
            setup(*settings)
            for task in tasks:
                yield function(task)
                bar.update()
            return
        before = multiprocessing.active_children()
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(min(workers, len(tasks)), context, _prepare, (setup, settings)) as pool:
            try:
                with _deaf_children():
                    submitted = [pool.submit(function, task) for task in tasks]
                for done in as_completed(submitted):
                    yield done.result()
                    bar.update()
            except BaseException as error:
                # Nobody waits for the tasks under way: what they write is whole or not there.
                for child in set(multiprocessing.active_children()) - set(before):
                    child.terminate()
                if not isinstance(error, BrokenProcessPool):
                    raise
                raise SemfovError(
                    f"{title}: a worker process died (killed, or out of memory); the same command goes on where this "
                    "one stopped, with --workers 1 in one process"
                ) from None


@contextmanager
def _deaf_children() -> Iterator[None]:
    """Processes that are started here never hear of Ctrl-C, which reaches all of a terminal: the first ends the others.

    They inherit the mask, and so are deaf from their first moment on, before any code of theirs has run.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # it would lift the mask when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _prepare(setup: Callable[..., None], settings: tuple[object, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_outlive_nobody, daemon=True).start()
    setup(*settings)


def _leave(*_: object) -> None:
    """End now and leave no unfinished file behind."""
    discard_unfinished()
    os._exit(128 + signal.SIGTERM)


def _outlive_nobody() -> None:
    """End this worker when the process that started it does, however that came about."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(2)  # a long operation may keep the handler from running
        _leave()
