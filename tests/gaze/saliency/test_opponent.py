"""Opponent colours against plain Python, pixel by pixel, and CIELAB against scikit-image and OpenCV."""

import cv2
import numpy as np
import pytest
import torch
from skimage import color

from semfov.gaze.saliency.opponent import double_opponency, lab_colours, opponent_colours
from tests.refusals import refused


def test_double_opponency(dtype: torch.dtype) -> None:
    image = torch.rand(2, 3, 6, 5, dtype=dtype) ** 3
    image[1] *= 0.1  # the threshold is computed for each image
    for single, result in zip(image, double_opponency(image), strict=True):
        brightest = max(sum(pixel.tolist()) / 3 for pixel in single.flatten(1).T)
        for pixel, got in zip(single.flatten(1).T, result.flatten(1).T, strict=True):
            intensity = sum(pixel.tolist()) / 3
            r, g, b = (v / intensity if intensity > brightest / 10 else 0.0 for v in pixel.tolist())
            red, green = max(r - (g + b) / 2, 0), max(g - (r + b) / 2, 0)
            blue, yellow = max(b - (r + g) / 2, 0), max((r + g) / 2 - abs(r - g) / 2 - b, 0)
            assert got.tolist() == pytest.approx([intensity, red - green, blue - yellow], abs=2e-6)


def test_lab(dtype: torch.dtype) -> None:
    pixels = np.random.default_rng(0).random((20, 30, 3))
    # Black, white and dark greys, where another branch of the formula applies.
    pixels[0, :4] = np.array([0.0, 1.0, 0.001, 0.02])[:, None]
    channels = lab_colours(torch.from_numpy(pixels).permute(2, 0, 1)[None].to(dtype))
    assert channels.dtype == dtype
    result = channels[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(result, color.rgb2lab(pixels) / (100, 255, 255), atol=2e-6)
    # The program of VOCUS2's authors uses OpenCV's 8-bit values, with an offset.
    coded = cv2.cvtColor((255 * pixels).round().astype(np.uint8), cv2.COLOR_RGB2Lab) / 255
    np.testing.assert_allclose(result + np.array([0, 128, 128]) / 255, coded, atol=0.01)


@pytest.mark.parametrize("level", [0.0, 1e-30, 0.3, 1.0])
def test_colour_channels_of_grey_are_zero(level: float, dtype: torch.dtype) -> None:
    image = torch.full((1, 3, 4, 4), level, dtype=dtype)
    for channels in (opponent_colours(image), double_opponency(image)):
        assert torch.isfinite(channels).all()
        assert channels[:, 1:].abs().max() == 0


@pytest.mark.parametrize(
    "image",
    [
        torch.zeros(3, 4, 4),
        torch.zeros(1, 1, 4, 4),
        torch.zeros(1, 1, 3, 4, 4),
        torch.zeros(1, 3, 0, 4),
        torch.zeros(1, 3, 4, 4, dtype=torch.uint8),
    ],
)
def test_bad_image(image: torch.Tensor) -> None:
    for function in (opponent_colours, double_opponency, lab_colours):
        refused("image: expected", function, image)


def test_rows_that_are_worked_on_together_change_no_bit(monkeypatch) -> None:
    image = torch.rand(2, 3, 37, 50, generator=torch.Generator().manual_seed(0))
    expected = double_opponency(image)
    monkeypatch.setattr("semfov.gaze.saliency.opponent._PIXELS", 300)
    assert torch.equal(double_opponency(image), expected)
