"""Class names, matched between annotation files and detectors."""

import re
from collections.abc import Sequence
from difflib import get_close_matches
from numbers import Integral

from torch import Tensor

from semfov.data.synonyms import SYNONYMS
from semfov.errors import InputError, check

# Darknet's lists keep the names of PASCAL VOC for six classes that COCO renamed.
ALIASES = {
    "aeroplane": "airplane",
    "motorbike": "motorcycle",
    "sofa": "couch",
    "pottedplant": "potted plant",
    "diningtable": "dining table",
    "tvmonitor": "tv",
}
_SPELT = {"".join(new.split()): [old for old in ALIASES if ALIASES[old] == new] for new in ALIASES.values()}
_IRREGULAR = {"person": "people", "mouse": "mice", "skis": "ski", "scissors": "scissor"}


def canonical_name(name: str) -> str:
    """The COCO spelling of a class name, in lower case with single spaces.

    >>> canonical_name("TVmonitor"), canonical_name("traffic_light")
    ('tv', 'traffic light')
    """
    plain = " ".join(name.replace("_", " ").lower().split())
    return ALIASES.get(plain, plain)


def class_indices(classes: Sequence[str]) -> dict[str, int]:
    """Index of each class by its canonical name, from 1 (0 is background).

    >>> class_indices(("person", "sofa"))
    {'person': 1, 'couch': 2}
    """
    indices = {canonical_name(name): index for index, name in enumerate(classes, 1)}
    if len(indices) != len(classes):
        raise InputError(f"classes: expected {len(classes)} different names, got {len(indices)}")
    return indices


def class_index(name: str | int, classes: Sequence[str], argument: str = "class") -> int:
    """Index of a class, from 1, by its name or by that index.

    A name may be in any case, with or without spaces, underscores and hyphens, in either of its spellings (`ALIASES`),
    and in the plural.

    Args:
        name: name or index 1..K.
        classes: names of the K classes.
        argument: what messages call it.

    Raises:
        InputError: there is no such class; what people else call classes, and the nearest names, are suggested.

    >>> class_index("couch", ("person", "sofa")), class_index("Wine_Glasses", ("cup", "wine glass"))
    (2, 2)
    """
    if not isinstance(name, str):
        return _index(name, len(classes), argument)
    if name in classes:
        return list(classes).index(name) + 1
    wanted, keys = plain_key(name), [plain_key(known) for known in classes]
    forms = [set().union(*map(other_numbers, (key, *_SPELT.get(key, ())))) for key in keys]
    for fits in (
        [index for index, key in enumerate(keys, 1) if key == wanted],
        [index for index, form in enumerate(forms, 1) if wanted in form],
    ):
        if len(fits) == 1:
            return fits[0]
        if fits:
            raise _unknown(argument, name, [classes[index - 1] for index in fits], classes)
    singular = [word for word in SYNONYMS if wanted in other_numbers(word)]
    meant = [key for word in (wanted, *singular) for key in map(plain_key, SYNONYMS.get(word, ())) if key in keys]
    near = get_close_matches(wanted, keys, n=3, cutoff=0.8 if meant else 0.6)
    raise _unknown(argument, name, [classes[keys.index(key)] for key in (*meant, *near)], classes)


def _index(value: object, classes: int, argument: str) -> int:
    """An index 1..K from whatever counts as a whole number."""
    value = value.item() if isinstance(value, Tensor) and value.ndim == 0 else value
    inside = isinstance(value, Integral) and not isinstance(value, bool) and 1 <= int(value) <= classes
    check(inside, argument, f"a name, or a whole number from 1 to {classes}", repr(value))
    return int(value)  # type: ignore[call-overload]


def _unknown(argument: str, name: str, meant: Sequence[str], classes: Sequence[str]) -> InputError:
    names = list(dict.fromkeys(meant))
    hint = f"did you mean {' or '.join(map(repr, names))}?" if names else f"known: {', '.join(classes)}"
    return InputError(f"{argument}: unknown class {name!r}; {hint}")


def plain_key(name: str) -> str:
    """A name without what people write it with or without."""
    plain = re.sub(r"[\s_-]+", "", name.lower())
    return re.sub(r"\s", "", ALIASES.get(plain, plain))


def other_numbers(key: str) -> set[str]:
    """The plural of a class as English makes it, or the singular of one that has only a plural."""
    forms = {f"{key}s", f"{key}es", _IRREGULAR.get(key, f"{key}s")}
    for end, plural in (("y", "ies"), ("f", "ves"), ("fe", "ves")):
        if key.endswith(end):
            forms.add(key.removesuffix(end) + plural)
    return forms
