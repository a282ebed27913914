"""Families of tests whose cases prove much the same: `make test` runs a part of them, and `make test-all` all.

What is left out is marked as `long`.
"""

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import Any

import pytest
from _pytest.mark import ParameterSet


def first_of(values: Iterable[Any], count: int = 1) -> list[Any]:
    """Parameters of a test: the first values are always taken, and the others, such as more seeds, by request."""
    family = list(values)
    return [*family[:count], *(pytest.param(value, marks=pytest.mark.long) for value in family[count:])]


def pairs_of(case: Sequence[Any]) -> set[Any]:
    """Each two values of a case, with their places."""
    return set(combinations(enumerate(case), 2))


def every_two(cases: Iterable[Sequence[Any]]) -> list[ParameterSet]:
    """Parameters of a test of several values: of all cases as many are always taken that every two values meet.

    Each step takes the case with the most pairs of values that have not met.
    """
    cases = list(map(tuple, cases))
    pairs = set().union(*map(pairs_of, cases))
    selection = set()
    while pairs:
        best = max(cases, key=lambda case: len(pairs & pairs_of(case)))
        selection.add(best)
        pairs -= pairs_of(best)
    return [pytest.param(*case, marks=[] if case in selection else [pytest.mark.long]) for case in cases]
