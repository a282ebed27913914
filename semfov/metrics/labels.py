"""Outcomes, scores and labels as people give them: tensors, arrays and lists of any type."""

import math
from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from semfov.errors import InputError, check, values_known


def as_numbers(values: Any, argument: str) -> Tensor:
    """Numbers of any common type as a tensor of floats; NaN is refused, because it compares with nothing."""
    tensor = _as_tensor(values, argument)
    check(not tensor.is_complex(), argument, "real numbers", "complex ones")
    floats = tensor if tensor.is_floating_point() else tensor.double()
    if values_known(floats):
        missing = int(floats.isnan().sum())
        check(not missing, argument, "numbers", f"NaN in {missing} of {floats.numel()}; leave these cases out")
    return floats


def as_outcomes(values: Any, argument: str) -> Tensor:
    """Outcomes of any common type as booleans; other numbers than 0 and 1 are refused."""
    tensor = _as_tensor(values, argument)
    if tensor.dtype == torch.bool:
        return tensor
    if values_known(tensor):
        others = tensor[(tensor != 0) & (tensor != 1)]
        got = f"{others.flatten()[0].item()}" if others.numel() else ""
        check(not others.numel(), argument, "true and false, or 1 and 0", got)
    return tensor == 1


def as_labels(labels: Any, argument: str, *, least: int = 0) -> list[Hashable]:
    """At least `least` labels, as values that are equal where they are; a tensor's elements equal themselves alone."""
    check(hasattr(labels, "__iter__"), argument, "labels in a row", f"a {type(labels).__name__}")
    given = labels if isinstance(labels, Tensor | np.ndarray) else [*labels]
    check(not hasattr(given, "ndim") or given.ndim == 1, argument, "labels in a row", f"shape {tuple(np.shape(given))}")
    values = given.tolist() if isinstance(given, Tensor | np.ndarray) else [_plain(each) for each in given]
    check(not any(isinstance(each, float) and math.isnan(each) for each in values), argument, "labels", "NaN")
    check(len(values) >= least, argument, "at least one label", "none")
    return values


def _plain(label: Any) -> Any:
    scalar = isinstance(label, np.generic) or (isinstance(label, Tensor | np.ndarray) and label.ndim == 0)
    value = label.item() if scalar else label
    try:
        hash(value)
    except TypeError:
        value = None
    named = value is not None and not isinstance(value, Tensor)
    check(named, "labels", "names or numbers", f"a {type(label).__name__} of shape {tuple(np.shape(label))}")
    return value


def _as_tensor(values: Any, argument: str) -> Tensor:
    if isinstance(values, Tensor):
        return values.to_dense() if values.layout != torch.strided else values
    try:
        array = np.asarray([*values] if isinstance(values, Sequence) else values)
        return torch.as_tensor(array if array.flags.writeable else array.copy())
    except (TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{argument}: expected numbers, got {type(values).__name__} ({reason[:100]})") from None
