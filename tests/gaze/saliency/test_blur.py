"""Blur and enlargement against OpenCV."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.gaze.saliency.blur import enlarge, gaussian_blur
from tests.refusals import refused


@given(st.integers(1, 150), st.integers(1, 150), st.floats(0.3, 9.0), st.sampled_from([torch.float32, torch.float64]))
def test_blur_equals_opencv(height: int, width: int, sigma: float, dtype: torch.dtype) -> None:
    image = np.random.default_rng(height * width).random((height, width, 3))
    expected = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE).reshape(image.shape)
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None].to(dtype)
    blurred = gaussian_blur(tensor, sigma)[0].permute(1, 2, 0)
    assert blurred.dtype == dtype
    np.testing.assert_allclose(blurred.numpy(), expected, atol=2e-6)
    halved = gaussian_blur(tensor, sigma, halve=True)[0].permute(1, 2, 0)
    size = (max(width // 2, 1), max(height // 2, 1))
    sampled = cv2.resize(expected, size, interpolation=cv2.INTER_NEAREST)
    np.testing.assert_allclose(halved.numpy(), sampled.reshape(*size[::-1], 3), atol=2e-6)


@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 70), st.integers(0, 70))
def test_enlargement_equals_opencv(height: int, width: int, taller: int, wider: int) -> None:
    image = np.random.default_rng(height * width).random((height, width))
    size = (height + taller, width + wider)
    expected = cv2.resize(image, size[::-1], interpolation=cv2.INTER_CUBIC)
    np.testing.assert_allclose(enlarge(torch.from_numpy(image), size).numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("size", [(200, 333), (481, 170), (24, 640)])
@pytest.mark.parametrize("halve", [False, True])
def test_blur_in_tiles_equals_opencv(size: tuple[int, int], halve: bool, dtype: torch.dtype) -> None:
    image = torch.rand(2, 3, *size, dtype=dtype)
    blurred = gaussian_blur(image, 5.5, halve=halve)
    for plane, made in zip(image.flatten(0, 1), blurred.flatten(0, 1), strict=True):
        expected = cv2.GaussianBlur(plane.double().numpy(), (0, 0), 5.5, borderType=cv2.BORDER_REPLICATE)
        if halve:
            expected = cv2.resize(expected, made.shape[::-1], interpolation=cv2.INTER_NEAREST)
        np.testing.assert_allclose(made.numpy(), expected, atol=2e-6)
    graded = gaussian_blur(image.clone().requires_grad_(), 5.5, halve=halve).detach()
    torch.testing.assert_close(graded, blurred)


def test_blur_in_tiles_compiles_and_vectorises() -> None:
    image = torch.rand(2, 3, 200, 333)

    def run(images: torch.Tensor) -> torch.Tensor:
        return gaussian_blur(images, 5.5, halve=True)

    torch.compiler.reset()
    compiled = torch.compile(run, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(image), run(image))
    torch.testing.assert_close(torch.func.vmap(run)(image[:, None])[:, 0], run(image))


@pytest.mark.parametrize(("size", "length"), [((200, 170), (90, 61)), ((190, 40), (63, 41)), ((300, 200), (450, 199))])
def test_resizing_to_other_sizes_equals_opencv(size, length, dtype):
    image = torch.rand(size, dtype=dtype)
    expected = cv2.resize(image.double().numpy(), length[::-1], interpolation=cv2.INTER_CUBIC)
    # The weights in OpenCV are in single precision.
    np.testing.assert_allclose(enlarge(image, length).numpy(), expected, atol=2e-5)


@pytest.mark.parametrize(
    ("size", "factors"), [((60, 90), (2, 4)), ((30, 21), (16, 8)), ((100, 61), (3, 7)), ((80, 170), (3, 1))]
)
def test_enlargement_in_tiles_equals_opencv(size, factors, dtype):
    image = torch.rand(size, dtype=dtype)
    height, width = size[0] * factors[0], size[1] * factors[1]
    expected = cv2.resize(image.double().numpy(), (width, height), interpolation=cv2.INTER_CUBIC)
    np.testing.assert_allclose(enlarge(image, (height, width)).numpy(), expected, atol=1e-5)
    graded = enlarge(image.clone().requires_grad_(), (height, width)).detach()
    np.testing.assert_allclose(graded.numpy(), expected, atol=1e-5)


def test_gradients_flow_through_matrices_made_in_inference_mode() -> None:
    image = torch.rand(1, 1, 21, 23)
    with torch.inference_mode():
        enlarge(gaussian_blur(image, 1.2345), (41, 47))
    image.requires_grad_()
    enlarge(gaussian_blur(image, 1.2345), (41, 47)).sum().backward()
    assert image.grad is not None
    assert image.grad.sum() == pytest.approx(41 * 47, rel=1e-5)


@pytest.mark.parametrize(("shape", "sigma"), [((3, 4), 1.0), ((1, 1, 0, 4), 1.0), ((1, 1, 4, 4), 0.0)])
def test_bad_input(shape: tuple[int, ...], sigma: float) -> None:
    refused(r"image|sigma", gaussian_blur, torch.zeros(shape), sigma)
