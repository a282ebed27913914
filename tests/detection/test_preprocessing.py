import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.detection.preprocessing import Preprocessing
from semfov.errors import InputError

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
    with pytest.raises(InputError, match=next(iter(settings)) if "channels" not in settings else "channel order"):
        Preprocessing().merged(settings)


def test_merging_keeps_the_other_settings():
    merged = Preprocessing(channels="bgr", scale=255.0).merged({"std": [2, 2, 2], "stretch": True})
    assert merged == Preprocessing(channels="bgr", scale=255.0, std=(2.0, 2.0, 2.0), stretch=True)
    assert Preprocessing(**merged.settings()) == merged
