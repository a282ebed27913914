import pytest

from semfov.data import canonical_name, class_index
from semfov.data.classes import ALIASES, class_indices, class_numbers
from semfov.errors import InputError


@pytest.mark.parametrize(("old", "new"), ALIASES.items())
def test_both_spellings_give_the_same_class(old, new):
    assert canonical_name(old) == canonical_name(new) == new
    assert class_index(old, ("person", new)) == class_index(new, ("person", old)) == 2


def test_case_and_spaces_do_not_matter():
    assert canonical_name("  Traffic_Light ") == "traffic light"


def test_the_error_for_an_unknown_class_suggests_the_nearest_name():
    with pytest.raises(InputError, match="unknown class 'bycicle'; did you mean 'bicycle'"):
        class_index("bycicle", ("person", "bicycle"))


def test_the_same_class_twice_is_refused():
    with pytest.raises(InputError, match="expected 2 different names"):
        class_indices(("sofa", "couch"))


def test_several_classes_in_one_text_are_refused_with_the_list():
    with pytest.raises(InputError, match=r"; several classes are a list: \['cup', 'sofa'\]$"):
        class_numbers("cup, sofa", ("cup", "couch"))
