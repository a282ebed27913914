"""Errors that a user can act on, and the checks that raise them."""

import math
from collections.abc import Iterable
from difflib import get_close_matches
from numbers import Integral, Real
from typing import TypeVar

import torch
from torch import Tensor

_ROUNDING = 1e-3

Name = TypeVar("Name", bound=str)


class SemfovError(Exception):
    """Base of every error that semfov raises on purpose; its message names the thing and the remedy."""


class InputError(SemfovError, ValueError):
    """An argument, a setting or a tensor is not what the call needs."""


class DataError(SemfovError):
    """A file (image, annotations, weights, cache) is missing, damaged or of the wrong shape."""


def check(condition: bool, argument: str, expected: str, got: object) -> None:
    """Raise `InputError` unless `condition` holds: the argument, what was expected and what came.

    >>> check(True, "sigma", "a positive number", 3.0)
    """
    if not condition:
        raise InputError(f"{argument}: expected {expected}, got {got}")


def values_known(*tensors: Tensor) -> bool:
    """Whether the values of tensors can be read: not while a graph is traced, nor under transforms of `torch.func`.

    >>> values_known(torch.ones(2))
    True
    >>> torch.func.vmap(lambda row: torch.tensor(values_known(row)))(torch.ones(2, 3))
    tensor([False, False])
    """
    if torch.compiler.is_compiling():
        return False
    try:
        for tensor in tensors:
            # A transform wraps its tensors, and what it wraps has no memory of its own.
            tensor.data_ptr()
    except RuntimeError:
        return False
    return True


def check_shape(tensor: Tensor, argument: str, *shape: int | None) -> None:
    """Raise `InputError` unless the last dimensions of `tensor` are `shape` (`None` stands for any size).

    >>> check_shape(torch.zeros(2, 3, 4), "boxes", None, 4)
    """
    sizes = tuple(tensor.shape[-len(shape) :])
    if tensor.ndim >= len(shape) and all(s is None or s == n for s, n in zip(shape, sizes, strict=True)):
        return
    # Only now: graphs with dynamic sizes cannot write them out.
    wanted = ", ".join("any" if s is None else str(s) for s in shape)
    check(False, argument, f"a tensor of shape (..., {wanted})", tuple(tensor.shape))


def check_whole(value: object, argument: str, low: int, high: int) -> None:
    """Raise `InputError` unless `value` is a whole number from `low` to `high`.

    >>> check_whole(3, "shifts", 0, 10)
    """
    inside = isinstance(value, Integral) and not isinstance(value, bool) and low <= int(value) <= high
    check(inside, argument, f"a whole number from {low:,} to {high:,}", repr(value))


def check_number(value: object, argument: str, low: float, high: float) -> None:
    """Raise `InputError` unless `value` is a number from `low` to `high`.

    >>> check_number(0.5, "threshold", 0, 1)
    """
    inside = isinstance(value, Real) and not isinstance(value, bool) and low <= float(value) <= high
    check(inside, argument, f"a number from {low:g} to {high:g}", repr(value))


def check_pixels(image: Tensor, argument: str) -> None:
    """Raise `InputError` where an image is not RGB in [0, 1] up to rounding: bytes, say, or NaN.

    >>> check_pixels(torch.rand(1, 3, 4, 4), "image")
    """
    if not values_known(image) or not image.numel():
        return
    least, most = (float(bound) for bound in image.detach().aminmax())
    inside = least >= -_ROUNDING and most <= 1 + _ROUNDING
    got = "NaN" if math.isnan(least) else f"numbers from {least:g} to {most:g}"
    check(inside, argument, "RGB in [0, 1]", f"{got}; {_to_unit(least, most)}")


def _to_unit(least: float, most: float) -> str:
    """What to do with pixels of such a range."""
    if not math.isfinite(least + most):
        return "replace what is no number (torch.nan_to_num)"
    if least >= -0.25 and most <= 1.25:
        return "clamp to [0, 1] what resampling has carried beyond"
    if least < 0:
        return (
            "undo the normalisation: image * std + mean, for ImageNet's with mean (0.485, 0.456, 0.406) and std "
            "(0.229, 0.224, 0.225), or (image + 1) / 2 where it was to [-1, 1]"
        )
    return "divide by 255" if most <= 255.5 else "divide by the value of white"


def check_finite(tensor: Tensor, argument: str) -> None:
    """Raise `InputError` where `tensor` holds a NaN or an infinity."""
    bad = int((~torch.isfinite(tensor)).sum())
    check(bad == 0, argument, "finite numbers", f"{bad} of {tensor.numel()} that are not")


def lookup(name: str, known: Iterable[Name], what: str) -> Name:
    """Return `name` if it is `known`, else raise `InputError` with the nearest known names.

    >>> lookup("cup", ["cup", "cat"], "class")
    'cup'
    """
    names = list(known)
    if name in names:
        return names[names.index(name)]
    near = get_close_matches(name, names, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(map(repr, near))}?" if near else f"known: {', '.join(names)}"
    raise InputError(f"unknown {what} {name!r}; {hint}")
