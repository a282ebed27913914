"""Schemas of files of tensors and JSON values: names, shapes, types and ranges, and their checks."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor

from semfov.errors import DataError, InputError, check

_Size = int | str
"""A number, a name such as `K` that stands for the same number in the whole file, or a sum such as `K+1` or `N-1`."""
_Sizes = dict[str, int]  # the numbers that names of sizes stand for, as far as they are known

_FLOATS = (torch.float32, torch.float64)
_SIMPLEX_ERROR = 1e-2  # the sum of many numbers of 32 bits differs from 1 by their rounding
_LARGEST = 1e6  # magnitude of the values of a fitted perceptron


@dataclass(frozen=True)
class Field:
    """Requirements of a tensor in a file.

    Attributes:
        shape: its sizes, as numbers or names.
        dtype: its type; None for 32 or 64 bits of floating point.
        low: least value.
        high: largest value.
        above: number that all values are above.
        ascending: whether each value is above the one before.
        simplex: whether values sum to 1 along the last dimension.
        optional: whether it may be missing.
        finite: whether all values are finite; False checks no values.
        mixed: whether its floating-point type may differ from that of other tensors.
    """

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
        self._check_shape(name, tensor, sizes)
        types = _FLOATS if self.dtype is None else (self.dtype,)
        expected = " or ".join(map(str, types))
        check(tensor.dtype in types, name, expected, tensor.dtype)
        if tensor.numel() and self.finite:
            self._check_values(name, tensor.to(torch.float64))

    def _check_shape(self, name: str, tensor: Tensor, sizes: _Sizes) -> None:
        """Raise `InputError` unless a tensor has the shape; add the sizes that it determines to `sizes`."""
        shape = tuple(tensor.shape)
        has_shape = len(shape) == len(self.shape) and all(
            _agrees(size, number, sizes) for size, number in zip(self.shape, shape, strict=True)
        )
        symbols = ", ".join(map(str, self.shape))
        meanings = ", ".join(f"{symbol} = {number}" for symbol, number in sizes.items())
        expected = f"shape ({symbols}) with {meanings}" if meanings else f"shape ({symbols})"
        check(has_shape, name, expected, shape)

    def _check_values(self, name: str, values: Tensor) -> None:
        """Raise `InputError` unless values meet the requirements."""
        infinite = int((~values.isfinite()).sum())
        check(infinite == 0, name, "finite numbers", f"{infinite} of {values.numel()} that are not finite")
        least = float(values.min())
        most = float(values.max())
        # All values are inside if these two are, and one that is too large is told first.
        outlier = most if most > self.high else least
        check(_is_inside(outlier, self), name, interval(self.low, self.high, self.above), outlier)
        if self.ascending:
            is_ascending = bool((values.diff() > 0).all())
            check(is_ascending, name, "ascending numbers", "unsorted ones")
        if self.simplex:
            error = float((values.sum(-1) - 1).abs().max())
            expected = "numbers that sum to 1 along the last dimension"
            check(error <= _SIMPLEX_ERROR, name, expected, f"sums that differ from 1 by {error:.2g}")


class Json:
    """Base of the requirements of a JSON value; any value meets its own."""

    def check(self, name: str, value: object, sizes: _Sizes) -> None:
        """Raise `InputError` unless a value meets the requirements; add the sizes that it determines to `sizes`."""


@dataclass(frozen=True)
class Number(Json):
    """Requirement of a JSON value: a finite number.

    Attributes:
        low: least value.
        high: largest value.
        above: number that it is above.
        size: size that it stands for, such as `K`; then it is a whole number from 1 on.
        whole: whether it is a whole number.
    """

    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    size: _Size | None = None
    whole: bool = False

    def check(self, name: str, value: object, sizes: _Sizes) -> None:
        is_whole = self.whole or self.size is not None
        expected = "a whole number" if is_whole else "a finite number"
        check(is_number(value, whole=is_whole), name, expected, excerpt(value))
        number = cast(float, value)
        if self.size is not None:
            agrees = number >= 1 and _agrees(self.size, int(number), sizes)
            check(agrees, name, f"{self.size}, at least 1", excerpt(value))
        check(_is_inside(number, self), name, interval(self.low, self.high, self.above), excerpt(value))


def _is_inside(number: float, limits: Field | Number) -> bool:
    """Tell whether a number is in the range of a requirement."""
    return limits.low <= number <= limits.high and number > limits.above


class Flag(Json):
    """Requirement of a JSON value: true or false."""

    def check(self, name: str, value: object, sizes: _Sizes) -> None:
        check(isinstance(value, bool), name, "true or false", excerpt(value))


@dataclass(frozen=True)
class Array(Json):
    """Requirement of a JSON value: a list.

    Attributes:
        of: kind of all items, or a kind for each.
        size: number of items, or a name for it; None for any.
        least: least number of items.
        ascending: whether each item is above the one before.
        distinct: whether all items differ.
    """

    of: Json | tuple[Json, ...]
    size: _Size | None = None
    least: int = 0
    ascending: bool = False
    distinct: bool = False

    def check(self, name: str, value: object, sizes: _Sizes) -> None:
        check(isinstance(value, list | tuple), name, "a list", excerpt(value))
        items = cast(Sequence[object], value)
        self._check_length(name, len(items), sizes)
        kinds = self.of if isinstance(self.of, tuple) else [self.of] * len(items)
        for place, (item, kind) in enumerate(zip(items, kinds, strict=True)):
            kind.check(f"{name}[{place}]", item, sizes)
        if self.ascending:
            numbers = cast(Sequence[float], items)
            is_ascending = all(first < second for first, second in pairwise(numbers))
            check(is_ascending, name, "ascending numbers", excerpt(value))
        if self.distinct:
            check(len(set(items)) == len(items), name, "items that differ", "repeated items")

    def _check_length(self, name: str, length: int, sizes: _Sizes) -> None:
        """Raise `InputError` unless a list has the number of items; add the sizes that it determines to `sizes`."""
        size = len(self.of) if isinstance(self.of, tuple) else self.size
        if size is not None:
            has_size = _agrees(size, length, sizes)
            got = f"{length} with {sizes}" if sizes else f"{length}"
            check(has_size, name, f"{size} items", got)
        check(length >= self.least, name, f"at least {self.least} items", length)


@dataclass(frozen=True)
class Text(Json):
    """Requirement of a JSON value: a string without control characters.

    Attributes:
        options: the strings that are allowed; None for any.
    """

    options: tuple[str, ...] | None = None

    def check(self, name: str, value: object, sizes: _Sizes) -> None:
        is_option = isinstance(value, str) and (self.options is None or value in self.options)
        expected = "text" if self.options is None else f"one of {', '.join(self.options)}"
        check(is_option, name, expected, excerpt(value))
        check(is_plain(cast(str, value)), name, "text without control characters", excerpt(value))


@dataclass(frozen=True)
class Object(Json):
    """Requirement of a JSON value: an object.

    Attributes:
        keys: kinds of the values, by key.
        others: kind of the values of other keys; None allows no others.
        required: keys that must be there.
    """

    keys: Mapping[str, Json] = field(default_factory=dict)
    others: Json | None = None
    required: tuple[str, ...] = ()

    def check(self, name: str, value: object, sizes: _Sizes) -> None:
        check(isinstance(value, Mapping), name, "an object", excerpt(value))
        values = cast(Mapping[str, object], value)
        for key in self.required:
            check(key in values, f"{name}.{key}", "a value", "nothing")
        for key, item in values.items():
            kind = self.keys.get(key, self.others)
            if kind is None:
                raise InputError(f"{name}: expected no other keys than {', '.join(self.keys)}, got {excerpt(key)}")
            kind.check(f"{name}.{key}", item, sizes)


@dataclass(frozen=True)
class Maybe(Json):
    """Requirement of a JSON value: null, or a value that meets another requirement.

    Attributes:
        of: that requirement.
    """

    of: Json

    def check(self, name: str, value: object, sizes: _Sizes) -> None:
        if value is not None:
            self.of.check(name, value, sizes)


CLASSES = Array(Text(), "K", least=1, distinct=True)  # names of the K classes of a detector


@dataclass(frozen=True)
class Schema:
    """Requirements of a whole file.

    Attributes:
        tensors: requirements of the tensors, by name.
        record: requirements of the JSON values, by name.
    """

    tensors: Mapping[str, Field]
    record: Mapping[str, Json] = field(default_factory=dict)

    def check(self, tensors: Mapping[str, Tensor], record: Mapping[str, object] | None = None) -> None:
        """Check that tensors and record meet the requirements.

        Args:
            tensors: by name.
            record: JSON values by name; None for none.

        Raises:
            InputError: one does not, is missing, or is not required.
        """
        # The record first: it determines sizes, such as the number of classes, that tensors are compared with.
        sizes: _Sizes = {}
        values = record or {}
        for name, kind in self.record.items():
            check(name in values or isinstance(kind, Maybe), name, "a value", "nothing")
            kind.check(name, values.get(name), sizes)
        for name in tensors:
            check(name in self.tensors, "tensors", f"no others than {', '.join(self.tensors)}", excerpt(name))
        for name, requirement in self.tensors.items():
            if name in tensors:
                requirement.check(name, tensors[name], sizes)
            else:
                check(requirement.optional, name, "a tensor", "nothing")
        self._check_one_type(tensors)

    def _check_one_type(self, tensors: Mapping[str, Tensor]) -> None:
        """Raise `InputError` if tensors that must have the same floating-point type have several."""
        types: set[str] = set()
        for name, tensor in tensors.items():
            requirement = self.tensors[name]
            if requirement.dtype is None and not requirement.mixed:
                types.add(str(tensor.dtype))
        check(len(types) <= 1, "tensors", "one floating-point type for all", ", ".join(sorted(types)))


def check_content(where: object, value: object, kind: Json) -> None:
    """Check that the content of a file meets the requirements.

    Args:
        where: name of the file.
        value: its content, a JSON value.
        kind: the requirements.

    Raises:
        DataError: it does not.
    """
    try:
        kind.check("", value, {})
    except InputError as error:
        raise DataError(f"{where}: {str(error).lstrip('.: ')}") from None


def perceptron(name: str, inputs: int, hidden: _Size, outputs: int = 1) -> dict[str, Field]:
    """List the requirements of the tensors of an `nn.Sequential` with two hidden layers, each with an activation.

    Args:
        name: name of the module.
        inputs: number of inputs.
        hidden: number of units of a hidden layer.
        outputs: number of outputs.

    Returns:
        The requirements by name.
    """
    shapes_of_weights: Sequence[tuple[_Size, _Size]] = ((hidden, inputs), (hidden, hidden), (outputs, hidden))
    tensors = {}
    for number, shape in enumerate(shapes_of_weights):
        layer = f"{name}.{2 * number}"  # an activation, which has no tensors, follows each layer
        tensors[f"{layer}.weight"] = Field(shape, low=-_LARGEST, high=_LARGEST)
        tensors[f"{layer}.bias"] = Field(shape[:1], low=-_LARGEST, high=_LARGEST)
    return tensors


def interval(low: float, high: float, above: float = -math.inf) -> str:
    """Write a range in words.

    Args:
        low: least number.
        high: largest number.
        above: number that all are above; then `low` does not count.

    Returns:
        The words.
    """
    is_bounded = high < math.inf
    most = f" to {_bound(high)}" if is_bounded else ""
    if above > -math.inf:
        comma = ", up" if is_bounded else ""
        return f"numbers above {above:g}{comma}{most}"
    if low > -math.inf:
        return f"numbers from {_bound(low)}{most}"
    return f"numbers up{most}" if is_bounded else "numbers"


def _bound(number: float) -> str:
    """Write a bound of a range; thousands of whole numbers have commas."""
    return f"{number:,}" if isinstance(number, int) else f"{number:g}"


def is_number(value: object, *, whole: bool = False) -> bool:
    """Tell whether a JSON value is a finite number.

    Args:
        value: the value.
        whole: whether it must be a whole number, too.

    Returns:
        Whether it is.
    """
    kind = int if whole else int | float
    # To Python, `True` is a whole number; to JSON, it is none.
    if isinstance(value, bool) or not isinstance(value, kind):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer larger than any float
        return False


def is_plain(text: str) -> bool:
    """Tell whether text is safe to write anywhere: no control characters and no halves of surrogate pairs.

    Args:
        text: the text.

    Returns:
        Whether it is.
    """
    return not re.search("[\x00-\x1f\x7f-\x9f\ud800-\udfff]", text)


def excerpt(value: object) -> str:
    """Write a value as error messages print it: on one line and short.

    Args:
        value: any value.

    Returns:
        The text.
    """
    try:
        text = ascii(value)
    except (ValueError, RecursionError):  # integers too long to print, lists too deep
        text = type(value).__name__
    return text if len(text) <= 60 else text[:57] + "..."


def _agrees(size: _Size, number: int, sizes: _Sizes) -> bool:
    """Tell whether a number agrees with a size; a name that was unknown is known from then on."""
    if isinstance(size, int):
        return size == number
    for sign, factor in (("+", -1), ("-", 1)):
        name, separator, offset = size.partition(sign)
        if separator:
            wanted = number + factor * int(offset)
            return sizes.setdefault(name, wanted) == wanted
    return sizes.setdefault(size, number) == number
