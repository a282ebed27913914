"""What a strategy is made of."""

import pytest

from semfov import InputError, observers, policies
from semfov.strategy import Strategy


def test_something_else_than_a_policy_or_an_observer_is_refused_by_name():
    for wrong, got in [
        ("random", "a str"),
        (policies.Policy, "the class Policy"),
        (observers.Semantic(3), "a Semantic"),
        (None, "a NoneType"),
    ]:
        with pytest.raises(InputError, match=f"^policy: expected an instance of a subclass of Policy, got {got}$"):
            Strategy(observers.Semantic(3), wrong)
    with pytest.raises(InputError, match=r"^observer: expected an instance of a subclass of Observer, got a Policy$"):
        Strategy(policies.Policy("random"), observers.Semantic(3))
