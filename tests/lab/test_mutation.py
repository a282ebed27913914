"""What is set aside in mutation tests is a change of the present code."""

import pytest

from benchmarks.mutation import listed, outdated


def test_every_change_that_is_set_aside_is_one_of_the_present_code():
    assert listed()
    assert outdated(listed()) == []


@pytest.mark.parametrize(
    ("function", "change"),
    [
        ("semfov.belief.fusion.gone", "return a"),
        ("semfov.gone.fuse", "return a"),
        ("semfov.belief.fusion.sum", "return beta - likelihood / likelihood.total(-1, keepdim=True)"),
        ("semfov.belief.fusion.sum", "return beta + likelihood / likelihood.sum(-1, keepdim=True)"),
        ("semfov.belief.fusion.fuse_scaled", "order = rank.argsort(stable=False)"),
        ("semfov.fuse", "soft = None"),
    ],
    ids=["no function", "no module", "no such line", "no change", "decorated", "another module"],
)
def test_a_change_that_cannot_occur_is_outdated(function, change):
    assert outdated({function: [change]}) == [f"{function}: {change}"]
