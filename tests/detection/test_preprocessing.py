import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.detection.preprocessing import Preprocessing
from tests.refusals import refused

numbers = st.floats(0.1, 200)


@given(
    st.sampled_from(["rgb", "bgr"]),
    numbers,
    st.tuples(numbers, numbers, numbers),
    st.tuples(numbers, numbers, numbers),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_every_pixel_equals_the_formula(channels, scale, mean, std, dtype):
    canvas = torch.rand(2, 3, 2, 3, dtype=dtype, generator=torch.Generator().manual_seed(0))
    before = canvas.clone()
    image = Preprocessing(channels=channels, scale=scale, mean=mean, std=std)(canvas)
    source = canvas.double().numpy()
    expected = np.empty_like(source)
    for out in range(3):
        expected[:, out] = (source[:, out if channels == "rgb" else 2 - out] * scale - mean[out]) / std[out]
    assert image.dtype == dtype
    np.testing.assert_allclose(image.numpy(), expected, rtol=1e-4, atol=1e-3 if dtype == torch.float32 else 1e-9)
    assert torch.equal(canvas, before)


@pytest.mark.parametrize("layout", ["planes", "pixels", "part"])
@pytest.mark.parametrize(
    "settings",
    [
        {"channels": "bgr", "scale": 255.0},
        {"mean": (0.485, 0.456, 0.406), "std": (0.229, 0.224, 0.225)},
        {"channels": "bgr", "scale": 255.0, "mean": (103.5, 0.0, 123.7), "std": (57.4, 57.1, 1.0)},
        {},
    ],
)
def test_bytes_equal_the_formula(settings, layout):
    source = np.random.default_rng(0).integers(256, size=(2, 3, 5, 4), dtype=np.uint8)
    canvas = torch.from_numpy(source.copy())
    if layout == "pixels":
        canvas = canvas.contiguous(memory_format=torch.channels_last)
    elif layout == "part":
        canvas = torch.nn.functional.pad(canvas, (1, 2, 3, 1))[..., 3:-1, 1:-2]
    wanted = Preprocessing(**settings)
    image = wanted.of_bytes(canvas)
    expected = np.empty(source.shape)
    for out in range(3):
        unit = source[:, out if wanted.channels == "rgb" else 2 - out] / 255
        expected[:, out] = (unit * wanted.scale - wanted.mean[out]) / wanted.std[out]
    assert image.dtype == torch.float32
    assert image.is_contiguous()
    np.testing.assert_allclose(image.numpy(), expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(image, wanted(canvas.float() / 255), rtol=1e-5, atol=1e-5)
    assert np.array_equal(canvas.numpy(), source)


def test_canvases_of_bytes_are_exact_and_checked():
    canvas = torch.arange(256, dtype=torch.uint8).expand(1, 3, 1, -1)
    image = Preprocessing(channels="bgr", scale=255.0).of_bytes(canvas)
    assert torch.equal(image, torch.arange(256.0).expand(1, 3, 1, -1))
    for canvas in [torch.zeros(1, 3, 4, 4), torch.zeros(3, 4, 4).byte(), torch.zeros(1, 4, 4, 3).byte()]:
        refused(r"canvas: expected bytes of shape \(B, 3, H, W\)", Preprocessing().of_bytes, canvas)


@pytest.mark.parametrize(
    "settings",
    [
        {"channels": "grb"},
        {"channels": 3},
        {"mean": (0, 0)},
        {"mean": 0.5},
        {"mean": (0, "0", 0)},
        {"std": (1, 0, 1)},
        {"std": (1, float("nan"), 1)},
        {"scale": 0},
        {"scale": "255"},
        {"fill": 114},
        {"fill": None},
        {"stretch": "no"},
        {"corner": 0},
        {"colour": "rgb"},
    ],
)
def test_refuses_invalid_settings(settings):
    refused(next(iter(settings)) if "channels" not in settings else "channel order", Preprocessing().merged, settings)


def test_merging_keeps_the_other_settings():
    merged = Preprocessing(channels="bgr", scale=255.0).merged({"std": [2, 2, 2], "stretch": True})
    assert merged == Preprocessing(channels="bgr", scale=255.0, std=(2.0, 2.0, 2.0), stretch=True)
    assert Preprocessing(**merged.settings()) == merged
