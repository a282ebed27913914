"""Reading the results of mutation tests, from a module in the format that mutmut writes."""

import json
from collections import Counter

import pytest

from benchmarks.mutation import listed, one_change, outdated, read, score

MODULE = """
def x_area__mutmut_orig(a: float, b: float) -> float:
    check(a > 0, "a", "a positive number", a)
    return a * b


def x_area__mutmut_1(a: float, b: float) -> float:
    check(a >= 0, "a", "a positive number", a)
    return a * b


def x_area__mutmut_2(a: float, b: float) -> float:
    check(a > 0, "a", None, a)
    return a * b


def x_area__mutmut_3(a: float, b: float) -> float:
    check(a > 0, "a", "a positive number", a)
    return a / b


class Box:
    def xǁBoxǁ__len____mutmut_orig(self) -> int:
        return 2

    def xǁBoxǁ__len____mutmut_1(self) -> int:
        return 3
"""


@pytest.fixture
def path(tmp_path):
    names = ["x_area__mutmut_1", "x_area__mutmut_2", "x_area__mutmut_3", "xǁBoxǁ__len____mutmut_1"]
    codes = dict(zip((f"shapes.{name}" for name in names), (0, 0, 1, None), strict=True))
    (tmp_path / "shapes.py").write_text(MODULE, encoding="utf-8")
    (tmp_path / "shapes.py.meta").write_text(json.dumps({"exit_code_by_key": codes}), encoding="utf-8")
    return tmp_path / "shapes.py"


def test_mutants_are_read_with_function_change_and_status(path):
    weaker = "check(a >= 0, 'a', 'a positive number', a)"
    first, words, killed, method = read(path, {})
    assert (first.function, first.change, first.status) == ("shapes.area", weaker, "survived")
    assert words.status == "aside"
    assert (killed.change, killed.status) == ("return a / b", "killed")
    assert (method.function, method.change, method.status) == ("shapes.Box.__len__", "return 3", "not run")
    assert next(read(path, {"shapes.area": [weaker]})).status == "aside"


def test_the_score_counts_only_mutants_that_were_run():
    assert score(Counter(killed=3, survived=1, aside=9, **{"not run": 5})) == "75.0%"
    assert score(Counter(killed=1, untested=1)) == "50.0%"


def test_every_change_that_is_set_aside_is_one_of_the_present_code():
    assert listed()
    assert outdated(listed()) == []


@pytest.mark.parametrize(
    ("function", "change"),
    [
        ("semfov.belief.fusion.gone", "return a"),
        ("semfov.gone.fuse", "return a"),
        ("semfov.belief.fusion.sum_scaled", "return beta - scaled / scaled.total(-1, keepdim=True)"),
        ("semfov.belief.fusion.sum_scaled", "return beta + scaled / scaled.sum(-1, keepdim=True)"),
        ("semfov.belief.fusion.fuse_scaled", "order = rank.argsort(stable=False)"),
        ("semfov.fuse", "soft = None"),
    ],
    ids=["no function", "no module", "no such line", "no change", "decorated", "another module"],
)
def test_a_change_that_cannot_occur_is_outdated(function, change):
    assert outdated({function: [change]}) == [f"{function}: {change}"]


@pytest.mark.parametrize(
    "change",
    [
        "return beta - scaled / scaled.sum(-1, keepdim=True)",
        "return beta + scaled / scaled.sum(-1, keepdim=None)",
        "return beta + scaled / scaled.sum(keepdim=True)",
        "return beta + scaled / scaled.sum(-1)",
    ],
)
def test_a_line_with_one_change_is_recognised(change):
    assert one_change("return beta + scaled / scaled.sum(-1, keepdim=True)", change)
    assert outdated({"semfov.belief.fusion.sum_scaled": [change]}) == []
