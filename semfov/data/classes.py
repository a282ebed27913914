"""Class names, matched between annotation files, detectors and other tables by spelling and number."""

import re
from collections.abc import Sequence, Set
from difflib import get_close_matches
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.errors import InputError, check

# COCO's classes, each with words that people use for it. A word is not accepted as a name: the message for an unknown
# class suggests the classes that it stands for (`_similar_classes`).
_TABLE = """
person: man, men, woman, women, boy, girl, child, children, kid, baby, human, pedestrian, face, player, rider
bicycle: bike, cycle, push bike, mountain bike, tricycle
motorcycle: motor bike, bike, scooter, moped, vespa
car: automobile, auto, taxi, cab, suv, sedan, jeep, vehicle, minivan
truck: lorry, pickup, pickup truck, van, trailer, fire engine, vehicle
bus: coach, minibus, double decker, school bus, vehicle
airplane: plane, aircraft, jet, airliner, jumbo
train: tram, locomotive, railway, subway, metro, streetcar
boat: ship, sailboat, yacht, canoe, kayak, ferry, rowboat, vessel
traffic light: traffic signal, stop light, signal, traffic lamp
fire hydrant: hydrant
stop sign: traffic sign, road sign, sign
parking meter: meter
bench: park bench, pew
bird: pigeon, seagull, gull, duck, goose, parrot, eagle, crow, chicken, swan, sparrow, owl
cat: kitten, kitty
dog: puppy, hound, doggy
horse: pony, foal, mare, stallion
sheep: lamb, goat, ram, ewe
cow: cattle, bull, calf, ox, bison
bear: polar bear, grizzly, panda
backpack: rucksack, knapsack, bag, school bag
umbrella: parasol, sunshade
handbag: purse, bag, tote, shopping bag, clutch
tie: necktie, bow tie
suitcase: luggage, baggage, trunk, bag, briefcase
frisbee: disc, flying disc
sports ball: ball, football, soccer ball, tennis ball, basketball, baseball, volleyball
tennis racket: racket, racquet, tennis racquet
baseball glove: glove, mitt, baseball mitt
baseball bat: bat
bottle: water bottle, wine bottle, beer bottle, flask
wine glass: glass, goblet, champagne glass, flute
cup: mug, coffee cup, coffee mug, tea cup, glass, tumbler, beaker, paper cup
knife: blade, cutlery
fork: cutlery
spoon: ladle, teaspoon, cutlery
bowl: dish, basin
sandwich: burger, hamburger, toast, sub
orange: mandarin, tangerine, clementine
hot dog: sausage, frankfurter, wiener
donut: doughnut
cake: cupcake, muffin, pie, gateau, birthday cake
chair: seat, stool, armchair, office chair
couch: settee, loveseat, divan, sofa bed
potted plant: plant, house plant, flower pot, pot plant, flower
bed: mattress, bunk
dining table: table, desk, kitchen table, coffee table
toilet: lavatory, loo, wc, commode
tv: television, telly, monitor, screen, display, television set
laptop: notebook, computer, notebook computer, macbook
mouse: computer mouse
remote: remote control, clicker, game controller
keyboard: computer keyboard
cell phone: phone, mobile, mobile phone, smartphone, iphone, telephone, handy
microwave: microwave oven
oven: stove, cooker, range
sink: washbasin, basin, wash basin, tap, faucet
refrigerator: fridge, freezer, icebox
book: magazine, novel, paperback, notebook
clock: watch, wall clock, alarm clock
vase: urn, jar
scissors: shears
teddy bear: teddy, stuffed animal, plush, soft toy, toy
hair drier: hair dryer, blow dryer, hairdryer, dryer
"""


def _classes_by_synonym(table: str) -> dict[str, tuple[str, ...]]:
    """Group classes by each of their synonyms, which are written without spaces."""
    classes: dict[str, tuple[str, ...]] = {}
    for line in table.strip().splitlines():
        name, _, synonyms = line.partition(": ")
        for synonym in synonyms.split(", "):
            key = synonym.replace(" ", "")
            classes[key] = (*classes.get(key, ()), name)
    return classes


_SYNONYMS = _classes_by_synonym(_TABLE)  # names of COCO's classes by their synonyms, in lower case, without spaces

# Darknet's list of COCO classes keeps the PASCAL VOC names of six classes that COCO renamed.
_ALIASES = {
    "aeroplane": "airplane",
    "motorbike": "motorcycle",
    "sofa": "couch",
    "pottedplant": "potted plant",
    "diningtable": "dining table",
    "tvmonitor": "tv",
}
_DARKNET = {new.replace(" ", ""): old for old, new in _ALIASES.items()}
"""Darknet's names of these classes by those of COCO, without spaces."""

_MOST_NAMED = 12  # largest number of classes that a message names

_UNCHANGED = ("sheep", "skis", "scissors", "broccoli")
_PLURALS = (("(s|x|z|ch|sh)", r"\1es"), ("([^aeiou])y", r"\1ies"), ("ife", "ives"))
"""Ends of words, and how their plurals end; of two, the first counts."""

_IRREGULAR = {"person": "people", "mouse": "mice", "skis": "ski", "scissors": "scissor"}


def canonical_name(name: str) -> str:
    """Write a class name in COCO's spelling, in lower case with single spaces.

    Args:
        name: name of a class, in COCO's or Darknet's spelling.

    Returns:
        The name in COCO's spelling.

    >>> canonical_name("TVmonitor"), canonical_name("traffic_light")
    ('tv', 'traffic light')
    """
    plain = " ".join(name.replace("_", " ").lower().split())
    return _ALIASES.get(plain, plain)


def counted(number: int, name: str) -> str:
    """Write a number of objects of a class in words.

    >>> counted(0, "wine glass"), counted(1, "cup"), counted(36, "person"), counted(2, "wine glass")
    ('no wine glass', '1 cup', '36 people', '2 wine glasses')
    """
    return f"{number or 'no'} {name if number < 2 else plural(name)}"


def amount(count: int, noun: str) -> str:
    """Write how many there are of a thing, in figures.

    >>> amount(0, "look"), amount(1, "look"), amount(3, "pass")
    ('0 looks', '1 look', '3 passes')
    """
    return f"{count} {noun if count == 1 else plural(noun)}"


def plural(name: str) -> str:
    """Write the plural of a class name; a name that does not end in a small letter has none."""
    word = re.split(r"[\s_-]", name)[-1]
    if word in _UNCHANGED or not re.search("[a-z]$", word):
        return name
    if word in ("person", "mouse"):
        return name.removesuffix(word) + _IRREGULAR[word]
    for ending, replacement in _PLURALS:
        if re.search(f"{ending}$", word):
            return re.sub(f"{ending}$", replacement, name)
    return f"{name}s"


def class_indices(classes: Sequence[str]) -> dict[str, int]:
    """Index the classes by their canonical names, from 1; raises `InputError` for two of one name."""
    indices = {canonical_name(name): index for index, name in enumerate(classes, 1)}
    check(len(indices) == len(classes), "classes", f"{len(classes)} different names", len(indices))
    return indices


def class_index(name: str | int, classes: Sequence[str], argument: str = "class") -> int:
    """Look up the index of a class by its name.

    A name may be in upper or lower case, with or without spaces, underscores and hyphens, in COCO's or Darknet's
    spelling, and in the singular or the plural. An index is also accepted, and checked.

    Args:
        name: name or index 1..K of the class.
        classes: names of the K classes.
        argument: name of the argument, for the message.

    Returns:
        The index, from 1.

    Raises:
        InputError: there is no such class, and the message suggests classes with this synonym or a similar name; or the
            name is of several classes, with commas between them.

    >>> class_index("couch", ("person", "sofa")), class_index("Wine_Glasses", ("cup", "wine glass"))
    (2, 2)
    """
    if not isinstance(name, str):
        return _checked_index(name, len(classes), argument)
    if name in classes:
        return list(classes).index(name) + 1
    matches = _matches(name, classes)
    if len(matches) == 1:
        return matches[0] + 1
    words = _between_commas(name)
    if len(words) > 1:
        return _common_index(words, classes, argument)
    suggestions = [classes[place] for place in matches] or _similar_classes(name, classes)
    raise InputError(_unknown(argument, name, suggestions, classes))


def _common_index(words: Sequence[str], classes: Sequence[str], argument: str) -> int:
    """Look up the class that all words name; raises `InputError` where they name several, or for an unknown word."""
    indices = [class_index(word, classes, argument) for word in words]
    names = list(dict.fromkeys(classes[index - 1] for index in indices))
    check(len(names) == 1, argument, "one class", " and ".join(names))
    return indices[0]


def several_known(text: str, classes: Sequence[str]) -> list[str]:
    """Find the classes that a text names with commas between them.

    Args:
        text: the names.
        classes: names of the K classes.

    Returns:
        Two classes or more, as the detector spells them; none where the text is no list, or one of them is unknown.

    >>> several_known("Cups, wine_glass", ("cup", "wine glass"))
    ['cup', 'wine glass']
    """
    words = _between_commas(text)
    if len(words) < 2:
        return []
    try:
        return [known_class(word, classes) for word in words]
    except InputError:
        return []


def _between_commas(text: str) -> list[str]:
    """List what stands between the commas of a text."""
    return [word.strip() for word in text.split(",") if word.strip()]


def known_class(name: str, classes: Sequence[str], argument: str = "class") -> str:
    """Find the class that a name means, as the detector spells it.

    Args:
        name: name of the class in any spelling of `class_index`.
        classes: names of the K classes.
        argument: name of the argument, for the message.

    Returns:
        The name among `classes`.

    Raises:
        InputError: there is no such class; the message suggests classes with this synonym or a similar name.

    >>> known_class("Wine_Glasses", ("cup", "wine glass"))
    'wine glass'
    """
    return classes[class_index(name, classes, argument) - 1]


def _matches(name: str, classes: Sequence[str]) -> list[int]:
    """Find the places of the classes that a name spells, from 0: in the same number, else in the other one.

    >>> _matches("wine_glasses", ("cup", "wine glass"))
    [1]
    """
    wanted = _plain_key(name)
    keys = [_plain_key(class_name) for class_name in classes]
    # A name in another number is looked for only where none has this spelling: `glass` is no plural of `glas`.
    spelled = [place for place, key in enumerate(keys) if wanted == key]
    return spelled or [place for place, key in enumerate(keys) if wanted in _inflections(key)]


def _checked_index(value: object, count: int, argument: str) -> int:
    """Check an index of one of `count` classes, which may be a number of NumPy or of a tensor."""
    number = value.item() if isinstance(value, Tensor) and value.ndim == 0 else value
    if isinstance(number, Integral) and not isinstance(number, bool) and 1 <= int(number) <= count:
        return int(number)
    raise InputError(f"{argument}: expected a name, or a whole number from 1 to {count}, got {number!r}")


def _inflections(key: str) -> set[str]:
    """List the singular and the plurals of a class, in COCO's and in Darknet's spelling."""
    forms = _other_numbers(key)
    if key in _DARKNET:
        forms |= _other_numbers(_DARKNET[key])
    return forms


def _similar_classes(name: str, classes: Sequence[str]) -> list[str]:
    """Find the classes that an unknown name may mean: those with it as a synonym, and those of a similar spelling."""
    wanted = _plain_key(name)
    by_key: dict[str, str] = {}
    for class_name in classes:
        by_key.setdefault(_plain_key(class_name), class_name)  # the first of two in one spelling
    words = [wanted, *(word for word in _SYNONYMS if wanted in _other_numbers(word))]
    meant: list[str] = []
    for word in words:
        meant += filter(by_key.__contains__, map(_plain_key, _SYNONYMS.get(word, ())))
    # A synonym says more than a similar spelling, which then has to be closer.
    similar = get_close_matches(wanted, by_key, n=3, cutoff=0.8 if meant else 0.6)
    return [by_key[key] for key in (*meant, *similar)]


def class_numbers(
    names: str | int | Sequence[str | int] | Set[str | int] | NDArray[Any] | None,
    classes: Sequence[str],
    argument: str = "class",
) -> tuple[int, ...]:
    """Look up the indices of one class, of several, or of all classes.

    Args:
        names: one name or index, or several, also in an array; those of a set are sorted. None for all classes.
        classes: names of the K classes.
        argument: name of the argument, for the message.

    Returns:
        The indices, from 1, in the order given and without repeats; none for all classes.

    Raises:
        InputError: there is no such class.
    """
    if names is None:
        return ()
    entries: Any = names
    if isinstance(names, Set):
        entries = sorted(names, key=str)
    elif isinstance(names, np.ndarray):
        entries = names.tolist()
    if isinstance(entries, str) or not isinstance(entries, Sequence):
        return (_index_of_one(entries, classes, argument),)
    check(len(entries) > 0, argument, "a class, several, or None for all", entries)
    indices = [class_index(name, classes, argument) for name in entries]
    return tuple(dict.fromkeys(indices))


def _index_of_one(name: str | int, classes: Sequence[str], argument: str) -> int:
    """Look up the index of one class; the error for a text with several of them says that they are a list."""
    try:
        return class_index(name, classes, argument)
    except InputError as error:
        names = several_known(str(name), classes)
        if not names:
            raise
        raise InputError(f"{error}; several classes are a list: {names}") from None


def _unknown(argument: str, name: str, meant: Sequence[str], classes: Sequence[str]) -> str:
    """Write the message for an unknown class, with the classes that may be meant."""
    names = list(dict.fromkeys(meant))
    if names:
        hint = f"did you mean {' or '.join(map(repr, names))}?"
    elif len(classes) <= _MOST_NAMED:
        hint = f"known: {', '.join(classes)}"
    else:
        hint = f"known: {', '.join(classes[:5])} and {len(classes) - 5} more; agent.classes lists them"
    return f"{argument}: unknown class {name!r}; {hint}"


def _plain_key(name: str) -> str:
    """Write a name in lower case, without spaces, underscores and hyphens, in COCO's spelling."""
    plain = re.sub(r"[\s_-]+", "", name.lower())
    return re.sub(r"\s", "", _ALIASES.get(plain, plain))


def _other_numbers(key: str) -> set[str]:
    """List the plural forms of a class name; for a name that is a plural, also its singular."""
    # More forms than are words, as each is only compared with what was asked for.
    forms = {f"{key}s", f"{key}es", _IRREGULAR.get(key, f"{key}s")}
    for end, plural in (("y", "ies"), ("f", "ves"), ("fe", "ves")):
        if key.endswith(end):
            forms.add(key.removesuffix(end) + plural)
    return forms
