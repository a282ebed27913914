"""VOCUS2 against the steps of its authors' program (Frintrop, Werner and Martín García, 2015), written with OpenCV."""

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
import torch
from skimage import color

from semfov.gaze.saliency import VOCUS2, vocus2_saliency
from tests.refusals import refused


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE).reshape(image.shape)


def opencv_pyramids(
    channel: np.ndarray, centre: float, surround: float, layers: int, scales: int
) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """Centres and surrounds of one channel; the first scale of the next layer is blurred at full size, then sampled."""
    pyramids = []
    image = blur(channel, centre)
    for layer in range(min(layers, int(np.log2(min(channel.shape))) + 1)):
        if layer:
            image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_NEAREST)
        twins, sigma = [], centre
        for scale in range(scales):
            if scale:
                wanted = centre * 2 ** (scale / scales)
                image, sigma = blur(image, np.sqrt(wanted**2 - sigma**2)), wanted
            twins.append((image, blur(image, np.sqrt(surround**2 - centre**2) * 2 ** (scale / scales))))
        image = blur(image, np.sqrt((2 * centre) ** 2 - sigma**2))
        pyramids.append(twins)
    return pyramids


def opponents(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """Intensity and two opponencies."""
    red, green, blue = np.moveaxis(image, -1, 0)
    return (red + green + blue) / 3, red - green, blue - (red + green) / 2


def opencv_vocus2(
    channels: Sequence[np.ndarray], centre: float, surround: float, scales: int, fusion: str
) -> np.ndarray:
    """Feature maps, then conspicuity maps, then saliency, in [0, 1]."""
    join = np.mean if fusion == "mean" else np.max
    conspicuities = []
    for channel in channels:
        pyramids = opencv_pyramids(channel, centre, surround, 5, scales)
        features = []
        for sign in (1, -1):
            contrasts = [np.maximum(sign * (c - s), 0) for layer in pyramids for c, s in layer]
            size = channel.shape[::-1]
            enlarged = [cv2.resize(each, size, interpolation=cv2.INTER_CUBIC) for each in contrasts]
            features.append(join(enlarged, axis=0))
        conspicuities.append(join(features, axis=0))
    saliency = join(conspicuities, axis=0)
    return (saliency - saliency.min()) / (saliency.max() - saliency.min())


@pytest.mark.parametrize("fusion", ["mean", "max"])
@pytest.mark.parametrize(("centre", "surround", "scales"), [(2.0, 6.0, 1), (3.0, 13.0, 2), (2.0, 6.0, 3)])
def test_saliency_equals_the_steps_in_opencv(photograph, fusion, centre, surround, scales, dtype):
    image = torch.from_numpy(photograph).permute(2, 0, 1)[None].to(dtype)
    saliency = VOCUS2(centre, surround, scales=scales, fusion=fusion)(image)
    assert saliency.dtype == dtype
    expected = opencv_vocus2(opponents(photograph), centre, surround, scales, fusion)
    np.testing.assert_allclose(saliency[0].numpy(), expected, atol=2e-5)


def test_saliency_in_lab_equals_that_of_lab_channels_by_scikit_image(photograph: np.ndarray) -> None:
    lab = color.rgb2lab(photograph) / (100, 255, 255)
    expected = opencv_vocus2(np.moveaxis(lab, -1, 0), 2.0, 6.0, 2, "mean")
    saliency = VOCUS2(color_space="lab")(torch.from_numpy(photograph).permute(2, 0, 1)[None])
    np.testing.assert_allclose(saliency[0].numpy(), expected, atol=2e-5)
    assert np.abs(expected - opencv_vocus2(opponents(photograph), 2.0, 6.0, 2, "mean")).max() > 0.05


@pytest.mark.parametrize("color_space", ["opponent", "lab"])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (2, 3), (7, 5), (33, 200)])
def test_any_size_and_uniform_images(size, color_space, dtype, device):
    image = torch.rand(1, 3, *size, dtype=dtype, device=device)
    saliency = vocus2_saliency(image, color_space=color_space)
    assert saliency.shape == (1, *size)
    assert torch.isfinite(saliency).all()
    for fusion in ("mean", "max"):
        uniform = image[..., :1, :1].expand_as(image)
        assert vocus2_saliency(uniform, fusion=fusion, color_space=color_space).abs().max() == 0


@pytest.mark.parametrize("fusion", ["mean", "max"])
@pytest.mark.parametrize("normalise", [True, False])
@pytest.mark.parametrize("color_space", ["opponent", "lab"])
def test_gradients(fusion: str, normalise: bool, color_space: str) -> None:
    image = torch.rand(1, 3, 6, 7, dtype=torch.float64, requires_grad=True)
    model = VOCUS2(1.0, 2.0, fusion=fusion, normalise=normalise, color_space=color_space)
    assert torch.autograd.gradcheck(model, image, fast_mode=True)


@pytest.mark.slow
def test_compilation() -> None:
    """Of what is not the default."""
    model, image = VOCUS2(layers=1, scales=1, fusion="max", color_space="lab"), torch.rand(1, 3, 33, 70)
    compiled = torch.compile(model, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(image), model(image))


@pytest.mark.parametrize(
    "settings",
    [
        {"centre_sigma": 0.0},
        {"centre_sigma": 6.0},
        {"centre_sigma": float("nan")},
        {"surround_sigma": 1.0},
        {"layers": 0},
        {"scales": 0},
        {"fusion": "sum"},
        {"color_space": "lap"},
    ],
)
def test_bad_settings(settings: dict[str, object]) -> None:
    refused(r"sigma|layers|scales|fusion|color space", VOCUS2, **settings)
    refused(r"sigma|layers|scales|fusion|color space", vocus2_saliency, torch.rand(1, 3, 8, 8), **settings)


def test_bad_image() -> None:
    refused("image", VOCUS2(), torch.zeros(2, 3, 8, 8, 8))
    refused("image", VOCUS2(), torch.zeros(1, 3, 0, 8))
