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
    """Type of a setting whose value is one word, which the parser takes as it stands.

    Args:
        hint: the type as it is written.
    """

    def __init__(self, hint: Any) -> None:
        self.hint = hint

    def value_after(self, words: deque[str]) -> str | None:
        """Take the value of an option from the words after it; None leaves it to the parser.

        Args:
            words: the words after the option, from which those of the value are taken.
        """
        return None

    def in_brackets(self, value: str) -> str:
        """Write a value as the parser needs it: several words or numbers have brackets, which users leave out."""
        return value

    def words(self) -> list[str]:
        """List the words that a value, or an item of a list, may be; empty where it may be any."""
        return []

    def expected(self) -> str | None:
        """Describe what a value must be; None for types that need more words."""
        return "the name of a file or folder" if self.hint is Path else NOUNS.get(self.hint)


class FlagType(SettingType):
    """Type of a setting that is true or false; the option alone makes it true."""

    def value_after(self, words: deque[str]) -> str | None:
        return words.popleft() if words and words[0] in _FLAGS else "true"

    def expected(self) -> str | None:
        return "true or false"


class ChoiceType(SettingType):
    """Type of a setting that is one of some words: `Literal["rgb", "bgr"]`."""

    def words(self) -> list[str]:
        return [str(word) for word in get_args(self.hint)]

    def expected(self) -> str | None:
        return " or ".join(map(repr, self.words()))


class ListType(SettingType):
    """Type of a list of words, paths or numbers of any length: `tuple[str, ...]`."""

    def value_after(self, words: deque[str]) -> str | None:
        return next_value(words)

    def in_brackets(self, value: str) -> str:
        if value.startswith("["):
            return value
        return "[]" if value in ("none", "") else f"[{value}]"

    def words(self) -> list[str]:
        item, _ = get_args(self.hint)
        return setting_type(item).words()

    def expected(self) -> str | None:
        words = ", ".join(map(repr, self.words()))
        return f"some of {words}" if words else "a list, such as [a, b]"


class OneOrTupleType(SettingType):
    """Type of one value or a tuple of several, as a cell by its number or its column and row."""

    def value_after(self, words: deque[str]) -> str | None:
        return next_value(words)

    def in_brackets(self, value: str) -> str:
        has_several = "," in value and not value.startswith("[")
        return f"[{value}]" if has_several else value


class AnnotatedType(SettingType):
    """Type with annotations, which say its range or how it is written: `Annotated[int, Range(1, 100)]`."""

    def __init__(self, hint: object) -> None:
        super().__init__(hint)
        base, *annotations = get_args(hint)
        self.base = setting_type(base)
        self.annotations = annotations

    def value_after(self, words: deque[str]) -> str | None:
        """Take the value, with the further words that its form says belong to it."""
        pattern = "".join(annotation.more for annotation in self.annotations if isinstance(annotation, Form))
        if not pattern:
            return self.base.value_after(words)
        value = next_value(words)
        while value is not None and words and re.fullmatch(pattern, words[0]):
            value = f"{value} {words.popleft()}"
        return value

    def in_brackets(self, value: str) -> str:
        return self.base.in_brackets(value)

    def expected(self) -> str | None:
        nouns = [annotation.noun for annotation in self.annotations if annotation.noun is not None]
        noun = nouns[0] if nouns else NOUNS[self.base.hint]
        return " ".join([noun, *map(repr, self.annotations)])


def next_value(words: deque[str]) -> str | None:
    """Take the next word, unless it is an option or there is none."""
    return words.popleft() if words and not words[0].startswith("--") else None


def setting_type(hint: object) -> SettingType:
    """Find the kind of a type.

    Args:
        hint: the type as it is written; None beside another one does not count.

    Returns:
        The type.
    """
    hint = _without_none(hint)
    if hint is bool:
        return FlagType(hint)
    if get_origin(hint) is Annotated:
        return AnnotatedType(hint)
    if get_origin(hint) is Literal:
        return ChoiceType(hint)
    if _is_list(hint):
        return ListType(hint)
    if any(get_origin(alternative) is tuple for alternative in _alternatives(hint)):
        return OneOrTupleType(hint)
    return SettingType(hint)


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
        hint = _without_none(hints[setting.name])
        yield name, setting_type(hint)
        if isinstance(hint, type) and issubclass(hint, CheckedSettings):
            yield from _named_types(hint, f"{name}.")


def _alternatives(hint: object) -> tuple[Any, ...]:
    """List the types of which a type is one, as `int | str`; empty where it is no such type."""
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else ()


def _without_none(hint: object) -> object:
    """Find the type of a setting that may also be None; others stay as they are."""
    alternatives = [alternative for alternative in _alternatives(hint) if alternative is not type(None)]
    return alternatives[0] if len(alternatives) == 1 else hint


def _is_list(hint: object) -> bool:
    """Tell whether a type is a list of words, paths or numbers of any length; other lists are left to the parser."""
    if get_origin(hint) is not tuple or get_args(hint)[1:] != (Ellipsis,):
        return False
    item = setting_type(get_args(hint)[0])
    base = item.base if isinstance(item, AnnotatedType) else item
    return isinstance(base, ChoiceType) or base.hint in (str, Path, float)
