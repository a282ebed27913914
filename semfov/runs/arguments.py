"""Words of a command line: what people type, what the parser expects, and errors in one line."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

_FLAGS = ("true", "false", "yes", "no", "True", "False")
_WORDS = {int: "a whole number", float: "a number", bool: "true or false"}


def usual_form(arguments: Sequence[str], config: type[Any], options: Iterable[str]) -> list[str]:
    """Bring arguments into the form that the parser understands.

    Names of options may have dashes instead of underscores. A flag needs no value. A list of words needs no brackets,
    and `none` is the empty list.

    >>> from semfov.runs.settings import Settings
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Example(Settings):
    ...     give_up: float = 0.1
    ...     looks: bool = False
    ...     draw: tuple[str, ...] = ()
    >>> usual_form(["--give-up", "0.2", "--looks", "--draw", "path,views"], Example, ["--give_up", "--looks", "--draw"])
    ['--give_up', '0.2', '--looks=true', '--draw=[path,views]']
    """
    hints, option_names, usual = setting_types(config), set(options), list[str]()
    rest = list(arguments)
    while rest:
        word = rest.pop(0)
        name, equals, value = word.partition("=")
        option = "--" + name[2:].replace("-", "_")
        if word == "--":
            return [*usual, word, *rest]
        if not word.startswith("--") or option not in option_names:
            usual.append(word)
            continue
        hint, has_value = hints.get(option[2:]), bool(equals)
        if hint is bool and not has_value:
            value = rest.pop(0) if rest and rest[0] in _FLAGS else "true"
            has_value = True
        elif _is_list(hint) and not has_value and rest and not rest[0].startswith("--"):
            value, has_value = rest.pop(0), True
        if has_value and _is_list(hint) and not value.startswith("["):
            value = f"[{'' if value in ('none', '') else value}]"
        usual.append(f"{option}={value}" if has_value else option)
    return usual


def in_one_line(message: str, config: type[Any], options: Iterable[str]) -> str:
    """Say in one line what is wrong with the arguments, and suggest names."""
    unknown = re.match(r"unrecognized arguments: (.*)", message, re.DOTALL)
    if unknown:
        words = unknown[1].split()
        option = next((word.partition("=")[0] for word in words if word.startswith("-")), None)
        if option is None:
            return f"unexpected argument {unknown[1]!r}; put a name with spaces in quotes"
        plain = {each.replace("_", "-"): each for each in options}
        near = get_close_matches(option.replace("_", "-"), plain, n=1, cutoff=0.6)
        remedy = f"did you mean {near[0]}?" if near else "--help-all lists all options"
        return f"unknown option {option}; {remedy}"
    missing = re.match(r"argument (--\S+): expected one argument", message)
    if missing:
        return f"{missing[1].replace('_', '-')}: expected a value, got none"
    key, got = re.search(r'Parser key "([\w.]+)"', message), re.search(r"(?:Given|Got) value: (.*)", message)
    hint = setting_types(config).get(key[1]) if key else None
    expected = None if hint is None else _expected(hint)
    if key is None or got is None or expected is None:
        return " ".join(message.split())
    value = got[1].strip()
    close = get_close_matches(value, _options_of(hint), n=1, cutoff=0.5)
    return f"{key[1]}: expected {expected}, got {value!r}" + (f"; did you mean {close[0]!r}?" if close else "")


def setting_types(config: type[Any]) -> dict[str, Any]:
    """Types of settings, without None, by their dotted names."""
    types: dict[str, Any] = {}
    hints = get_type_hints(config, include_extras=True)
    for field in fields(config):
        hint = _without_none(hints[field.name])
        types[field.name] = hint
        if is_dataclass(hint) and isinstance(hint, type):
            types |= {f"{field.name}.{name}": each for name, each in setting_types(hint).items()}
    return types


def _without_none(hint: Any) -> Any:
    if get_origin(hint) in (Union, UnionType):
        hints = [each for each in get_args(hint) if each is not type(None)]
        return hints[0] if len(hints) == 1 else hint
    return hint


def _is_list(hint: Any) -> bool:
    """Whether a type is a list of words of any length."""
    item, *more = get_args(hint) or (None,)
    return get_origin(hint) is tuple and more == [Ellipsis] and (item is str or get_origin(item) is Literal)


def _options_of(hint: Any) -> list[str]:
    """The words that a setting may be."""
    if get_origin(hint) is Literal:
        return [str(each) for each in get_args(hint)]
    return [word for each in get_args(hint) for word in _options_of(each)] if _is_list(hint) else []


def _expected(hint: Any) -> str | None:
    """What a setting must be, in words; None for types that need more of them."""
    words = _options_of(hint)
    if words:
        named = " or ".join(repr(word) for word in words)
        return f"some of {named.replace(' or ', ', ')}" if _is_list(hint) else named
    if get_origin(hint) is Annotated:
        base, *ranges = get_args(hint)
        return " ".join([_WORDS.get(base, "a name"), *map(repr, ranges)])
    return _WORDS.get(hint)
