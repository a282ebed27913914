"""Matching of class names with the names in other tables, by spelling or by synonyms."""

from collections.abc import Sequence

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
    name_key, keys = plain_key(name), [plain_key(other) for other in names]
    forms = {name_key, *other_numbers(name_key)}
    same = [place for place, key in enumerate(keys) if key in forms or name_key in other_numbers(key)]
    if same:
        return same
    return [place for place, key in enumerate(keys) if _calls(key, name_key) or _calls(name_key, key)]


def _calls(other: str, key: str) -> bool:
    """Whether `other` is a synonym of a class."""
    return key in map(plain_key, SYNONYMS.get(other, ()))
