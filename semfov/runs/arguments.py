"""Arguments of a command line as users write them: brought into the parser's form, or refused in one line."""

import re
import sys
from collections import deque
from collections.abc import Container, Iterable, Sequence
from dataclasses import fields
from difflib import get_close_matches
from keyword import iskeyword
from pathlib import Path
from types import UnionType
from typing import Annotated, Literal, Union, get_args, get_origin, get_type_hints

import yaml

from semfov.errors import check
from semfov.io.ranges import NOUNS, CheckedSettings, Form
from semfov.runs.settings import Settings, load_yaml
from semfov.words import FORMER, dashed, note_of_dropped, note_of_former

_FLAGS = ("true", "false", "yes", "no", "True", "False")
"""Words that may follow a flag as its value."""


def usual_form(arguments: Sequence[str], config: type[Settings], options: Container[str]) -> list[str]:
    """Bring arguments into the form that the parser understands.

    Names of options may have dashes, a flag needs no value, several words or numbers no brackets, and `none` is the
    empty list.

    Args:
        arguments: the words of the command line.
        config: dataclass of the settings.
        options: the options of the parser, with underscores, such as `--stop_below`.

    Returns:
        The words for the parser. Those that it does not know stay as they are; an option of earlier versions is left
        out, with a note in standard error.

    Raises:
        InputError: an option that takes one value is given twice, or one that takes a file is given no name.
    """
    hints = setting_types(config)
    usual: list[str] = []
    words = deque(arguments)
    while words:
        word = words.popleft()
        if word == "--":
            return [*usual, word, *words]
        # Everything else is left to the parser, with its messages.
        name, has_value, text = word.partition("=")
        option = f"--{_in_python(name[2:])}"
        if word.startswith("--") and option[2:] in config.dropped:
            print(f"note: {note_of_dropped(name)}", file=sys.stderr)
            if not has_value and words and not words[0].startswith("--"):
                words.popleft()
            continue
        if not word.startswith("--") or option not in options:
            usual.append(word)
            continue
        setting = option.removeprefix("--")
        hint = hints.get(setting)
        _check_given_once(option, hint, usual)
        value = text if has_value else _value_after(hint, words)
        if hint is Path:
            # As `--out "$FOLDER"` is where the variable is not set; it would be the present folder.
            following = words[0] if value is None and words else value
            check(following != "", setting.rstrip("_"), "the name of a file or folder", "an empty one")
        if value is not None:
            option = f"{option}={_in_brackets(hint, value)}"
        usual.append(option)
    return usual


def _in_python(name: str) -> str:
    """Write the name of an option with underscores, and as its setting is called where Python has the word itself."""
    setting = name.replace("-", "_")
    return f"{setting}_" if iskeyword(setting) else setting  # --try is `try_`


def in_present_names(text: str, config: type[Settings]) -> str:
    """Give the settings of a file the names that they have in Python.

    Args:
        text: YAML, with names of options, present or earlier ones; an earlier one is noted in standard error, and left
            out where nothing took its place.
        config: dataclass of the settings.

    Returns:
        YAML with names of settings. Names that are not known stay as they are, and what is no YAML.

    Raises:
        InputError: the file has a setting twice.
    """
    try:
        values = load_yaml(text)
    except (yaml.YAMLError, ValueError):  # ValueError: a date that there is not
        return text
    if not isinstance(values, dict):
        return text
    known = setting_types(config)
    renamed: dict[str, object] = {}
    for name, value in ((str(key), value) for key, value in values.items()):
        setting = _in_python(name)
        if setting in config.dropped:
            print(f"note: {note_of_dropped(name)}", file=sys.stderr)
            continue
        present = FORMER.get(setting, setting)
        if present in known and setting not in known:
            print(f"note: {note_of_former(name, present)}", file=sys.stderr)
            setting = present
        key = setting if setting in known else name
        check(key not in renamed, key.rstrip("_"), "once", f"it again as {name!r}")
        renamed[key] = value
    return text if renamed.keys() == values.keys() else yaml.safe_dump(renamed, sort_keys=False)


def _check_given_once(option: str, hint: object, before: Iterable[str]) -> None:
    """Raise `InputError` for an option that is given again; flags and `--config` may be."""
    if hint is bool or option == "--config":
        return
    given_before = any(word.partition("=")[0] == option for word in before)
    remedy = "; where it takes several, as a,b" if hint is str or _is_list(hint) else ""
    check(not given_before, option.removeprefix("--").rstrip("_"), "once", f"it again{remedy}")


def _value_after(hint: object, words: deque[str]) -> str | None:
    """Take the value of an option from the words after it; None leaves it to the parser."""
    if hint is bool:
        return words.popleft() if words and words[0] in _FLAGS else "true"
    form = _form_of(hint)
    if form is not None and form.more and words and not words[0].startswith("--"):
        value = [words.popleft()]
        while words and re.fullmatch(form.more, words[0]):
            value.append(words.popleft())
        return " ".join(value)
    takes_several = _is_list(hint) or _may_be_tuple(hint)
    if takes_several and words and not words[0].startswith("--"):
        return words.popleft()
    return None


def _form_of(hint: object) -> Form | None:
    """Return how a value of a type is written; None where nothing says it."""
    annotations = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
    return next((each for each in annotations if isinstance(each, Form)), None)


def _in_brackets(hint: object, value: str) -> str:
    """Put several words or numbers in brackets, which users leave out."""
    if value.startswith("["):
        return value
    if _is_list(hint):
        return "[]" if value in ("none", "") else f"[{value}]"
    return f"[{value}]" if _may_be_tuple(hint) and "," in value else value


def mistake(message: str, config: type[CheckedSettings], options: Iterable[str], help_option: str) -> str:
    """Say in one line what is wrong with the arguments, with the names that may be meant.

    Args:
        message: the message of the parser.
        config: dataclass of the settings.
        options: the options of the parser.
        help_option: the option that lists them all.

    Returns:
        The line.
    """
    unknown = re.match(r"unrecognized arguments: (.*)", message, re.DOTALL)
    if unknown:
        return _unknown_argument(unknown[1], options, help_option)
    missing = re.match(r"argument (--\S+): expected one argument", message)
    if missing:
        return f"--{dashed(missing[1][2:])}: expected a value, got none"
    setting = re.search(r'Parser key "([\w.]+)"', message)
    got = re.search(r"(?:Given|Got) value: (.*)", message)
    hint = setting_types(config).get(setting[1]) if setting else None
    expected = _expected(hint)
    if setting is None or got is None or expected is None:
        return " ".join(message.split())
    value = got[1].strip()
    # All words are listed anyway, and far ones only look like what was meant: `best` for `fast`.
    matches = get_close_matches(value, _words_of(hint), n=1, cutoff=0.7)
    suggestion = f"; did you mean {matches[0]!r}?" if matches else ""
    return f"{setting[1].rstrip('_')}: expected {expected}, got {value!r}{suggestion}"


def _unknown_argument(text: str, options: Iterable[str], help_option: str) -> str:
    """Say what is wrong with arguments that the parser does not know."""
    option = next((word.partition("=")[0] for word in text.split() if word.startswith("-")), None)
    if option is None:
        return f"unexpected argument {text!r}; put a name with spaces in quotes, and commas in a list"
    names = [dashed(name[2:]) for name in options]
    matches = get_close_matches(dashed(option.lstrip("-")), names, n=1, cutoff=0.7)
    remedy = f"did you mean --{matches[0]}?" if matches else f"{help_option} lists all options"
    return f"unknown option {option}; {remedy}"


def setting_types(config: type[CheckedSettings]) -> dict[str, object]:
    """Find the types of settings.

    Args:
        config: dataclass of the settings.

    Returns:
        The types by dotted names, without None where another one is left.
    """
    types: dict[str, object] = {}
    hints = get_type_hints(config, include_extras=True)
    for setting in fields(config):
        hint = _without_none(hints[setting.name])
        types[setting.name] = hint
        if isinstance(hint, type) and issubclass(hint, CheckedSettings):
            for name, inner_hint in setting_types(hint).items():
                types[f"{setting.name}.{name}"] = inner_hint
    return types


def _without_none(hint: object) -> object:
    """Find the type of a setting that may also be None; others stay as they are."""
    if get_origin(hint) not in (Union, UnionType):
        return hint
    alternatives = [alternative for alternative in get_args(hint) if alternative is not type(None)]
    return alternatives[0] if len(alternatives) == 1 else hint


def _is_list(hint: object) -> bool:
    """Tell whether a type is a list of words, paths or numbers of any length."""
    item, *more = get_args(hint) or (None,)
    item = get_args(item)[0] if get_origin(item) is Annotated else item
    is_plain = item in (str, Path, float) or get_origin(item) is Literal
    return get_origin(hint) is tuple and more == [Ellipsis] and is_plain


def _may_be_tuple(hint: object) -> bool:
    """Tell whether a type is one value or a tuple of several, as a cell by its number or its column and row."""
    base = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    return get_origin(base) in (Union, UnionType) and any(get_origin(option) is tuple for option in get_args(base))


def _words_of(hint: object) -> list[str]:
    """List the words that a setting may be."""
    if get_origin(hint) is Literal:
        return [str(word) for word in get_args(hint)]
    return _words_of(get_args(hint)[0]) if _is_list(hint) else []


def _expected(hint: object) -> str | None:
    """Say what a setting must be; None for types that need more words."""
    words = [repr(word) for word in _words_of(hint)]
    if words:
        return f"some of {', '.join(words)}" if _is_list(hint) else " or ".join(words)
    if get_origin(hint) is Annotated:
        base, *annotations = get_args(hint)
        nouns = [annotation.noun for annotation in annotations if annotation.noun is not None]
        noun = nouns[0] if nouns else NOUNS[base]
        return " ".join([noun, *map(repr, annotations)])
    if hint is bool:
        return "true or false"
    if hint is int or hint is float:
        return NOUNS[hint]
    return None
