"""Class names, matched between annotation files and detectors."""

from collections.abc import Sequence

from semfov.errors import InputError, lookup

# Darknet's lists keep the names of PASCAL VOC for six classes that COCO renamed.
ALIASES = {
    "aeroplane": "airplane",
    "motorbike": "motorcycle",
    "sofa": "couch",
    "pottedplant": "potted plant",
    "diningtable": "dining table",
    "tvmonitor": "tv",
}


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


def class_index(name: str, classes: Sequence[str]) -> int:
    """Index of the class called `name` in either spelling, from 1; an unknown name is told with the nearest known.

    >>> class_index("couch", ("person", "sofa"))
    2
    """
    index = class_indices(classes).get(canonical_name(name))
    return classes.index(lookup(name, classes, "class")) + 1 if index is None else index
