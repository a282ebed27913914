"""Pyramids, and the products of lines with matrices that they are made of."""

import cv2
import kornia.geometry.transform as kornia
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch._subclasses import FakeTensorMode

from semfov.sensor import foveate, laplacian_pyramid, pyramid, pyrdown, pyrup
from semfov.sensor.constants import constant
from semfov.sensor.lines import Taps, banded, separable
from tests.refusals import refused
from tests.small import draw, rand

CONVENTIONS = ("kornia", "opencv")
# Sides of one pixel, even and odd ones, and both in either order; `test_pyramid_equals_plain_loops` draws more.
SIZES = [(1, 1), (2, 1), (1, 9), (3, 3), (6, 7)]
# Another algorithm is used for more than 160 pixels.
LARGE = [(162, 163), (163, 162), (161, 3), (1, 301)]
# Which sides of an enlarged image are shorter by a pixel: each with some sizes, all of them with small and large ones.
SHORTER = [(0, 0), (1, 0), (0, 1), (1, 1)]
ENLARGED = sorted(
    {(size, SHORTER[number % 4]) for number, size in enumerate(SIZES + LARGE)}
    | {(size, shorter) for size in ((1, 1), (163, 162)) for shorter in SHORTER}
)
sizes = st.tuples(st.integers(1, 24), st.integers(1, 24))


def close(a, b, tolerance=2e-6):
    torch.testing.assert_close(a, torch.as_tensor(b, device=a.device), rtol=0, atol=tolerance)


@pytest.mark.parametrize("size", [s for s in SIZES + LARGE if min(s) >= 3])
def test_pyrdown_and_pyrup_equal_those_of_kornia(size, device):
    image = draw(2, 3, *size, dtype=torch.float32, device=device)
    close(pyrdown(image), kornia.pyrdown(image))
    close(pyrup(image, (2 * size[0], 2 * size[1])), kornia.pyrup(image))


@pytest.fixture
def kornia_everywhere(monkeypatch):
    """Use Kornia's functions on every device, as on accelerators."""
    monkeypatch.setattr(pyramid, "_AHEAD", frozenset())


def levels_of(image, levels=4):
    bands = laplacian_pyramid(image, levels)
    return [*bands.details, bands.base]


@pytest.mark.parametrize("requires_grad", [False, True])
def test_kornia_is_called_only_where_it_can_be_used(monkeypatch, requires_grad):
    called = []
    for name in ("pyrdown", "pyrup"):
        function = getattr(kornia, name)
        monkeypatch.setattr(kornia, name, lambda image, f=function, n=name: called.append(n) or f(image))
    image = draw(1, 3, 32, 48).requires_grad_(requires_grad)
    levels_of(image)
    assert called == [], "on a CPU our code is faster, with gradients too"
    monkeypatch.setattr(pyramid, "_AHEAD", frozenset())
    levels_of(image)
    assert called == ["pyrdown", "pyrup"] * 4
    called.clear()
    laplacian_pyramid(image, 2, "opencv")
    levels_of(image[:, :1])
    laplacian_pyramid(image[..., :2], 1)
    pyrup(image, (64, 95))
    torch.use_deterministic_algorithms(True)
    try:
        levels_of(image)
    finally:
        torch.use_deterministic_algorithms(False)
    assert called == []


@pytest.mark.usefixtures("kornia_everywhere")
def test_gradients_graphs_strided_images_empty_batches_and_vmap_by_kornia():
    assert torch.autograd.gradcheck(lambda x: levels_of(x, 2), draw(1, 2, 6, 5).requires_grad_())
    image = draw(1, 2, 8, 12).requires_grad_()
    gaze = (4 * draw(1, 3, 2)).requires_grad_()
    sigma = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    sensor = lambda image, gaze, sigma: foveate(image, gaze, sigma=sigma, levels=2)  # noqa: E731
    assert torch.autograd.gradcheck(sensor, (image, gaze, sigma), fast_mode=True)
    image, gaze = draw(1, 2, 40, 36).requires_grad_(), 20 * draw(1, 3, 2)
    torch.compiler.reset()

    def sensor(image, gaze):
        return foveate(image, gaze, sigma=7.0, levels=3)

    compiled = torch.compile(sensor, fullgraph=True, backend="eager")
    close(compiled(image, gaze), sensor(image, gaze), 1e-12)
    image = draw(2, 3, 20, 24)
    expected = levels_of(image, 2)
    for same in (image.contiguous(memory_format=torch.channels_last), image.mT.contiguous().mT):
        for a, b in zip(levels_of(same, 2), expected, strict=True):
            close(a, b, 1e-14)
    mapped = torch.func.vmap(lambda plane: levels_of(plane[None], 2)[-1][0])(image)
    close(mapped, expected[-1], 1e-14)
    assert [level.shape[0] for level in levels_of(image[:0], 2)] == [0, 0, 0]


@pytest.mark.parametrize("size", SIZES + LARGE)
def test_pyrdown_equals_opencv(size, device):
    image = draw(1, 3, *size, dtype=torch.float32, device=device)
    expected = [cv2.pyrDown(plane) for plane in image[0].cpu().numpy()]
    close(pyrdown(image, "opencv")[0], np.stack(expected))


@pytest.mark.parametrize(("size", "shorter"), ENLARGED)
def test_pyrup_equals_opencv(size, shorter, device):
    height, width = (2 * n - s for n, s in zip(size, shorter, strict=True))
    image = draw(1, 3, *size, dtype=torch.float32, device=device)
    expected = [cv2.pyrUp(plane, dstsize=(width, height)) for plane in image[0].cpu().numpy()]
    close(pyrup(image, (height, width), "opencv")[0], np.stack(expected).reshape(3, height, width))


@pytest.mark.parametrize("convention", CONVENTIONS)
@given(size=sizes, wider=st.tuples(st.booleans(), st.booleans()))
def test_pyramid_equals_plain_loops(reference_sensor, convention, size, wider):
    image = draw(1, 2, *size)
    close(pyrdown(image, convention)[0], reference_sensor.pyrdown(image[0].numpy(), convention), 1e-12)
    if convention == "kornia":
        target = tuple(2 * n + w for n, w in zip(size, wider, strict=True))
    else:
        target = tuple(2 * n - w for n, w in zip(size, wider, strict=True))
    close(pyrup(image, target, convention)[0], reference_sensor.pyrup(image[0].numpy(), target, convention), 1e-12)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("size", [(7, 11), (172, 165)])
def test_sum_of_expanded_bands_is_the_image(convention, size):
    image = draw(1, 3, *size)
    bands = laplacian_pyramid(image, 5, convention)
    assert bands.shape == size
    result = bands.base
    for band in reversed(bands.details):
        result = band + pyrup(result, tuple(band.shape[-2:]), convention)
    close(result, image, 1e-14)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_images_in_any_memory_layout(convention):
    image = draw(2, 3, 164, 170)
    expected = laplacian_pyramid(image, 3, convention)
    for same in (image.contiguous(memory_format=torch.channels_last), image.mT.contiguous().mT):
        bands = laplacian_pyramid(same, 3, convention)
        for a, b in zip((*bands.details, bands.base), (*expected.details, expected.base), strict=True):
            close(a, b, 1e-14)


def test_bad_input():
    refused("image", pyrdown, torch.rand(4, 4))
    refused("image", pyrup, torch.rand(3, 4, 4), (8, 8))
    for call in (pyrdown, lambda image: pyrup(image, (8, 8)), lambda image: laplacian_pyramid(image, 1)):
        refused("image: expected floating-point numbers, got", call, torch.zeros(1, 3, 4, 4, dtype=torch.uint8))
    refused("convention 'openvc'; did you mean 'opencv'", pyrdown, torch.rand(1, 1, 4, 4), "openvc")
    refused("convention", pyrup, torch.rand(1, 1, 4, 4), (8, 8), "openvc")
    refused("shape: expected 8 or 7 for 4 pixels, got 9", pyrup, torch.rand(1, 1, 4, 4), (8, 9), "opencv")
    refused("levels", laplacian_pyramid, torch.rand(1, 1, 4, 4), -1)
    refused("at least one pixel", laplacian_pyramid, torch.rand(1, 1, 0, 4), 1)
    refused("image", laplacian_pyramid, torch.rand(4, 4), 1)


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
