"""Runs a target on many generated inputs, and counts the outcomes."""

from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from semfov.errors import DataError, InputError

Target = Callable[[st.DataObject], str]
Result = TypeVar("Result")


def run(target: Target, cases: int, number: int = 0) -> Counter[str]:
    """Run a target, and count its results and errors.

    Args:
        target: the target; it raises an exception on a finding, and the smallest such input is reported.
        cases: number of inputs.
        number: random seed of the inputs.

    Returns:
        The counts by kind of outcome.
    """
    outcomes: Counter[str] = Counter()

    @seed(number)
    @settings(
        max_examples=cases,
        deadline=None,
        database=None,
        derandomize=False,
        phases=(Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def case(data: st.DataObject) -> None:
        outcomes[target(data)] += 1

    case()
    return outcomes


def attempt(call: Callable[[], Result]) -> Result | DataError | InputError:
    """The result of `call`, or the error that semfov raises on purpose, whose message must be one meaningful line."""
    try:
        return call()
    except (DataError, InputError) as error:
        message = str(error)
        assert 10 < len(message) < 1000, message
        assert "\n" not in message, message
        return error


def failed(result: object) -> bool:
    """Whether an attempt ended in an error."""
    return isinstance(result, DataError | InputError)


def outcome(result: object) -> str:
    """The kind of an attempt's outcome."""
    return type(result).__name__ if failed(result) else "result"


def draw_rng(data: st.DataObject) -> np.random.Generator:
    """A random generator for arrays, because hypothesis would draw them number by number."""
    return np.random.default_rng(data.draw(st.integers(0, 2**32 - 1), label="seed"))


def choose(data: st.DataObject, options: Any, label: str) -> Any:
    """One of the options."""
    return data.draw(st.sampled_from(list(options)), label=label)
