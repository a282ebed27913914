"""Runs tasks in this process, in processes of this machine, or in any executor, such as a cluster's."""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext, suppress
from contextvars import ContextVar
from functools import partial
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from queue import SimpleQueue
from typing import Generic, NamedTuple, TypeVar, cast

import torch

from semfov.errors import InputError, SemfovError
from semfov.io.code import package_digest
from semfov.io.files import discard_unfinished
from semfov.runs.progress import task_bar
from semfov.threads import available_cores

_REACH = 10.0  # seconds in which a scheduler must answer
_RETURN = 300.0  # seconds in which a scheduler that was lost must be there again

_log = logging.getLogger(__name__)


class _ClusterLost(Exception):
    """The connection to the scheduler broke, and with it the tasks that it had."""


@contextmanager
def _open_cluster(address: str, *, again: bool) -> Iterator[tuple[Executor, int]]:
    """Connect to a Dask scheduler, and give tasks to its workers; tells how many tasks they can have at once."""
    try:
        from distributed import Client, KilledWorker
        from distributed.comm.core import CommClosedError
    except ModuleNotFoundError:
        raise InputError("scheduler: needs Dask; pip install 'semfov[cluster]'") from None
    try:
        client = Client(address, timeout=_RETURN if again else _REACH, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"scheduler: expected the address of a running Dask scheduler, such as tcp://host:8786, got {address!r} "
            f"({type(error).__name__}); start one with `dask scheduler`"
        ) from None
    with client:
        workers = client.scheduler_info()["workers"].values()
        if not workers:
            _log.warning("the scheduler at %s has no worker yet; start some with `dask worker %s`", address, address)
        # If tasks were pure, Dask could answer one by the result of an equal one.
        executor = client.get_executor(pure=False)
        try:
            yield executor, max(1, sum(worker["nthreads"] for worker in workers))
        except (CancelledError, CommClosedError):
            raise _ClusterLost("the connection to the scheduler broke") from None
        except KilledWorker as error:
            raise SemfovError(
                f"scheduler: a task ended several workers (out of memory?): {error}; give the workers more memory"
            ) from None
        finally:
            executor.shutdown(wait=False)


_TRIM_THRESHOLD = -1  # number of a setting of glibc's malloc (malloc.h): free memory above it is returned
_MMAP_THRESHOLD = -3  # likewise: blocks above it are requested from the system one by one


def prepare_worker() -> None:
    """Set one thread per process, on which results depend, and silence messages that the main process has logged."""
    torch.set_num_threads(1)
    # Otherwise glibc would return and request memory at every look. Dask's workers return memory at once, by a variable
    # of the environment, which also takes away glibc's own rule.
    with suppress(OSError, AttributeError):  # other systems have no such setting
        setting = ctypes.CDLL(None).mallopt
        setting(_MMAP_THRESHOLD, 31 << 20)  # glibc refuses more than 32 MiB
        setting(_TRIM_THRESHOLD, 1 << 30)
    if multiprocessing.parent_process() is not None:
        logging.getLogger("semfov").setLevel(logging.ERROR)


_Made = TypeVar("_Made")
_Task = TypeVar("_Task")
_Result = TypeVar("_Result")

Where = int | str | Executor | None
"""Where tasks run: in so many processes of this machine (1: in this one; None: one for each CPU core), on the workers
of the Dask scheduler with this address, or in an executor."""

_OUTSTANDING = 256
"""Number of tasks that an executor is given at once; the others wait here, so that memory does not grow with them."""

_BATCH = 16  # largest number of tasks that a worker of a cluster is given at once: each exchange takes milliseconds
_TURNS = 8  # number of batches that each worker of a cluster has at least, so that the last ones end together
_PATIENCE = 5  # number of times that a cluster may be lost before its tasks count as failed


def run_tasks(
    function: Callable[[_Made, _Task], _Result],
    tasks: Sequence[_Task],
    *,
    where: Where,
    make: Callable[..., _Made],
    settings: tuple[object, ...],
    title: str,
    unit: str,
    hidden: bool = False,
    made: _Made | None = None,
    count: Callable[[_Task], int] = lambda _: 1,
) -> Generator[tuple[_Task, _Result], None, None]:
    """Run `function(made, task)` for every task; closing the generator ends the work.

    Args:
        function: the work on a task, with what the process has made.
        tasks: the tasks.
        where: where they run (`Where`).
        make: makes what the work needs, once in each process.
        settings: arguments of `make`.
        title: title of the progress bar.
        unit: unit of the bar.
        hidden: whether to hide the bar.
        made: what the work needs, for this process, where it is made already.
        count: number of units of a task.

    Yields:
        Tasks and their results, in any order.
    """
    if not tasks:
        return
    processes = available_cores() if where is None else where
    with closing(task_bar(sum(map(count, tasks)), title, unit, hidden=hidden)) as bar:
        # After the result is taken: what the caller does with it counts as work, too.
        def tell(task: _Task) -> None:
            bar.update(count(task))

        if isinstance(processes, int) and min(processes, len(tasks)) <= 1:
            ready = _prepared(make, settings) if made is None else made
            for task in tasks:
                yield task, function(ready, task)
                tell(task)
            return
        # Workers of other machines may have another version of the code.
        code = None if isinstance(processes, int) else package_digest()
        job = _Job(function, make, settings, Path.cwd(), code).run
        if isinstance(processes, int):
            yield from _in_processes(job, tasks, processes, title, tell)
        elif isinstance(processes, Executor):
            yield from _results(processes, job, tasks, tell)
        else:
            yield from _on_cluster(processes, job, tasks, title, tell)


@contextmanager
def shared_processes() -> Iterator[None]:
    """Keep the processes of this machine for all calls of `run_tasks` in the block."""
    with ExitStack() as pools:
        before = _shared.set((pools, {}))
        try:
            yield
        finally:
            _shared.reset(before)


class _Job(NamedTuple, Generic[_Made, _Task, _Result]):
    """A function and what it needs made, for workers that may have had other jobs; `code` is checked if it is given."""

    function: Callable[[_Made, _Task], _Result]
    make: Callable[..., _Made]
    settings: tuple[object, ...]
    folder: Path
    code: str | None = None

    def run(self, task: _Task) -> _Result:
        """Prepare the process unless its last task has, and run the task; threads of a worker take turns."""
        with _turn:
            if self.code is not None and package_digest() != self.code:
                raise SemfovError("a worker has another version of semfov; install the same version on all machines")
            return self.function(self._made(), task)

    def _made(self) -> _Made:
        """Give what the function needs; what another job has made in this process is dropped."""
        for ready in _ready:
            if (ready.make, ready.settings) == (self.make, self.settings):
                return cast(_Made, ready.made)
        _ready.clear()
        if self.folder.is_dir():  # relative paths of the settings are those of the process that asks
            os.chdir(self.folder)
        made = _prepared(self.make, self.settings)
        _ready.append(_Ready(self.make, self.settings, made))
        return made


def _prepared(make: Callable[..., _Made], settings: tuple[object, ...]) -> _Made:
    """Prepare this process for tasks, and make what they need."""
    prepare_worker()
    return make(*settings)


class _Ready(NamedTuple):
    """What a process has made, and by what."""

    make: Callable[..., object]
    settings: tuple[object, ...]
    made: object


_turn = threading.Lock()
_ready: list[_Ready] = []  # at most one, that of the last job


def _results(
    executor: Executor,
    function: Callable[[_Task], _Result],
    tasks: Sequence[_Task],
    tell: Callable[[_Task], object],
    starting: AbstractContextManager[object] | None = None,
    *,
    stays_open: bool = True,
) -> Iterator[tuple[_Task, _Result]]:
    """Give tasks to an executor, the first ones within `starting`, and yield them with their results as they finish.

    If the executor `stays_open` after them, tasks that have not begun are cancelled when the work is broken off. In one
    that ends then, they end with it: Python 3.11 prints a traceback where processes end and such tasks are cancelled.
    """
    finished: SimpleQueue[Future[_Result]] = SimpleQueue()
    running: dict[Future[_Result], _Task] = {}
    waiting = iter(tasks)

    # The next task is given when one is done, so that `_OUTSTANDING` are with the executor at any time.
    def submit(number: int) -> None:
        for task in islice(waiting, number):
            future = executor.submit(function, task)
            running[future] = task
            future.add_done_callback(finished.put)

    try:
        with starting or nullcontext():
            submit(_OUTSTANDING)
        while running:
            done = finished.get()
            task = running.pop(done)
            yield task, done.result()
            tell(task)
            submit(1)
    finally:
        if stays_open:
            for future in running:
                future.cancel()


_shared: ContextVar[tuple[ExitStack, dict[int, Executor]] | None] = ContextVar("shared processes", default=None)
"""The processes that are kept, by their number, and what ends them (`shared_processes`)."""


def _in_processes(
    job: Callable[[_Task], _Result],
    tasks: Sequence[_Task],
    processes: int,
    title: str,
    tell: Callable[[_Task], object],
) -> Iterator[tuple[_Task, _Result]]:
    try:
        with _executor(processes, len(tasks)) as executor:
            is_shared = _shared.get() is not None
            yield from _results(executor, job, tasks, tell, _deaf_children(), stays_open=is_shared)
    except BrokenProcessPool:
        raise SemfovError(
            f"{title}: a worker process died (killed, or out of memory); run the same command again, and it "
            "continues where this one stopped, or add --workers 1 to use a single process"
        ) from None


@contextmanager
def _executor(processes: int, tasks: int) -> Iterator[Executor]:
    """Start processes for so many tasks, or give those that are kept, which may have more tasks in a later call."""
    shared = _shared.get()
    if shared is None:
        with _started(min(processes, tasks)) as executor:
            yield executor
        return
    pools, executors = shared
    if processes not in executors:
        executors[processes] = pools.enter_context(_started(processes))
    yield executors[processes]


@contextmanager
def _started(processes: int) -> Iterator[Executor]:
    """Start processes of this machine, which end with the block, and at once if it fails."""
    before = multiprocessing.active_children()
    # Not forked: a session of onnxruntime that is open here would have none of its threads there.
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _prepare) as pool:
        try:
            yield pool
        except BaseException:
            # Running tasks may be killed: their files are written atomically, either completely or not at all.
            children = set(multiprocessing.active_children()) - set(before)
            for child in children:
                child.terminate()
            for child in children:
                child.join(5)
                child.kill()  # one that began to wait as the signal came does not see it
            raise


def _on_cluster(
    address: str,
    job: Callable[[_Task], _Result],
    tasks: Sequence[_Task],
    title: str,
    tell: Callable[[_Task], object],
) -> Iterator[tuple[_Task, _Result]]:
    """Run tasks on a cluster; those that were lost with its scheduler are given to the next one at the same address."""
    unfinished = dict.fromkeys(tasks)
    for attempt in range(_PATIENCE):
        try:
            with _open_cluster(address, again=attempt > 0) as (executor, places):
                waiting = list(unfinished)
                # Large batches save exchanges, and small ones let the workers end together.
                size = min(_BATCH, max(1, len(waiting) // (_TURNS * places)))
                batches = [tuple(waiting[start : start + size]) for start in range(0, len(waiting), size)]
                for batch, results in _results(executor, partial(_in_turn, job), batches, lambda batch: None):
                    for task, result in zip(batch, results, strict=True):
                        yield task, result
                        tell(task)
                        del unfinished[task]
            return
        except _ClusterLost as error:
            count = len(unfinished)
            _log.warning("%s: %s; waiting for a scheduler at %s, %d tasks are left", title, error, address, count)
    raise SemfovError(
        f"{title}: the scheduler at {address} was lost {_PATIENCE} times; run the same command again, and it continues "
        "where this one stopped"
    )


def _in_turn(function: Callable[[_Task], _Result], batch: Sequence[_Task]) -> list[_Result]:
    """Compute the results of several tasks."""
    return [function(task) for task in batch]


@contextmanager
def _deaf_children() -> Iterator[None]:
    """Start processes that ignore Ctrl-C, as the main one ends them: they inherit the blocked signal."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # if it started later, it would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _prepare() -> None:
    """Leave Ctrl-C to the main process, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_outlive_nobody, daemon=True).start()


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
