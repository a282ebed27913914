"""Settings whose types state their ranges, and the checks of these ranges."""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_args, get_origin, get_type_hints

import yaml

from semfov.errors import check
from semfov.io.schema import excerpt, interval, is_number


@dataclass(frozen=True)
class Range:
    """Range of the values of a setting, in a type annotation: `Annotated[int, Range(1, 100)]`."""

    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf

    def __repr__(self) -> str:
        return interval(self.low, self.high, self.above).removeprefix("numbers ")

    def holds(self, value: object, *, whole: bool) -> bool:
        """Whether a value is a number in this range, and a whole one if `whole`."""
        return is_number(value, whole=whole) and self.low <= value <= self.high and value > self.above  # type: ignore[operator]


class _FileName:
    """Restriction of a text setting to valid file names, in a type annotation."""

    def __repr__(self) -> str:
        return "that is valid as a file name (letters, digits, space and _ . + -; at most 100 characters)"

    def holds(self, value: object, *, whole: bool) -> bool:
        return isinstance(value, str) and re.fullmatch(r"\w[\w .+-]{0,99}", value) is not None


SingleName = Annotated[str, _FileName()]  # name of a model to write
Seed = Annotated[int, Range(0, 2**63 - 1)]  # seed of a random generator
Count = Annotated[int, Range(1, 10**9)]  # a number of objects, at least one
Whole = Annotated[int, Range(0, 10**9)]  # a number of objects, possibly 0
Share = Annotated[float, Range(0, 1)]  # a share or a probability
Positive = Annotated[float, Range(above=0, high=10**9)]  # a number above 0
Weight = Annotated[float, Range(0, 10**9)]  # a number of 0 or more
Shifts = Annotated[int, Range(0, 10_000)]  # number of gaze shifts in an episode
Side = Annotated[int, Range(1, 200)]  # number of cells in a row or in a column
Workers = Annotated[int, Range(1, 1024)]  # number of processes


@dataclass(frozen=True)
class Settings:
    """Base of dataclasses of settings; it refuses values that are out of range.

    A class documents its own settings, and inherited ones only where they mean something else.
    """

    unused: ClassVar[tuple[str, ...]] = ()  # inherited settings that mean nothing here: no options, and not written

    def __post_init__(self) -> None:
        """Check all values (`check_settings`)."""
        check_settings(type(self), vars(self), nested=False)

    def plain(self) -> dict[str, Any]:
        """The settings as JSON values, in which paths are text and tuples are lists."""
        return plain({name: value for name, value in asdict(self).items() if name not in self.unused})

    def yaml(self) -> str:
        """The settings as a file that `--config` reads."""
        return yaml.safe_dump(self.plain(), sort_keys=False)


_DEEPEST = 100
"""Lists and objects within each other that a text of settings may have; loaders call themselves for each."""


def load_yaml(text: str) -> Any:
    """Read settings, without aliases, which a few lines multiply to any number of values, and not nested without end.

    Args:
        text: YAML.

    Returns:
        The value, as the parser of commands takes it.

    Raises:
        yaml.YAMLError: the text is no such YAML.
    """
    from jsonargparse import get_loader

    depth = 0
    for event in yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
        if isinstance(event, yaml.AliasEvent):
            line = "" if event.start_mark is None else f"line {event.start_mark.line + 1}: "
            raise yaml.YAMLError(f"{line}expected values, got the alias *{event.anchor}")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            raise yaml.YAMLError(f"expected lists and objects at most {_DEEPEST} deep, got deeper ones")
    return get_loader("yaml")(text)


def plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Convert settings to JSON values: paths become text, tuples become lists."""
    return json.loads(json.dumps(settings, default=str))


_type_hints = cache(get_type_hints)
_WORDS = {int: "a whole number", float: "a number", str: "a name"}


def check_settings(config: type[Any], values: Any, prefix: str = "", *, nested: bool = True) -> None:
    """Raise `InputError`, with the dotted name and the range, if a setting is out of the range of its type."""
    hints = _type_hints(config, include_extras=True)  # type: ignore[arg-type]
    for field in fields(config):
        if field.name not in values:
            continue
        value, hint = values[field.name], hints[field.name]
        if is_dataclass(hint):
            if nested and not is_dataclass(value) and value is not None:
                check_settings(hint, value, f"{prefix}{field.name}.")  # type: ignore[arg-type]
        else:
            _check(hint, value, prefix + field.name)


def _check(hint: Any, value: Any, name: str) -> None:
    origin, options = get_origin(hint), get_args(hint)
    if value is None or isinstance(value, Mapping):
        return
    if isinstance(value, str | Path):
        check("\0" not in str(value), name, "text without NUL", excerpt(str(value)))
    if origin is Annotated:
        base, *more = options
        for allowed in more:
            if isinstance(allowed, Range | _FileName):
                what = f"{_WORDS[base]} {allowed}"
                check(allowed.holds(value, whole=base is int), name, what, excerpt(value))
    elif origin is tuple and isinstance(value, list | tuple):
        for place, item in enumerate(value):
            _check(options[0 if options[-1] is Ellipsis else place], item, f"{name}[{place}]")
    else:
        # Where a setting is a number or a word, its words are checked where the setting is used.
        for option in options:
            if is_dataclass(option) and not is_dataclass(value) and hasattr(value, "__dict__"):
                check_settings(option, vars(value), f"{name}.")  # type: ignore[arg-type]
            elif get_origin(option) is Annotated and isinstance(value, str) == (get_args(option)[0] is str):
                _check(option, value, name)
