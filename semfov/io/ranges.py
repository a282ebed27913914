"""Types of settings that state their ranges, and the check of values by these types."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from itertools import repeat
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args, get_origin, get_type_hints

from semfov.errors import check, check_options
from semfov.io.schema import excerpt, interval


@dataclass(frozen=True)
class Range:
    """A range of numbers, in a type annotation: `Annotated[int, Range(1, 100)]`.

    Args:
        low: least value of the range.
        high: largest value of the range.
        above: number that values are larger than.
        below: number that values are smaller than.
        noun: what the numbers are, in messages (None: `a number`, or `a whole number`).
        word: a word that may stand in place of a number.
    """

    low: float = -math.inf
    high: float = math.inf
    above: float | None = None
    below: float | None = None
    noun: str | None = None
    word: str | None = None

    def __repr__(self) -> str:
        """Write the range in words, such as `from 1 to 100`."""
        word = "" if self.word is None else f", or {self.word!r}"
        if self.above is not None and self.below is not None:
            return f"above {self.above:g} and below {self.below:g}{word}"
        above = -math.inf if self.above is None else self.above
        return interval(self.low, self.high, above).removeprefix("numbers ") + word

    def holds(self, value: object, *, whole: bool) -> bool:
        """Tell whether a value is a number in this range, or the word.

        Args:
            value: any value; numbers of NumPy are numbers, `True` and tensors are none.
            whole: whether only a whole number is one.

        Returns:
            Whether it lies in the range, which NaN never does.
        """
        if isinstance(value, str) and value == self.word:
            return True
        number = _as_number(value, whole=whole)
        is_above = self.above is None or number > self.above
        is_below = self.below is None or number < self.below
        return is_above and is_below and self.low <= number <= self.high


def _as_number(value: object, *, whole: bool) -> float:
    """Convert a value to a number of Python; NaN, which no range holds, for a value that is none."""
    kind = Integral if whole else Real
    if isinstance(value, bool) or not isinstance(value, kind):
        return math.nan
    try:
        # A whole number stays one: 10**400 is out of any range, and no float.
        return int(value) if isinstance(value, Integral) else float(value)
    except (OverflowError, ValueError):
        return math.nan


@dataclass(frozen=True)
class Form:
    """Annotation of a type that says how its value is written on a command line.

    Args:
        noun: what the value is, such as `a cell`.
        words: how it is written.
        more: pattern of further words of the command line that belong to the value; empty for none.
    """

    noun: str
    words: str
    more: str = ""

    def __repr__(self) -> str:
        return self.words


class _FileName:
    """Restriction of a text setting to valid file names, in a type annotation."""

    noun = None

    def __repr__(self) -> str:
        return "that is valid as a file name (letters, digits, space and _ . + -; at most 100 characters)"

    def holds(self, value: object, *, whole: bool) -> bool:
        return isinstance(value, str) and re.fullmatch(r"\w[\w .+-]{0,99}", value) is not None


SingleName = Annotated[str, _FileName()]  # name of a model to write
Seed = Annotated[int, Range(0, 2**63 - 1)]  # seed of a random generator
Count = Annotated[int, Range(1, 10**9)]  # a number of objects, at least one
Whole = Annotated[int, Range(0, 10**9)]  # a number of objects, possibly 0
Share = Annotated[float, Range(0, 1)]  # a share or a score
Probability = Annotated[float, Range(0, 1, noun="a probability")]
Positive = Annotated[float, Range(above=0, high=10**9)]  # a number above 0
Weight = Annotated[float, Range(0, 10**9)]  # a number of 0 or more
Seconds = Annotated[float, Range(0)]  # a time limit, possibly infinite
Shifts = Annotated[int, Range(0, 10_000)]  # number of gaze shifts in an episode
Side = Annotated[int, Range(1, 200)]  # number of cells in a row or in a column
Workers = Annotated[int, Range(1, 1024)]  # number of processes

NOUNS = {int: "a whole number", float: "a number", str: "a name"}
"""What values of a type are, in messages."""

_type_hints = cache(get_type_hints)


def check_settings(config: type[Any], values: Any, prefix: str = "", *, nested: bool = True) -> None:
    """Raise `InputError`, with the dotted name and the range, if a setting is out of the range of its type.

    Args:
        config: dataclass of the settings.
        values: the values by name, a mapping or what behaves as one; names that are missing are not checked.
        prefix: start of the dotted names in the message.
        nested: whether settings within settings are checked, too.
    """
    hints = _type_hints(config, include_extras=True)  # type: ignore[arg-type]
    for field in fields(config):
        if field.name not in values:
            continue
        value = values[field.name]
        hint = hints[field.name]
        # Settings within settings have checked themselves, unless a parser has not made them yet.
        if not is_dataclass(hint):
            _check_value(hint, value, prefix + field.name)
        elif nested and not is_dataclass(value) and value is not None:
            check_settings(hint, value, f"{prefix}{field.name}.")  # type: ignore[arg-type]


def _check_value(hint: object, value: object, name: str) -> None:
    """Raise `InputError` if a value is out of the range of its type, which may be of several kinds."""
    if value is None or isinstance(value, Mapping):
        return
    if isinstance(value, str | Path):
        check("\0" not in str(value), name, "text without NUL", excerpt(str(value)))
    kind = get_origin(hint)
    if kind is Annotated:
        _check_ranges(hint, value, name)
    elif kind is tuple and isinstance(value, list | tuple):
        _check_items(get_args(hint), value, name)
    else:
        _check_alternatives(get_args(hint), value, name)


def _check_items(hints: Sequence[object], items: Sequence[object], name: str) -> None:
    """Raise `InputError` if an item of a list is out of the range of its type."""
    is_open_ended = hints[-1] is Ellipsis  # `tuple[int, ...]`
    hints_of_items = repeat(hints[0]) if is_open_ended else hints
    for place, (hint, item) in enumerate(zip(hints_of_items, items, strict=False)):
        _check_value(hint, item, f"{name}[{place}]")


def _check_ranges(hint: object, value: object, name: str) -> None:
    """Raise `InputError` if a value is out of a range that its type is annotated with."""
    base, *annotations = get_args(hint)
    for annotation in annotations:
        if isinstance(annotation, Range | _FileName):
            expected = f"{annotation.noun or NOUNS[base]} {annotation}"
            check(annotation.holds(value, whole=base is int), name, expected, excerpt(value))


def _check_alternatives(alternatives: Iterable[object], value: object, name: str) -> None:
    """Raise `InputError` if a value is out of the range of the alternative that it is meant to be."""
    # Where a setting is a number or a word, its words are checked where the setting is used.
    is_word = isinstance(value, str) and any(map(_takes_text, alternatives))
    is_namespace = hasattr(value, "__dict__") and not is_dataclass(value)  # settings that a parser has not made yet
    for alternative in alternatives:
        if is_dataclass(alternative) and is_namespace:
            check_settings(alternative, vars(value), f"{name}.")  # type: ignore[arg-type]
        elif get_origin(alternative) is Annotated and _takes_text(alternative) == is_word:
            _check_ranges(alternative, value, name)


def _takes_text(hint: object) -> bool:
    """Tell whether text can be a value of a type."""
    if get_origin(hint) is Annotated:
        return get_args(hint)[0] is str
    return hint is str or hint is Path or get_origin(hint) is Literal


@dataclass(frozen=True)
class CheckedSettings:
    """Base of dataclasses of settings; it refuses values that are out of the ranges of their types.

    A class documents its own settings, and inherited ones only where they mean something else.
    """

    def __new__(cls, *_: object, **values: object) -> Self:
        """Refuse unknown settings, with those that may be meant."""
        check_options(values, (setting.name for setting in fields(cls)), cls.__name__)
        return super().__new__(cls)

    def __post_init__(self) -> None:
        """Check all values (`check_settings`)."""
        check_settings(type(self), vars(self), nested=False)
