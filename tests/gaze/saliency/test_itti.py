"""The model of Itti, Koch and Niebur (1998) against its steps in OpenCV and loops."""

import cv2
import numpy as np
import pytest
import torch

from semfov.gaze.saliency import IttiKoch, itti_koch_saliency
from semfov.gaze.saliency.itti import _promote
from tests.refusals import refused


def numpy_promote(image: np.ndarray) -> np.ndarray:
    """N(.) of one map, with a search for peaks pixel by pixel."""
    low, high = image.min(), image.max()
    if high - low < 1e-5:
        return np.zeros_like(image)
    image = (image - low) / (high - low)
    height, width = image.shape
    peaks = []
    for y, x in np.argwhere(image > 0.1):
        around = [
            (image[v, u], -(v * width + u))
            for v in range(max(y - 1, 0), min(y + 2, height))
            for u in range(max(x - 1, 0), min(x + 2, width))
            if (v, u) != (y, x)
        ]
        if all((image[y, x], -(y * width + x)) > other for other in around):
            peaks.append(image[y, x])
    others = sorted(peaks)[:-1]
    return image * (1 - (np.mean(others) if others else 0)) ** 2


def opencv_gabor(angle: float, phase: float) -> np.ndarray:
    """OpenCV's kernel is rotated by 180°, and its phase is added to that of the wave."""
    kernel = cv2.getGaborKernel((9, 9), 7 / 3, np.deg2rad(angle), 7.0, 1.0, phase)[::-1, ::-1]
    kernel = kernel - kernel.mean()
    return kernel / np.abs(kernel).sum()


def opencv_energy(image: np.ndarray, angle: float) -> np.ndarray:
    answers = [
        cv2.filter2D(image, -1, opencv_gabor(angle, phase), borderType=cv2.BORDER_REPLICATE) for phase in (0, np.pi / 2)
    ]
    return np.abs(answers).sum(0)


def opencv_itti_koch(image: np.ndarray) -> np.ndarray:
    intensity = image.mean(-1)
    visible = intensity > intensity.max() / 10
    r, g, b = np.moveaxis(np.where(visible[..., None], image / np.maximum(intensity, 1e-12)[..., None], 0), -1, 0)
    red, green = np.maximum(r - (g + b) / 2, 0), np.maximum(g - (r + b) / 2, 0)
    blue, yellow = np.maximum(b - (r + g) / 2, 0), np.maximum((r + g) / 2 - np.abs(r - g) / 2 - b, 0)

    def pyramid(channel: np.ndarray) -> list[np.ndarray]:
        levels = [channel]
        for _ in range(8):
            levels.append(cv2.pyrDown(levels[-1]).reshape([(n + 1) // 2 for n in levels[-1].shape]))
        return levels

    def across(levels: list[np.ndarray]) -> np.ndarray:
        total = np.zeros_like(levels[4])
        for c in (2, 3, 4):
            for s in (c + 3, c + 4):
                surround = cv2.resize(levels[s], levels[c].shape[::-1], interpolation=cv2.INTER_LINEAR)
                each = numpy_promote(np.abs(levels[c] - surround))
                for _ in range(4 - c):
                    each = cv2.pyrDown(each)
                total += each
        return total

    levels = pyramid(intensity)
    angles = (0, 45, 90, 135)
    orientation = sum(numpy_promote(across([opencv_energy(level, angle) for level in levels])) for angle in angles)
    colour = across(pyramid(red - green)) + across(pyramid(blue - yellow))
    saliency = sum(numpy_promote(each) for each in (across(levels), colour, orientation)) / 3
    saliency = cv2.resize(saliency, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return (saliency - saliency.min()) / (saliency.max() - saliency.min())


def test_saliency_equals_the_steps_in_opencv(photograph: np.ndarray, dtype: torch.dtype) -> None:
    # Noise removes uniform areas, where rounding decides which pixel is a peak.
    picture = 0.2 + 0.5 * photograph + 0.3 * np.random.default_rng(0).random(photograph.shape)
    saliency = IttiKoch()(torch.from_numpy(picture).permute(2, 0, 1)[None].to(dtype))
    assert saliency.dtype == dtype
    # In single precision a peak may still appear or vanish.
    atol = 1e-6 if dtype == torch.float64 else 5e-4
    np.testing.assert_allclose(saliency[0].numpy(), opencv_itti_koch(picture), atol=atol)


@pytest.mark.parametrize("steps", [3, 10, 1000])
def test_promotion_equals_a_loop(steps: int, dtype: torch.dtype, tolerance: float) -> None:
    # With few grey levels there are plateaus: of equal neighbours only the first counts as a peak.
    maps = torch.randint(steps, (2, 3, 9, 11)).to(dtype)
    promoted = _promote(maps)
    for image, result in zip(maps.flatten(0, 1), promoted.flatten(0, 1), strict=True):
        np.testing.assert_allclose(result.numpy(), numpy_promote(image.double().numpy()), atol=tolerance)


def test_rounding_errors_are_not_promoted(dtype: torch.dtype) -> None:
    noise = 0.3 + torch.finfo(dtype).eps * torch.rand(1, 16, 16, dtype=dtype)
    assert _promote(noise).abs().max() == 0


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (2, 3), (20, 33), (64, 64)])
def test_any_size_and_uniform_images(size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> None:
    image = torch.rand(1, 3, *size, dtype=dtype, device=device)
    saliency = itti_koch_saliency(image)
    assert saliency.shape == (1, *size)
    assert torch.isfinite(saliency).all()
    for uniform in (image[..., :1, :1].expand_as(image), torch.zeros_like(image)):
        assert itti_koch_saliency(uniform).abs().max() == 0


def test_gradients_without_normalising_and_of_a_uniform_image():
    image = torch.rand(1, 3, 20, 26, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(IttiKoch(normalise=False), image, fast_mode=True)
    image = torch.full((1, 3, 40, 40), 0.5, requires_grad=True)
    itti_koch_saliency(image).sum().backward()
    assert image.grad is not None
    assert torch.isfinite(image.grad).all()


def test_bad_input() -> None:
    refused("image", IttiKoch(), torch.zeros(1, 4, 8, 8))
