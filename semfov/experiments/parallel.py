"""Work cut into tasks, shared by processes on this machine and, under torchrun, by machines."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

import torch
import torch.distributed
from tqdm import tqdm

from semfov.errors import SemfovError

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


def wait_for_all() -> None:
    """Wait until every rank has come here; nothing without torchrun."""
    if world() == 1:
        return
    if not torch.distributed.is_initialized():
        torch.distributed.init_process_group("gloo")
    torch.distributed.barrier()


def available_cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
    bar = tqdm(total=len(tasks), desc=title, unit=unit, dynamic_ncols=True, disable=rank() > 0)
    with bar:
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
                for done in as_completed([pool.submit(function, task) for task in tasks]):
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


def _prepare(setup: Callable[..., None], settings: tuple[object, ...]) -> None:
    # Ctrl-C reaches every process of a terminal; the first one ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    setup(*settings)
