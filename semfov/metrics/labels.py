"""Outcomes, scores and labels as people give them: tensors, arrays and lists of any type."""

import math
from collections.abc import Hashable, Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from semfov.errors import InputError, check, reason_of, type_of, values_known


def as_numbers(values: object, argument: str) -> Tensor:
    """Convert numbers of any common type to a tensor of floats.

    Args:
        values: a tensor, an array or a list.
        argument: name of the argument, for the message.

    Returns:
        Floats in the shape of the values.

    Raises:
        InputError: they are no real numbers, or have NaN, which compares with nothing.
    """
    tensor = _as_tensor(values, argument)
    check(not tensor.is_complex(), argument, "real numbers", "complex ones")
    floats = tensor if tensor.is_floating_point() else tensor.double()
    if values_known(floats):
        missing = int(floats.isnan().sum())
        check(missing == 0, argument, "numbers", f"NaN in {missing} of {floats.numel()}; leave these cases out")
    return floats


def as_outcomes(values: object, argument: str) -> Tensor:
    """Convert outcomes of any common type to booleans.

    Args:
        values: a tensor, an array or a list.
        argument: name of the argument, for the message.

    Returns:
        Booleans in the shape of the values.

    Raises:
        InputError: there are other numbers than 0 and 1.
    """
    tensor = _as_tensor(values, argument)
    if tensor.dtype == torch.bool:
        return tensor
    if values_known(tensor):
        others = tensor[(tensor != 0) & (tensor != 1)]
        got = others.flatten()[0].item() if others.numel() else ""
        check(not others.numel(), argument, "true and false, or 1 and 0", got)
    return tensor == 1


def as_labels(labels: Iterable[object], argument: str, *, least: int = 0) -> list[Hashable]:
    """Take labels as values that are equal where they are; the elements of a tensor equal themselves alone.

    Args:
        labels: names or numbers, in a list, an array or a tensor.
        argument: name of the argument, for the message.
        least: least number of labels, 0 or 1.

    Returns:
        The labels.

    Raises:
        InputError: they are in no row, too few, NaN, or nothing that can be compared.
    """
    check(hasattr(labels, "__iter__"), argument, "labels in a row", type_of(labels))
    if isinstance(labels, Tensor | np.ndarray):
        check(labels.ndim == 1, argument, "labels in a row", f"shape {tuple(np.shape(labels))}")
        values = labels.tolist()
    else:
        values = list(map(_plain, labels))
    check(not any(map(_is_nan, values)), argument, "labels", "NaN")
    check(len(values) >= least, argument, "at least one label", "none")
    return values


def _is_nan(value: object) -> bool:
    """Tell whether a value is NaN, which does not even equal itself."""
    return isinstance(value, float) and math.isnan(value)


def _plain(label: Any) -> Hashable:
    """Take a scalar of NumPy or torch as a number of Python; refuse what cannot be compared."""
    # A scalar of NumPy has no dimensions, as an array or a tensor of one number.
    is_scalar = isinstance(label, np.generic | np.ndarray | Tensor) and label.ndim == 0
    value = label.item() if is_scalar else label
    # A tensor has a hash, but equals itself alone.
    is_comparable = _has_hash(value) and not isinstance(value, Tensor | None)
    got = f"{type_of(label)} of shape {tuple(np.shape(label))}"
    check(is_comparable, "labels", "names or numbers", got)
    return value


def _has_hash(value: object) -> bool:
    """Tell whether a value has a hash, also if it holds others, as a tuple does."""
    try:
        hash(value)
    except TypeError:
        return False
    return True


def _as_tensor(values: object, argument: str) -> Tensor:
    """Take values of any common type as a dense tensor."""
    if isinstance(values, Tensor):
        return values.to_dense() if values.layout != torch.strided else values
    try:
        listed = list(values) if isinstance(values, Sequence) else values  # sequences that NumPy does not know, too
        array = np.asarray(listed)
        if not array.flags.writeable:
            array = array.copy()  # torch warns of memory that it may not write to
        return torch.as_tensor(array)
    except (TypeError, ValueError) as error:
        reason = reason_of(error)
        raise InputError(f"{argument}: expected numbers, got {type(values).__name__} ({reason[:100]})") from None
