"""Constants of sizes and settings: matrices and positions that are computed once and kept."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, wraps
from typing import Any, TypeVar, TypeVarTuple

import torch
from torch import Tensor

_Constant = TypeVar("_Constant")
_Settings = TypeVarTuple("_Settings")


def mark_constant(function: Callable[..., object]) -> None:
    """Mark a function of settings as one that the compiler calls, instead of tracing it.

    `torch.compiler.assume_constant_result` does nothing else, but it imports the compiler, which takes a second even
    for users who compile nothing.
    """
    function._dynamo_marked_constant = True  # type: ignore[attr-defined]


def constant(function: Callable[[*_Settings], _Constant]) -> Callable[[*_Settings], _Constant]:
    """Cache the results of a function of sizes and settings.

    A graph that is compiled or exported holds the kept tensors as its constants, not the operations that make them.

    Args:
        function: a function of hashable settings (numbers, names, tuples of them, dtypes, devices); its result is a
            tensor, or a tuple or dataclass of tensors, which nobody changes.

    Returns:
        The function with a cache.

    >>> @constant
    ... def ramp(length: int, dtype: torch.dtype) -> Tensor:
    ...     return torch.arange(length, dtype=dtype)
    >>> ramp(3, torch.float64) is ramp(3, torch.float64)
    True
    """

    @lru_cache(maxsize=256)
    def remember(*settings: Any) -> Any:
        # A tensor that is made during inference must be usable with gradients later.
        with torch.inference_mode(False), torch.no_grad():
            return function(*settings)

    def remember_in_graph(*settings: Any) -> Any:
        return remember(*settings)

    mark_constant(remember_in_graph)

    @wraps(function)
    def call(*settings: *_Settings) -> _Constant:
        if torch.compiler.is_dynamo_compiling():
            return remember_in_graph(*_fixed(settings))
        if torch.compiler.is_compiling():
            # The exporter runs Python itself, with tensors that have no values. It does so in this thread alone, and
            # in another one they have some.
            with ThreadPoolExecutor(1) as thread:
                return thread.submit(remember, *_fixed(settings)).result()
        if type(torch.empty(0)) is not Tensor:
            # Another tracer: tensors that are made in it are of a kind of its own, which must not be kept.
            return function(*settings)
        return remember(*settings)

    return call


def _fixed(settings: tuple[Any, ...]) -> tuple[Any, ...]:
    """Turn the symbolic sizes of a traced graph into numbers: the graph is then one for these sizes."""
    # A tracer has loaded this module; by itself it takes half a second to import.
    from torch.fx.experimental.symbolic_shapes import guard_scalar

    fixed: list[Any] = []
    for setting in settings:
        if isinstance(setting, tuple):
            fixed.append(_fixed(setting))
        elif isinstance(setting, int | torch.SymInt):
            fixed.append(guard_scalar(setting))
        else:
            fixed.append(setting)
    return tuple(fixed)
