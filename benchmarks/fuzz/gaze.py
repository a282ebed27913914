"""Fuzz the sensor with images of any shape, fixations at any place and windows of any width."""

import math

import torch
from hypothesis import strategies as st

from benchmarks.fuzz.runner import attempt, choose, draw_rng, failed, outcome
from semfov import foveate

NUMBERS = (0.0, -1.0, 1e-30, 1e-3, 1.0, 37.5, 1e6, 1e30, math.inf, -math.inf, math.nan)


def fixations(data: st.DataObject) -> str:
    """`foveate`: a finite view with the image's shape and in a bounded range, or `InputError`.

    A band is a difference of two averages, so its values are at most the image's range r. K bands with weights in
    [0, 1] then keep the view within K r of the image's values.

    Args:
        data: source of random choices.

    Returns:
        The kind of the outcome.
    """
    rng = draw_rng(data)
    width = 5000 if data.draw(st.integers(0, 20), label="wide") == 0 else data.draw(st.integers(1, 140), label="width")
    height = 1 if width == 5000 else data.draw(st.integers(1, 60), label="height")
    batch, channels = data.draw(st.integers(1, 2), label="batch"), data.draw(st.integers(1, 3), label="channels")
    dtype = choose(data, (torch.float32, torch.float64), "dtype")
    image = torch.from_numpy(rng.random((batch, channels, height, width))).to(dtype)
    flat = data.draw(st.integers(0, 3), label="flat") == 0
    if flat:
        image = torch.full_like(image, 0.25)
    gaze = torch.tensor([number(data, -500.0, 500.0), number(data, -500.0, 500.0)], dtype=torch.float64)
    sigma, growth = number(data, 1e-3, 1e3), number(data, 0.25, 4.0)
    levels = data.draw(st.integers(-1, 7), label="levels")
    convention = choose(data, ("kornia", "opencv", "kornia", "opencv", "gabor"), "convention")
    result = attempt(lambda: foveate(image, gaze, sigma=sigma, levels=levels, growth=growth, convention=convention))
    bad = not bool(torch.isfinite(gaze).all()) or levels < 0 or convention == "gabor"
    bad |= not positive(sigma) or not positive(growth)
    if failed(result):
        assert bad, result
        return outcome(result)
    assert not bad
    assert isinstance(result, torch.Tensor)
    assert result.shape == image.shape
    assert result.dtype == dtype
    assert bool(torch.isfinite(result).all()), "the view is not finite"
    assert float((result - 0.5).abs().max()) <= 0.5 + max(levels, 1)
    if flat:
        torch.testing.assert_close(result, image, rtol=0, atol=1e-5)
    if math.isinf(sigma) and math.isfinite(growth):
        torch.testing.assert_close(result, image, rtol=0, atol=1e-5)
    return "result"


def number(data: st.DataObject, low: float, high: float) -> float:
    """A number, mostly from the range, sometimes any number."""
    ordinary = data.draw(st.integers(0, 9), label="ordinary") > 0
    return data.draw(st.floats(low, high)) if ordinary else choose(data, NUMBERS, "number")


def positive(number: float) -> bool:
    """Whether a number is positive in single precision."""
    return float(torch.tensor(number)) > 0
