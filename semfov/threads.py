"""Threads: one thread for small tensors, which is faster than several, and one beside a detector."""

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import is_dataclass
from functools import wraps
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

_MANY_ELEMENTS = 1 << 22  # number of elements of a tensor from which on several threads are used

_Arguments = ParamSpec("_Arguments")
_Returned = TypeVar("_Returned")


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread: the last bits of a parallel sum depend on the number, and small tensors need no others.

    PyTorch's number of threads is also that of every thread of Python that starts meanwhile, and that one keeps it. So
    this does nothing outside the main thread, in a server for example, whose threads would get it from each other.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def one_thread_if_small(function: Callable[_Arguments, _Returned]) -> Callable[_Arguments, _Returned]:
    """Decorate a function of tensors, so that one thread of the CPU works on small ones.

    PyTorch waits for the last of its threads at each of the many operations, however busy the cores are. Nothing
    changes outside the main thread of Python, as with `one_thread`.
    """

    @wraps(function)
    def sparing(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Returned:
        if torch.compiler.is_compiling():
            return function(*args, **kwargs)
        before = torch.get_num_threads()
        if before == 1 or max(_sizes(args), default=0) >= _MANY_ELEMENTS:
            return function(*args, **kwargs)
        with one_thread():
            return function(*args, **kwargs)

    return sparing


def _sizes(values: Iterable[object]) -> Iterator[int]:
    """Numbers of elements of the tensors among values, and in tuples and dataclasses among them."""
    for value in values:
        if isinstance(value, Tensor):
            yield value.numel()
        elif isinstance(value, tuple):
            yield from _sizes(value)
        elif is_dataclass(value):
            yield from _sizes(vars(value).values())


def available_cores() -> int:
    """Count the CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def beside(work: Callable[[], object] | None, *, idle: bool) -> Iterator[None]:
    """Have a second thread do some work while the block computes, if the block leaves a core `idle`, or PyTorch does.

    It is left out where processes of one command share the cores, and what fails in it is left to who needs its result.
    """
    are_shared = multiprocessing.parent_process() is not None
    has_core = idle or torch.get_num_threads() < available_cores()
    if work is None or are_shared or not has_core:
        yield
        return

    def run() -> None:
        # Until a thread has asked PyTorch for its number of threads, its matrix products run on all cores.
        torch.get_num_threads()
        with suppress(Exception), torch.no_grad():
            work()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        thread.join()
