"""What a file of tensors and JSON values must hold: names, shapes, types and ranges, told once and checked once."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from semfov.errors import check

Size = int | str
"""A number, or a name such as `K` that stands for the same number throughout, or `K+1`, `N-1`."""
Sizes = dict[str, int]
"""What the names of sizes stand for, as far as it is known."""

FLOATS = (torch.float32, torch.float64)


@dataclass(frozen=True)
class Field:
    """A tensor of numbers.

    Attributes:
        shape: its sizes.
        dtype: its type; None is float32 or float64, one and the same for all such tensors of a file.
        low: least value.
        high: largest value.
        above: every value is larger than this.
        ascending: values grow along the tensor.
        simplex: the last dimension sums to 1.
        optional: whether it may be missing.
        finite: whether infinities and NaN are refused.
        mixed: with no `dtype`, whether its type may be another than that of other tensors.
    """

    shape: tuple[Size, ...]
    dtype: torch.dtype | None = None
    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    ascending: bool = False
    simplex: bool = False
    optional: bool = False
    finite: bool = True
    mixed: bool = False

    def check(self, name: str, tensor: Tensor, sizes: Sizes) -> None:
        """Raise `InputError` unless a tensor is so; names of sizes that were not known before are now."""
        fits = tensor.ndim == len(self.shape) and all(map(_fits, self.shape, tensor.shape, [sizes] * tensor.ndim))
        told = ", ".join(str(size) for size in self.shape)
        known = ", ".join(f"{key} = {value}" for key, value in sizes.items())
        check(fits, name, f"shape ({told})" + (f" with {known}" if known else ""), tuple(tensor.shape))
        types = FLOATS if self.dtype is None else (self.dtype,)
        check(tensor.dtype in types, name, " or ".join(map(str, types)), tensor.dtype)
        if not tensor.numel() or not self.finite:
            return
        values = tensor.to(torch.float64)
        bad = int((~values.isfinite()).sum())
        check(bad == 0, name, "finite numbers", f"{bad} of {tensor.numel()} that are not")
        least, most = float(values.min()), float(values.max())
        inside = self.low <= least and most <= self.high and least > self.above
        check(inside, name, interval(self.low, self.high, self.above), least if most <= self.high else most)
        check(not self.ascending or bool((values.diff() > 0).all()), name, "ascending numbers", "others")
        off = float((values.sum(-1) - 1).abs().max()) if self.simplex else 0.0
        check(off <= 1e-2, name, "numbers that sum to 1 along the last dimension", f"sums that are off by {off:.2g}")


class Json(ABC):
    """What a JSON value must be."""

    @abstractmethod
    def check(self, name: str, value: Any, sizes: Sizes) -> None:
        """Raise `InputError` unless a value is so; names of sizes that were not known before are now."""


@dataclass(frozen=True)
class Number(Json):
    """A finite number.

    Attributes:
        low: least value.
        high: largest value.
        above: it is larger than this.
        size: name of a size that it tells; it is then a whole number from 1.
        whole: whether it is a whole number.
    """

    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    size: Size | None = None
    whole: bool = False

    def check(self, name: str, value: Any, sizes: Sizes) -> None:
        """See `Json`."""
        whole = self.whole or self.size is not None
        check(is_number(value, whole=whole), name, "a whole number" if whole else "a finite number", shown(value))
        if self.size is not None:
            check(value >= 1 and _fits(self.size, value, sizes), name, f"{self.size}, at least 1", shown(value))
        inside = self.low <= value <= self.high and value > self.above
        check(inside, name, interval(self.low, self.high, self.above), shown(value))


class Flag(Json):
    """True or false."""

    def check(self, name: str, value: Any, sizes: Sizes) -> None:
        """See `Json`."""
        check(isinstance(value, bool), name, "true or false", shown(value))


@dataclass(frozen=True)
class Array(Json):
    """A list.

    Attributes:
        of: what every item must be.
        size: how many there are.
        least: there are at least so many.
        ascending: items grow.
        distinct: no item is there twice.
    """

    of: Json
    size: Size | None = None
    least: int = 0
    ascending: bool = False
    distinct: bool = False

    def check(self, name: str, value: Any, sizes: Sizes) -> None:
        """See `Json`."""
        check(isinstance(value, list | tuple), name, "a list", shown(value))
        fits = self.size is None or _fits(self.size, len(value), sizes)
        check(fits, name, f"{self.size} items", f"{len(value)} with {sizes}")
        check(len(value) >= self.least, name, f"at least {self.least} items", len(value))
        for place, item in enumerate(value):
            self.of.check(f"{name}[{place}]", item, sizes)
        grows = not self.ascending or all(a < b for a, b in pairwise(value))
        check(grows, name, "ascending numbers", shown(value))
        check(not self.distinct or len(set(value)) == len(value), name, "items that differ", "some twice")


@dataclass(frozen=True)
class Pair(Json):
    """A list of so many items, each of its own kind."""

    items: tuple[Json, ...]

    def check(self, name: str, value: Any, sizes: Sizes) -> None:
        """See `Json`."""
        fits = isinstance(value, list | tuple) and len(value) == len(self.items)
        check(fits, name, f"a list of {len(self.items)}", shown(value))
        for place, (item, kind) in enumerate(zip(value, self.items, strict=True)):
            kind.check(f"{name}[{place}]", item, sizes)


@dataclass(frozen=True)
class Text(Json):
    """A string, one of the options where there are any.

    Attributes:
        options: what it may be.
    """

    options: tuple[str, ...] = ()

    def check(self, name: str, value: Any, sizes: Sizes) -> None:
        """See `Json`."""
        fits = isinstance(value, str) and (value in self.options or not self.options)
        check(fits, name, f"one of {', '.join(self.options)}" if self.options else "text", shown(value))
        check(is_plain(value), name, "text without control characters", shown(value))


@dataclass(frozen=True)
class Object(Json):
    """A JSON object.

    Attributes:
        known: what values under these keys must be.
        others: what values under all other keys must be; None: there are none.
        required: keys that may not be missing.
    """

    known: Mapping[str, Json] = field(default_factory=dict)
    others: Json | None = None
    required: tuple[str, ...] = ()

    def check(self, name: str, value: Any, sizes: Sizes) -> None:
        """See `Json`."""
        check(isinstance(value, Mapping), name, "an object", shown(value))
        for key in self.required:
            check(key in value, f"{name}.{key}", "a value", "nothing")
        for key, item in value.items():
            kind = self.known.get(key, self.others)
            check(kind is not None, name, f"no other keys than {', '.join(self.known)}", shown(key))
            if kind is not None:
                kind.check(f"{name}.{key}", item, sizes)


@dataclass(frozen=True)
class Maybe(Json):
    """A value, or null."""

    of: Json

    def check(self, name: str, value: Any, sizes: Sizes) -> None:
        """See `Json`."""
        if value is not None:
            self.of.check(name, value, sizes)


class Anything(Json):
    """Any JSON value."""

    def check(self, name: str, value: Any, sizes: Sizes) -> None:
        """See `Json`."""


CLASSES = Array(Text(), "K", least=1, distinct=True)
"""Names of the K classes of a detector."""

METADATA = Object({"detector": Object(others=Anything()), "sensor": Object(others=Anything())}, Anything())
"""What is kept with a model for people and for `semfov.io.compatibility` to read."""


@dataclass(frozen=True)
class Schema:
    """Everything that a file holds.

    Attributes:
        tensors: by name.
        record: JSON values by name, those first that tell sizes.

    >>> schema = Schema({"weight": Field(("K", 2), low=0)}, {"classes": Array(Text(), "K")})
    >>> schema.check({"weight": torch.ones(3, 2)}, {"classes": ["cat", "cup", "tv"]})
    """

    tensors: Mapping[str, Field]
    record: Mapping[str, Json] = field(default_factory=dict)

    def check(self, tensors: Mapping[str, Tensor], record: Mapping[str, Any] | None = None) -> None:
        """Raise `InputError` unless tensors and record are so: the name, what was expected and what came."""
        sizes: Sizes = {}
        told = record or {}
        for name, kind in self.record.items():
            check(name in told or isinstance(kind, Maybe), name, "a value", "nothing")
            kind.check(name, told.get(name), sizes)
        for name in tensors:
            check(name in self.tensors, "tensors", f"none but {', '.join(self.tensors)}", shown(name))
        for name, each in self.tensors.items():
            check(name in tensors or each.optional, name, "a tensor", "nothing")
            if name in tensors:
                each.check(name, tensors[name], sizes)
        shared = [name for name, each in self.tensors.items() if each.dtype is None and not each.mixed]
        free = {tensors[name].dtype for name in shared if name in tensors}
        check(len(free) <= 1, "tensors", "one floating-point type for all", ", ".join(sorted(map(str, free))))


def perceptron(name: str, inputs: int, hidden: Size, outputs: int = 1, *, largest: float = 1e6) -> dict[str, Field]:
    """Tensors of a network of two hidden layers, an `nn.Sequential` with an activation after each."""
    layers: Sequence[tuple[Size, Size]] = ((hidden, inputs), (hidden, hidden), (outputs, hidden))
    tensors = {}
    for number, (out, into) in enumerate(layers):
        tensors[f"{name}.{2 * number}.weight"] = Field((out, into), low=-largest, high=largest)
        tensors[f"{name}.{2 * number}.bias"] = Field((out,), low=-largest, high=largest)
    return tensors


def convolution(name: str, into: Size, out: Size, side: int, *, largest: float = 1e6) -> dict[str, Field]:
    """Tensors of an `nn.Conv2d`."""
    weight = Field((out, into, side, side), low=-largest, high=largest)
    return {f"{name}.weight": weight, f"{name}.bias": Field((out,), low=-largest, high=largest)}


def interval(low: float, high: float, above: float = -math.inf) -> str:
    """A range in words.

    >>> interval(0, 1), interval(-math.inf, 5, above=0)
    ('numbers from 0 to 1', 'numbers above 0, up to 5')
    """
    least, most = (f"{bound:,}" if isinstance(bound, int) else f"{bound:g}" for bound in (low, high))
    if above > -math.inf:
        return f"numbers above {above:g}" + (f", up to {most}" if high < math.inf else "")
    if high == math.inf:
        return f"numbers from {least}" if low > -math.inf else "numbers"
    return f"numbers from {least} to {most}" if low > -math.inf else f"numbers up to {most}"


def is_number(value: object, *, whole: bool = False) -> bool:
    """Whether a JSON value is a finite number, and a whole one where that is asked for."""
    if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond the floats
        return False


def is_plain(text: str) -> bool:
    """Whether text can be written anywhere: no control characters and no halves of surrogate pairs.

    >>> is_plain("dining table"), is_plain("a" + chr(0)), is_plain(chr(0xD800))
    (True, False, False)
    """
    return not re.search("[\x00-\x1f\x7f-\x9f\ud800-\udfff]", text)


def shown(value: object) -> str:
    """A value as an error prints it: on one line and short."""
    try:
        text = ascii(value)
    except (ValueError, RecursionError):  # integers too long to print, lists too deep
        text = type(value).__name__
    return text if len(text) <= 60 else text[:57] + "..."


def _fits(size: Size, number: int, sizes: Sizes) -> bool:
    """Whether a size is what it is known to be; from now on it is known."""
    if isinstance(size, int):
        return size == number
    for sign, factor in (("+", -1), ("-", 1)):
        name, found, offset = size.partition(sign)
        if found:
            return sizes.setdefault(name, number + factor * int(offset)) == number + factor * int(offset)
    return sizes.setdefault(size, number) == number
