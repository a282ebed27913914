"""What a strategy is made of."""

import pytest

from semfov import observers, policies
from semfov.errors import InputError
from semfov.strategy import Strategy


@pytest.mark.parametrize(
    ("wrong", "got"),
    [
        ("random", "a str"),
        (policies.Random, "the class Random"),
        (observers.Semantic(3), "a Semantic"),
        (None, "a NoneType"),
    ],
)
def test_something_else_than_a_policy_is_refused_by_name(wrong, got):
    with pytest.raises(InputError, match=f"^policy: expected an instance of a subclass of Policy, got {got}$"):
        Strategy(observers.Semantic(3), wrong)


def test_a_policy_in_the_place_of_the_observer_is_refused():
    with pytest.raises(InputError, match=r"^observer: expected an instance of a subclass of Observer, got a Random$"):
        Strategy(policies.Random(), observers.Semantic(3))
