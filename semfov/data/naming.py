"""Matching of classes by synonyms: with the names of other tables, and in plain text."""

import re
from collections.abc import Sequence
from functools import cache

from semfov.data.classes import other_numbers, plain_key
from semfov.data.synonyms import SYNONYMS


def alike(name: str, names: Sequence[str]) -> list[int]:
    """Find the names that stand for the same class: in another spelling or, where there is none, as synonyms.

    Args:
        name: name of the class.
        names: names to search in.

    Returns:
        Positions of the matching names, from 0.

    >>> alike("tvmonitor", ["cat", "TV"]), alike("cup", ["glass", "mug", "cow"]), alike("cup", ["Cups", "mug"])
    ([1], [0, 1], [0])
    """
    wanted, keys = plain_key(name), [plain_key(known) for known in names]
    forms = {wanted, *other_numbers(wanted)}
    same = [place for place, key in enumerate(keys) if key in forms or wanted in other_numbers(key)]
    if same:
        return same
    return [place for place, key in enumerate(keys) if _calls(key, wanted) or _calls(wanted, key)]


def named_in(text: str, classes: Sequence[str]) -> set[str]:
    """Find the classes that a text mentions, by their names or synonyms, in singular or plural.

    Args:
        text: plain text.
        classes: names of the classes.

    Returns:
        The classes mentioned.

    >>> sorted(named_in("Knives, mugs and a hot dog.", ["knife", "cup", "dog", "hot dog"]))
    ['cup', 'hot dog', 'knife']
    """
    meant = _vocabulary(tuple(classes))
    words, found, start = re.findall(r"[a-z]+", text.lower()), set[str](), 0
    while start < len(words):
        # The longest match wins: "hot dog" does not mention a dog.
        runs = (run for run in (3, 2, 1) if "".join(words[start : start + run]) in meant)
        length = min(next(runs, 1), len(words) - start)
        found |= meant.get("".join(words[start : start + length]), frozenset())
        start += length
    return found


@cache
def _vocabulary(classes: tuple[str, ...]) -> dict[str, frozenset[str]]:
    """Classes by each of their names and synonyms, without spaces, in singular and plural."""
    keys = {plain_key(name): name for name in classes}
    called = {other: {*map(plain_key, meant)} & keys.keys() for other, meant in SYNONYMS.items() if other not in keys}
    said: dict[str, set[str]] = {}
    for word, meant in [*((key, {key}) for key in keys), *called.items()]:
        for form in {word, *other_numbers(word)}:
            said.setdefault(form, set()).update(keys[key] for key in meant)
    return {word: frozenset(names) for word, names in said.items() if names}


def _calls(other: str, key: str) -> bool:
    """Whether `other` is a synonym of a class."""
    return key in map(plain_key, SYNONYMS.get(other, ()))
