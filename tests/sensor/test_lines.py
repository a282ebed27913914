"""Banded matrices split into tiles, against the full matrix."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch._subclasses import FakeTensorMode

from semfov.sensor.lines import Taps, banded, constant, separable
from tests.small import rand


@pytest.mark.slow
@settings(max_examples=25)
@given(
    tiles=st.integers(1, 10),
    tile=st.integers(1, 16),
    shift=st.integers(1, 16),
    reach=st.integers(0, 20),
    rest=st.integers(0, 15),
    fewer=st.integers(0, 15),
    alike=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_tiles_give_the_product_with_the_full_matrix(tiles, tile, shift, reach, rest, fewer, alike, seed):
    generator = np.random.default_rng(seed)
    count, taps = 161 + tiles * shift + 2 * reach + rest, 3
    length = -(-count // shift) * tile - min(fewer, tile - 1)
    under = np.arange(length)[:, None] // tile
    offsets = generator.integers(-reach, shift + reach, (1 if alike else length // tile + 1, tile, taps))
    weights = generator.normal(size=offsets.shape)
    pick = (0 if alike else under[:, 0], np.arange(length) % tile)
    index = np.clip(under * shift + offsets[pick], 0, count - 1)
    whole = np.zeros((length, count))
    np.add.at(whole, (np.arange(length)[:, None], index), weights[pick])

    lines = banded(
        Taps(torch.from_numpy(index), torch.from_numpy(weights[pick])),
        count,
        tile,
        shift,
        reach,
        torch.float64,
        torch.device("cpu"),
    )
    assert lines.length == length
    image = torch.from_numpy(generator.random((2, count, count)))
    expected = torch.from_numpy(whole) @ image @ torch.from_numpy(whole).T
    torch.testing.assert_close(separable(image, lines, lines), expected)
    recorded = separable(image.clone().requires_grad_(), lines, lines)
    torch.testing.assert_close(recorded.detach(), expected)


def test_only_long_lines_are_split_into_tiles():
    index = torch.arange(400)[:, None]
    taps = Taps(index, torch.ones(400, 1, dtype=torch.float64))
    lines = banded(taps, 400, 8, 8, 1, torch.float32, torch.device("cpu"))
    assert lines.dense is None
    assert lines.middle.shape == (48, 8, 10)
    assert lines.middle.stride(0) == 0, "equal tiles share one matrix"
    assert (
        banded(Taps(index[:100], taps.weight[:100]), 100, 8, 8, 1, torch.float32, torch.device("cpu")).dense is not None
    )


def test_planes_that_are_filtered_together_do_not_mix():
    """Tiles lie across planes, and a picture with NaN leaves its neighbours as they are."""
    index = (torch.arange(200)[:, None] * 2 + torch.tensor([-2, -1, 0, 1, 2])).clamp(0, 399)
    lines = banded(Taps(index, rand(200, 5).double()), 400, 8, 16, 2, torch.float64, torch.device("cpu"))
    planes = rand(3, 400, 400).double()
    planes[1] = torch.nan
    together = separable(planes, lines, lines)
    assert together[1].isnan().all()
    for n in (0, 2):
        assert torch.equal(together[n], separable(planes[n], lines, lines))
    assert separable(planes[:0], lines, lines).shape == (0, 200, 200)


def test_what_is_made_while_a_graph_is_traced_is_not_kept():
    made = constant(lambda length: torch.arange(length))
    with FakeTensorMode():
        assert made(3).shape == (3,)
    assert made(3).tolist() == [0, 1, 2]
    assert made(3) is made(3)
    with FakeTensorMode() as mode:
        assert made(3).fake_mode is mode
