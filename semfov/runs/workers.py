"""Runs tasks in several processes on this machine and, under torchrun, on several machines."""

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
from semfov.io.files import discard_unfinished
from semfov.runs.progress import task_bar

_log = logging.getLogger(__name__)

_Task = TypeVar("_Task")
Result = TypeVar("Result")


def rank() -> int:
    """Number of this process among those that torchrun started, 0 without torchrun."""
    return int(os.environ.get("RANK", "0"))


def world() -> int:
    """Number of processes that torchrun started, 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def mine(tasks: Sequence[_Task]) -> list[_Task]:
    """The tasks of this rank: every `world`-th."""
    return list(tasks[rank() :: world()])


def wait_for_others(tasks: Sequence[_Task], finished: Callable[[_Task], bool], *, seconds: float = 1.0) -> None:
    """Wait until the tasks of all ranks are finished, however long that takes; without torchrun return at once.

    The ranks communicate only through the results in their shared folder. (torchrun ends all ranks when one fails.)

    Args:
        tasks: the tasks of all ranks.
        finished: whether the result of a task exists.
        seconds: time between two checks of the folder.
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
    """Number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_tasks(
    function: Callable[[_Task], Result],
    tasks: Sequence[_Task],
    *,
    workers: int,
    setup: Callable[..., None],
    settings: tuple[object, ...],
    title: str,
    unit: str,
) -> Iterator[Result]:
    """Run `function(task)` for every task, and yield the results in any order, with a progress bar.

    Args:
        function: a module-level function; it reads the globals that `setup` has set in its module.
        tasks: the tasks.
        workers: number of processes; 1 runs all tasks in this process.
        setup: called once in each process with `settings`, before its first task.
        settings: arguments of `setup`.
        title: label of the progress bar.
        unit: name of a task in the progress bar.

    Yields:
        The results, as tasks finish.

    Raises:
        SemfovError: a process died. An error of a task is raised unchanged. Either error ends all processes.
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
                # Running tasks may be killed: their files are written atomically, either completely or not at all.
                for child in set(multiprocessing.active_children()) - set(before):
                    child.terminate()
                if not isinstance(error, BrokenProcessPool):
                    raise
                raise SemfovError(
                    f"{title}: a worker process died (killed, or out of memory); run the same command again, and it "
                    "continues where this one stopped, or add --workers 1 to use a single process"
                ) from None


@contextmanager
def _deaf_children() -> Iterator[None]:
    """Start processes that ignore Ctrl-C.

    A terminal sends Ctrl-C to all of its processes, but only the main one may handle it; it then ends the others. The
    children inherit the blocked signal, and so ignore it even before any of their code has run.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # if it started later, it would unblock the signal
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
    """Remove unfinished files and end the process at once."""
    discard_unfinished()
    os._exit(128 + signal.SIGTERM)


def _outlive_nobody() -> None:
    """End this worker when its parent process ends, for whatever reason."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(2)  # a long operation may delay the signal handler
        _leave()
