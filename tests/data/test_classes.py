import numpy as np
import pytest

from semfov.data import canonical_name, class_index
from semfov.data.classes import _ALIASES, class_indices, class_numbers
from semfov.detection.class_names import COCO_CLASSES
from tests.refusals import refused


@pytest.mark.parametrize(("old", "new"), _ALIASES.items())
def test_both_spellings_give_the_same_class(old, new):
    assert canonical_name(old) == canonical_name(new) == new
    assert class_index(old, ("person", new)) == class_index(new, ("person", old)) == 2


def test_every_class_name_matches_only_its_own_class():
    for place, name in enumerate(COCO_CLASSES):
        for spelling in (name, name.upper(), name.replace(" ", "_")):
            assert class_index(spelling, COCO_CLASSES) == place + 1
    assert COCO_CLASSES[class_index("sofa", COCO_CLASSES) - 1] == "couch"
    refused("unknown class 'spaceship'", class_index, "spaceship", COCO_CLASSES)
    refused("expected 2 different names", class_indices, ("sofa", "couch"))
    message = r"^class: expected one class, got cup and couch; several classes are a list: \['cup', 'couch'\]$"
    refused(message, class_numbers, "cup, sofa,", ("cup", "couch"))
    refused(r"^class: unknown class 'cupp'; did you mean 'cup'\?$", class_numbers, "sofa,cupp", ("cup", "couch"))
    assert class_numbers({"sofa", "cup"}, ("couch", "cup")) == (2, 1)  # sorted as they are written
    assert class_numbers(np.array(["cup", "sofa"]), ("couch", "cup")) == (2, 1)
