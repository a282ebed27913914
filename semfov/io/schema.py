"""Schemas of files of tensors and JSON values: names, shapes, types and ranges, and their checks."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from semfov.errors import DataError, InputError, check

_Size = int | str
"""A number, a name such as `K` that stands for the same number in the whole file, or a sum such as `K+1` or `N-1`."""
_Sizes = dict[str, int]  # the numbers that names of sizes stand for, as far as they are known

_FLOATS = (torch.float32, torch.float64)


@dataclass(frozen=True)
class Field:
    """Requirements of a tensor in a file."""

    shape: tuple[_Size, ...]
    dtype: torch.dtype | None = None
    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    ascending: bool = False
    simplex: bool = False
    optional: bool = False
    finite: bool = True
    mixed: bool = False

    def check(self, name: str, tensor: Tensor, sizes: _Sizes) -> None:
        """Raise `InputError` unless a tensor meets the requirements; add the sizes that it determines to `sizes`."""
        fits = tensor.ndim == len(self.shape) and all(map(_fits, self.shape, tensor.shape, [sizes] * tensor.ndim))
        shape = ", ".join(str(size) for size in self.shape)
        equations = ", ".join(f"{key} = {value}" for key, value in sizes.items())
        check(fits, name, f"shape ({shape})" + (f" with {equations}" if equations else ""), tuple(tensor.shape))
        types = _FLOATS if self.dtype is None else (self.dtype,)
        check(tensor.dtype in types, name, " or ".join(map(str, types)), tensor.dtype)
        if not tensor.numel() or not self.finite:
            return
        values = tensor.to(torch.float64)
        bad = int((~values.isfinite()).sum())
        check(bad == 0, name, "finite numbers", f"{bad} of {tensor.numel()} that are not finite")
        least, most = float(values.min()), float(values.max())
        inside = self.low <= least and most <= self.high and least > self.above
        check(inside, name, interval(self.low, self.high, self.above), least if most <= self.high else most)
        check(not self.ascending or bool((values.diff() > 0).all()), name, "ascending numbers", "unsorted ones")
        off = float((values.sum(-1) - 1).abs().max()) if self.simplex else 0.0
        expected = "numbers that sum to 1 along the last dimension"
        check(off <= 1e-2, name, expected, f"sums that differ from 1 by {off:.2g}")


class Json:
    """Base of the requirements of a JSON value; any value meets its own."""

    def check(self, name: str, value: Any, sizes: _Sizes) -> None:
        """Raise `InputError` unless a value meets the requirements; add the sizes that it determines to `sizes`."""


@dataclass(frozen=True)
class Number(Json):
    """Requirement of a JSON value: a finite number."""

    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    size: _Size | None = None
    whole: bool = False

    def check(self, name: str, value: Any, sizes: _Sizes) -> None:
        whole = self.whole or self.size is not None
        check(is_number(value, whole=whole), name, "a whole number" if whole else "a finite number", excerpt(value))
        if self.size is not None:
            check(value >= 1 and _fits(self.size, value, sizes), name, f"{self.size}, at least 1", excerpt(value))
        inside = self.low <= value <= self.high and value > self.above
        check(inside, name, interval(self.low, self.high, self.above), excerpt(value))


class Flag(Json):
    """Requirement of a JSON value: true or false."""

    def check(self, name: str, value: Any, sizes: _Sizes) -> None:
        check(isinstance(value, bool), name, "true or false", excerpt(value))


@dataclass(frozen=True)
class Array(Json):
    """Requirement of a JSON value: a list, of items of one kind or with a kind for each."""

    of: Json | tuple[Json, ...]
    size: _Size | None = None
    least: int = 0
    ascending: bool = False
    distinct: bool = False

    def check(self, name: str, value: Any, sizes: _Sizes) -> None:
        check(isinstance(value, list | tuple), name, "a list", excerpt(value))
        size = len(self.of) if isinstance(self.of, tuple) else self.size
        fits = size is None or _fits(size, len(value), sizes)
        check(fits, name, f"{size} items", f"{len(value)}" + (f" with {sizes}" if sizes else ""))
        check(len(value) >= self.least, name, f"at least {self.least} items", len(value))
        kinds = self.of if isinstance(self.of, tuple) else [self.of] * len(value)
        for place, (item, kind) in enumerate(zip(value, kinds, strict=True)):
            kind.check(f"{name}[{place}]", item, sizes)
        grows = not self.ascending or all(a < b for a, b in pairwise(value))
        check(grows, name, "ascending numbers", excerpt(value))
        check(not self.distinct or len(set(value)) == len(value), name, "items that differ", "repeated items")


@dataclass(frozen=True)
class Text(Json):
    """Requirement of a JSON value: a string without control characters."""

    options: tuple[str, ...] | None = None

    def check(self, name: str, value: Any, sizes: _Sizes) -> None:
        fits = isinstance(value, str) and (self.options is None or value in self.options)
        named = f"one of {', '.join(self.options)}" if self.options else "no text"
        check(fits, name, "text" if self.options is None else named, excerpt(value))
        check(is_plain(value), name, "text without control characters", excerpt(value))


@dataclass(frozen=True)
class Object(Json):
    """Requirement of a JSON value: an object."""

    keys: Mapping[str, Json] = field(default_factory=dict)
    others: Json | None = None
    required: tuple[str, ...] = ()

    def check(self, name: str, value: Any, sizes: _Sizes) -> None:
        check(isinstance(value, Mapping), name, "an object", excerpt(value))
        for key in self.required:
            check(key in value, f"{name}.{key}", "a value", "nothing")
        for key, item in value.items():
            kind = self.keys.get(key, self.others)
            check(kind is not None, name, f"no other keys than {', '.join(self.keys)}", excerpt(key))
            if kind is not None:
                kind.check(f"{name}.{key}", item, sizes)


@dataclass(frozen=True)
class Maybe(Json):
    """Requirement of a JSON value: null, or a value that meets another requirement."""

    of: Json

    def check(self, name: str, value: Any, sizes: _Sizes) -> None:
        if value is not None:
            self.of.check(name, value, sizes)


CLASSES = Array(Text(), "K", least=1, distinct=True)  # names of the K classes of a detector


@dataclass(frozen=True)
class Schema:
    """Requirements of a whole file."""

    tensors: Mapping[str, Field]
    record: Mapping[str, Json] = field(default_factory=dict)

    def check(self, tensors: Mapping[str, Tensor], record: Mapping[str, Any] | None = None) -> None:
        """Raise `InputError` unless tensors and record meet the requirements."""
        sizes: _Sizes = {}
        values = record or {}
        for name, kind in self.record.items():
            check(name in values or isinstance(kind, Maybe), name, "a value", "nothing")
            kind.check(name, values.get(name), sizes)
        for name in tensors:
            check(name in self.tensors, "tensors", f"no others than {', '.join(self.tensors)}", excerpt(name))
        for name, each in self.tensors.items():
            check(name in tensors or each.optional, name, "a tensor", "nothing")
            if name in tensors:
                each.check(name, tensors[name], sizes)
        shared = [name for name, each in self.tensors.items() if each.dtype is None and not each.mixed]
        free = {tensors[name].dtype for name in shared if name in tensors}
        check(len(free) <= 1, "tensors", "one floating-point type for all", ", ".join(sorted(map(str, free))))


def check_content(where: object, value: Any, kind: Json) -> None:
    """Raise `DataError` with the name of a file unless its content meets the requirements."""
    try:
        kind.check("", value, {})
    except InputError as error:
        raise DataError(f"{where}: {str(error).lstrip('.: ')}") from None


def perceptron(name: str, inputs: int, hidden: _Size, outputs: int = 1, *, largest: float = 1e6) -> dict[str, Field]:
    """Requirements of the tensors of an `nn.Sequential` with two hidden layers, each followed by an activation."""
    layers: Sequence[tuple[_Size, _Size]] = ((hidden, inputs), (hidden, hidden), (outputs, hidden))
    tensors = {}
    for number, (out, into) in enumerate(layers):
        tensors[f"{name}.{2 * number}.weight"] = Field((out, into), low=-largest, high=largest)
        tensors[f"{name}.{2 * number}.bias"] = Field((out,), low=-largest, high=largest)
    return tensors


def interval(low: float, high: float, above: float = -math.inf) -> str:
    """Write a range in words."""
    least, most = (f"{bound:,}" if isinstance(bound, int) else f"{bound:g}" for bound in (low, high))
    if above > -math.inf:
        return f"numbers above {above:g}" + (f", up to {most}" if high < math.inf else "")
    if high == math.inf:
        return f"numbers from {least}" if low > -math.inf else "numbers"
    return f"numbers from {least} to {most}" if low > -math.inf else f"numbers up to {most}"


def is_number(value: object, *, whole: bool = False) -> bool:
    """Whether a JSON value is a finite number; with `whole`, whether it is a finite whole number."""
    if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer larger than any float
        return False


def is_plain(text: str) -> bool:
    """Tell whether text is safe to write anywhere: no control characters and no halves of surrogate pairs."""
    return not re.search("[\x00-\x1f\x7f-\x9f\ud800-\udfff]", text)


def excerpt(value: object) -> str:
    """A value as error messages print it: on one line and short."""
    try:
        text = ascii(value)
    except (ValueError, RecursionError):  # integers too long to print, lists too deep
        text = type(value).__name__
    return text if len(text) <= 60 else text[:57] + "..."


def _fits(size: _Size, number: int, sizes: _Sizes) -> bool:
    """Whether a number agrees with a size; a size that was unknown is known from then on."""
    if isinstance(size, int):
        return size == number
    for sign, factor in (("+", -1), ("-", 1)):
        name, separator, offset = size.partition(sign)
        if separator:
            return sizes.setdefault(name, number + factor * int(offset)) == number + factor * int(offset)
    return sizes.setdefault(size, number) == number
