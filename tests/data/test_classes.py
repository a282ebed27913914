import pytest

from semfov.data import canonical_name, class_index
from semfov.data.classes import ALIASES, class_indices
from semfov.errors import InputError


@pytest.mark.parametrize(("old", "new"), ALIASES.items())
def test_both_spellings_are_one_class(old, new):
    assert canonical_name(old) == canonical_name(new) == new
    assert class_index(old, ("person", new)) == class_index(new, ("person", old)) == 2


def test_case_and_spaces_do_not_matter():
    assert canonical_name("  Traffic_Light ") == "traffic light"


def test_unknown_names_are_told_with_the_nearest():
    with pytest.raises(InputError, match="unknown class 'bycicle'; did you mean 'bicycle'"):
        class_index("bycicle", ("person", "bicycle"))


def test_one_class_twice_is_refused():
    with pytest.raises(InputError, match="expected 2 different names"):
        class_indices(("sofa", "couch"))
