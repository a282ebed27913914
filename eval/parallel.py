"""Work cut into tasks, shared by processes on this machine and, under torchrun, by machines."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import torch
import torch.distributed
from tqdm import tqdm

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
        context = multiprocessing.get_context("spawn")
        with context.Pool(min(workers, len(tasks)), initializer=setup, initargs=settings) as pool:
            for result in pool.imap_unordered(function, tasks):
                yield result
                bar.update()
