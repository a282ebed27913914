"""Arguments of a command line as users write them: brought into the parser's form, or refused in one line."""

import os
import re
import sys
from collections import deque
from collections.abc import Container, Iterable, Mapping, Sequence
from difflib import get_close_matches
from keyword import iskeyword
from pathlib import Path

import yaml

from semfov.errors import InputError, check
from semfov.io.ranges import CheckedSettings
from semfov.runs.setting_types import FlagType, ListType, SettingType, next_value, setting_types
from semfov.runs.settings import Settings, load_yaml
from semfov.words import FORMER, FROM_YOLO, dashed, note_of_former


def usual_form(arguments: Sequence[str], config: type[Settings], options: Container[str]) -> list[str]:
    """Bring arguments into the form that the parser understands.

    Names of options may have dashes, a flag needs no value, several words or numbers no brackets, and `none` is the
    empty list. Words that belong to no option may stand before, between and after the options. Files of settings come
    first, and then those of groups of settings: what is typed wins, wherever it stands.

    Args:
        arguments: the words of the command line.
        config: dataclass of the settings.
        options: the options of the parser, with underscores, such as `--stop_below`.

    Returns:
        The words for the parser. Those that belong to no option stand together, where the first of them was.

    Raises:
        InputError: an option that takes one value is given twice, or one that takes a file is given no name.
    """
    types = setting_types(config)
    usual: list[str] = []
    files: list[str] = []
    groups: list[str] = []
    free: list[str] = []  # of which the parser takes only those that stand together
    place = 0  # of the first of these among the others
    words = deque(arguments)
    while words:
        word = words.popleft()
        if word == "--":  # what follows it are no options
            return [*files, *groups, *usual, word, *free, *words]
        option = _option_of(word)
        if option in options:
            kind = types.get(option[2:], _NO_SETTING)
            _check_once(option, kind, [*groups, *usual])
            parts = [name.removeprefix(f"{option[2:]}.") for name in types if name.startswith(f"{option[2:]}.")]
            _check_group(word, parts, words)
            option_words = _with_value(word, kind, words)
            has_value = option_words != [option]
            if has_value and option == "--config":
                files += option_words
            elif has_value and parts:
                groups += option_words
            else:
                usual += option_words
        elif word.startswith("-") and word != "-":
            # An item of a dictionary, as `--sensor.settings.fovea`, is no option of its own, but has a value.
            is_item = option.rpartition(".")[0] in options and "=" not in word
            value = next_value(words) if is_item else None
            usual += [word] if value is None else [word, value]  # left to the parser, with its messages
        else:
            place = place if free else len(usual)
            free.append(word)
    return [*files, *groups, *usual[:place], *free, *usual[place:]]


_NO_SETTING = SettingType(None)
"""Type of an option that stands for no setting, as `--help` and `--config`."""


def _option_of(word: str) -> str:
    """Find the option that a word names, as the parser writes it; empty for a word that is no option."""
    name = word.partition("=")[0]
    return f"--{_in_python(name[2:])}" if name.startswith("--") else ""


def _in_python(name: str) -> str:
    """Write the name of an option with underscores, and as its setting is called where Python has the word itself."""
    setting = name.replace("-", "_")
    return f"{setting}_" if iskeyword(setting) else setting  # --try is `try_`


def _in_messages(option: str) -> str:
    """Write an option as messages name its setting."""
    return option.removeprefix("--").rstrip("_")


def _check_once(option: str, kind: SettingType, before: Iterable[str]) -> None:
    """Raise `InputError` for an option that is given again; flags and `--config` may be."""
    if isinstance(kind, FlagType) or option == "--config":
        return
    is_repeated = any(word.partition("=")[0] == option for word in before)
    # Text may be a list in one word, as the classes of `--target a,b`.
    takes_several = isinstance(kind, ListType) or kind.hint is str
    remedy = "; where it takes several, as a,b" if takes_several else ""
    check(not is_repeated, _in_messages(option), "once", f"it again{remedy}")


def _with_value(word: str, kind: SettingType, words: deque[str]) -> list[str]:
    """Write an option and its value as one word; a value of a type that the parser reads stays a word after it."""
    option = _option_of(word)
    value = _value_of(word, kind, words)
    if value is not None:
        return [f"{option}={kind.in_brackets(value)}"]
    value = next_value(words)
    return [option] if value is None else [option, value]


def _check_group(word: str, names: Sequence[str], words: Sequence[str]) -> None:
    """Raise `InputError` for an option of a group of settings, `names`, whose value is no table of settings.

    The value may be a file, or be written as in one: `--data FILE.yaml`, `--data '{"limit": 3}'`.
    """
    option, has_value, value = word.partition("=")
    text = value if has_value else next(iter(words), "")
    is_option = not has_value and text.startswith("--")
    if not names or is_option or text in ("", "null"):
        return
    try:
        settings = _settings_in(text)
    except yaml.YAMLError:  # the parser tells its line and column
        return
    group = _in_messages(_option_of(option))
    given = repr(text)
    if isinstance(settings, dict):
        if "names" not in settings or "names" in names:
            return  # the parser checks the names and values of the settings
        given = f"a data set of YOLO; {FROM_YOLO}"
    elif text.endswith(_FILES_OF_SETTINGS) and not os.path.exists(text):
        raise InputError(f"{group}: no such file: {text}; check the path")
    examples = ", ".join(f"--{group}.{name}" for name in names[:2])
    raise InputError(f"{group}: expected {examples} and others, or a file of them (.yaml, .json), got {given}")


_FILES_OF_SETTINGS = (".yaml", ".yml", ".json")
"""How the names of files of settings end."""


def _settings_in(text: str) -> object:
    """Read the settings in a file, or in a text that is none; None where there are none.

    Raises:
        yaml.YAMLError: they are no YAML.
    """
    is_file = os.path.isfile(text)  # false for a text that is too long for the name of a file, too
    if is_file and not text.endswith(_FILES_OF_SETTINGS):
        return None  # unread: a table of fixations may be long
    try:
        return load_yaml(Path(text).read_text(encoding="utf-8") if is_file else text)
    except (OSError, ValueError):  # ValueError: text that is no UTF-8, or a number with thousands of digits
        return None


def _value_of(word: str, kind: SettingType, words: deque[str]) -> str | None:
    """Find the value of an option in its own word, or take it from those after it; None leaves it to the parser."""
    name, has_value, value = word.partition("=")
    if kind.hint is Path:
        # As `--out "$FOLDER"` is where the variable is not set; it would be the present folder.
        path = value if has_value else next(iter(words), None)
        check(path != "", _in_messages(_option_of(name)), "the name of a file or folder", "an empty one")
    return value if has_value else kind.value_after(words)


def in_present_names(text: str, config: type[Settings]) -> str:
    """Give the settings of a file the names that they have in Python.

    Args:
        text: YAML, with names of options, present or earlier ones; an earlier one is noted in standard error.
        config: dataclass of the settings.

    Returns:
        YAML with names of settings. Names that are not known stay as they are, and what is no YAML.

    Raises:
        InputError: the file has a setting twice, or something else where a group of settings belongs.
    """
    try:
        values = load_yaml(text)
    except (yaml.YAMLError, ValueError):  # ValueError: a date that there is not
        return text
    if not isinstance(values, dict):
        return text
    types = setting_types(config)
    _check_groups(values, types)
    renamed: dict[str, object] = {}
    for key, value in values.items():
        name = str(key)
        present = _present_name(name, types)
        check(present not in renamed, _in_messages(present), "once", f"it again as {name!r}")
        renamed[present] = value
    return text if renamed.keys() == values.keys() else yaml.safe_dump(renamed, sort_keys=False)


def _check_groups(values: Mapping[object, object], types: Mapping[str, SettingType], prefix: str = "") -> None:
    """Check that each group of settings is a mapping by names, or a text: the name of a file of them."""
    for key, value in values.items():
        name = f"{prefix}{key}"
        hint = types.get(name, _NO_SETTING).hint
        is_group = isinstance(hint, type) and issubclass(hint, CheckedSettings)
        if not is_group or value is None or isinstance(value, str):
            continue
        if not isinstance(value, dict) or not all(isinstance(inner, str) for inner in value):
            raise InputError(f"{_in_messages(name)}: expected settings by name, or a file of them, got {value!r}")
        _check_groups(value, types, f"{name}.")


def _present_name(name: str, known: Container[str]) -> str:
    """Find the name of a setting in Python, with a note where it has an earlier one; one not known stays as it is."""
    setting = _in_python(name)
    if setting in known:
        return setting
    present = FORMER.get(setting)
    if present is None or present not in known:
        return name
    print(f"note: {note_of_former(name, present)}", file=sys.stderr)
    return present


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
    setting = _unknown_setting(message)
    if setting is not None:
        return f"unknown setting {setting!r} in a file; {_remedy_for(setting, options, help_option)}"
    return _mistaken_value(message, config)


def _unknown_setting(message: str) -> str | None:
    """Find the name in a file of settings that the parser does not know; None for another mistake."""
    of_file = re.match(r"Option '(.*)' is not accepted", message, re.DOTALL)
    of_group = re.match(r"Group '(.*)' does not accept option '(.*)'", message, re.DOTALL)
    match = of_file or of_group
    return None if match is None else ".".join(match.groups())


def _mistaken_value(message: str, config: type[CheckedSettings]) -> str:
    """Say what is wrong with the value of a setting; the message of the parser in one line for other mistakes."""
    missing = re.match(r"argument (--\S+): expected one argument", message)
    if missing:
        return f"--{dashed(missing[1][2:])}: expected a value, got none"
    unread = re.match(r"Parser key \"([\w.]+)\":\s+Unable to load config '(.*?)'", message, re.DOTALL)
    if unread and ", line " not in message:  # a mistake in the file has its line
        group, file = unread.groups()
        reason = "expected a file of settings by name, got" if os.path.exists(file) else "no file of settings:"
        return f"{_in_messages(group)}: {reason} {file}; check the path"
    setting = re.search(r'Parser key "([\w.]+)"', message)
    value = re.search(r"(?:Given|Got) value: (.*)", message)
    if setting and value:
        name = setting[1]
        kind = setting_types(config).get(name, _NO_SETTING)
        refusal = _refusal(kind, value[1].strip())
        if refusal is not None:
            return f"{_in_messages(name)}: {refusal}"
    return " ".join(message.split())


def _refusal(kind: SettingType, value: str) -> str | None:
    """Say why a value is refused, with the word that may be meant; None for types that need more words."""
    expected = kind.expected()
    if expected is None:
        return None
    # All words are listed anyway, and far ones only look like what was meant: `best` for `fast`.
    matches = get_close_matches(value, kind.words(), n=1, cutoff=0.7)
    suggestion = f"; did you mean {matches[0]!r}?" if matches else ""
    return f"expected {expected}, got {value!r}{suggestion}"


def _unknown_argument(text: str, options: Iterable[str], help_option: str) -> str:
    """Say what is wrong with arguments that the parser does not know."""
    word = next((word for word in text.split() if word.startswith("-")), None)
    if word is None:
        return f"unexpected argument {text!r}; put a name with spaces in quotes, and commas in a list"
    # `exists` takes a word that is too long for the name of a file, too.
    if os.path.exists(word):
        return f"unknown option {word}; write the file of this name as ./{word}"
    option = word.partition("=")[0]
    return f"unknown option {option}; {_remedy_for(option.lstrip('-'), options, help_option)}"


def _remedy_for(name: str, options: Iterable[str], help_option: str) -> str:
    """Name the option that is probably meant by an unknown name, or else the option that lists all."""
    names = [dashed(option[2:]) for option in options]
    matches = get_close_matches(dashed(name), names, n=1, cutoff=0.7)
    return f"did you mean --{matches[0]}?" if matches else f"{help_option} lists all options"
