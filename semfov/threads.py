"""Small tensors are worked on by one thread, because threads that wait for each other cost more than they save."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import is_dataclass
from functools import wraps
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

_MANY_ELEMENTS = 1 << 22
"""Number of elements of a tensor from which on several threads are used."""

_Arguments = ParamSpec("_Arguments")
_Returned = TypeVar("_Returned")


def one_thread_if_small(function: Callable[_Arguments, _Returned]) -> Callable[_Arguments, _Returned]:
    """Decorate a function of tensors, so that one thread of the CPU works on small ones.

    PyTorch divides an operation on more than 32,768 elements among its threads, and waits for the last one. If another
    program uses a core, that thread waits for its turn, at each of the many operations of a fixation.
    """

    @wraps(function)
    def sparing(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Returned:
        if torch.compiler.is_compiling():
            return function(*args, **kwargs)
        before = torch.get_num_threads()
        if before == 1 or max(sizes(args), default=0) >= _MANY_ELEMENTS:
            return function(*args, **kwargs)
        torch.set_num_threads(1)
        try:
            return function(*args, **kwargs)
        finally:
            torch.set_num_threads(before)

    return sparing


def sizes(values: Iterable[object]) -> Iterator[int]:
    """Numbers of elements of the tensors among values, and in tuples and dataclasses among them."""
    for value in values:
        if isinstance(value, Tensor):
            yield value.numel()
        elif isinstance(value, tuple):
            yield from sizes(value)
        elif is_dataclass(value):
            yield from sizes(vars(value).values())
