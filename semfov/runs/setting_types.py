"""Types of settings as a command line sees them: how a value is written, and what one is expected to be."""

import re
from collections import deque
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from semfov.io.ranges import NOUNS, CheckedSettings, Form

_FLAGS = ("true", "false", "yes", "no", "True", "False")
"""Words that may follow a flag as its value."""


class SettingType:
    """Type of a setting, of which a command line asks how its value is written.

    Attributes:
        hint: the type as it is written, without None where another one is left.
        base: the type without its annotations.
        annotations: its annotations, ranges and forms.
        is_flag: whether it is true or false, and needs no value.
        is_list: whether it is a list of words, paths or numbers of any length, as `tuple[str, ...]`.
        may_be_tuple: whether it is one value or a tuple of several, as a cell by its number or its column and row.
    """

    def __init__(self, hint: object) -> None:
        self.hint = _without_none(hint)
        self.base, self.annotations = _taken_apart(self.hint)
        self.is_flag = self.hint is bool
        self.is_list = _is_list(self.hint)
        self.may_be_tuple = _is_union(self.base) and any(get_origin(item) is tuple for item in get_args(self.base))

    def value_after(self, words: deque[str]) -> str | None:
        """Take the value of an option from the words after it; None leaves it to the parser.

        Args:
            words: the words after the option, without those that are taken.
        """
        if self.is_flag:
            return words.popleft() if words and words[0] in _FLAGS else "true"
        if not words or words[0].startswith("--"):
            return None
        further_words = self._further_words()
        if further_words:
            value = [words.popleft()]
            while words and re.fullmatch(further_words, words[0]):
                value.append(words.popleft())
            return " ".join(value)
        return words.popleft() if self.is_list or self.may_be_tuple else None

    def _further_words(self) -> str:
        """Return the pattern of further words that belong to a value; empty for none."""
        return "".join(annotation.more for annotation in self.annotations if isinstance(annotation, Form))

    def in_brackets(self, value: str) -> str:
        """Put several words or numbers in brackets, which users leave out and the parser needs."""
        if value.startswith("["):
            return value
        if self.is_list:
            return "[]" if value in ("none", "") else f"[{value}]"
        is_tuple = self.may_be_tuple and "," in value
        return f"[{value}]" if is_tuple else value

    def words(self) -> list[str]:
        """List the words that a value, or an item of a list, may be."""
        base = get_args(self.hint)[0] if self.is_list else self.hint
        return [str(word) for word in get_args(base)] if get_origin(base) is Literal else []

    def expected(self) -> str | None:
        """Say what a value must be; None for types that need more words."""
        words = [repr(word) for word in self.words()]
        if words:
            return f"some of {', '.join(words)}" if self.is_list else " or ".join(words)
        if self.annotations:
            nouns = [annotation.noun for annotation in self.annotations if annotation.noun is not None]
            noun = nouns[0] if nouns else NOUNS[self.base]
            return " ".join([noun, *map(repr, self.annotations)])
        return _PLAIN_TYPES.get(self.hint)


_PLAIN_TYPES: dict[object, str] = {bool: "true or false", int: NOUNS[int], float: NOUNS[float]}
"""What a value must be, by types that say all of it."""


def setting_types(config: type[CheckedSettings]) -> dict[str, SettingType]:
    """Find the types of settings.

    Args:
        config: dataclass of the settings.

    Returns:
        The types by dotted names, those of settings within settings after the one that holds them.
    """
    return dict(_named_types(config, ""))


def _named_types(config: type[CheckedSettings], prefix: str) -> Iterator[tuple[str, SettingType]]:
    """Yield the dotted name and the type of each setting."""
    hints = get_type_hints(config, include_extras=True)
    for setting in fields(config):
        name = prefix + setting.name
        setting_type = SettingType(hints[setting.name])
        yield name, setting_type
        if isinstance(setting_type.hint, type) and issubclass(setting_type.hint, CheckedSettings):
            yield from _named_types(setting_type.hint, f"{name}.")


def _is_union(hint: object) -> bool:
    """Tell whether a type is one of several, as `int | str`."""
    return get_origin(hint) in (Union, UnionType)


def _without_none(hint: object) -> object:
    """Find the type of a setting that may also be None; others stay as they are."""
    if not _is_union(hint):
        return hint
    alternatives = [alternative for alternative in get_args(hint) if alternative is not type(None)]
    return alternatives[0] if len(alternatives) == 1 else hint


def _taken_apart(hint: object) -> tuple[Any, tuple[Any, ...]]:
    """Separate a type from its annotations."""
    if get_origin(hint) is not Annotated:
        return hint, ()
    base, *annotations = get_args(hint)
    return base, tuple(annotations)


def _is_list(hint: object) -> bool:
    """Tell whether a type is a list of words, paths or numbers of any length."""
    arguments = get_args(hint)
    if get_origin(hint) is not tuple or arguments[1:] != (Ellipsis,):
        return False
    item, _ = _taken_apart(arguments[0])
    return item in (str, Path, float) or get_origin(item) is Literal
