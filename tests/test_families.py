"""Which cases of a family of tests are always run."""

from itertools import combinations, product

from tests.families import every_two, first_of


def always(parameters):
    """The values of the parameters that are not marked as `long`."""
    return [parameter.values for parameter in parameters if not parameter.marks]


def test_every_two_values_that_any_case_has_meet_in_a_case_that_is_always_run():
    cases = [case for case in product("ab", "cde", "fgh", range(4)) if case[:2] != ("a", "c")]
    parameters = every_two(cases)
    assert [parameter.values for parameter in parameters] == cases
    selection = always(parameters)
    assert len(selection) < len(cases) / 3
    for first, second in combinations(range(4), 2):
        pairs = [{(case[first], case[second]) for case in family} for family in (cases, selection)]
        assert pairs[0] == pairs[1]


def test_two_values_meet_in_all_of_their_cases():
    assert len(always(every_two(product(range(3), range(4))))) == 12


def test_the_first_values_are_always_run_and_none_is_lost():
    one, two, *others = first_of(range(5), count=2)
    assert (one, two) == (0, 1)
    assert [(parameter.values, [mark.name for mark in parameter.marks]) for parameter in others] == [
        ((number,), ["long"]) for number in (2, 3, 4)
    ]
