"""Models of saliency and the filters that they are made of, against OpenCV, SciPy and numpy."""

from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.baselines.saliency.blur import enlarge, gaussian_blur
from semfov.baselines.saliency.itti import _promote
from semfov.baselines.saliency.opponent import double_opponency, lab_colours, opponent_colours
from semfov.gaze.saliency import VOCUS2, IttiKoch, itti_koch_saliency, vocus2_saliency
from tests.lightness import lab_of
from tests.pretended import a_gpu
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


def plain_lab(pixels: np.ndarray) -> np.ndarray:
    return lab_of(pixels) / (100, 255, 255)


def test_lab(dtype: torch.dtype) -> None:
    pixels = np.random.default_rng(0).random((20, 30, 3))
    # Black, white and dark greys, where another branch of the formula applies.
    pixels[0, :4] = np.array([0.0, 1.0, 0.001, 0.02])[:, None]
    channels = lab_colours(torch.from_numpy(pixels).permute(2, 0, 1)[None].to(dtype))
    assert channels.dtype == dtype
    result = channels[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(result, plain_lab(pixels), atol=2e-6)
    # The program of VOCUS2's authors uses OpenCV's 8-bit values, with an offset.
    coded = cv2.cvtColor((255 * pixels).round().astype(np.uint8), cv2.COLOR_RGB2Lab) / 255
    np.testing.assert_allclose(result + np.array([0, 128, 128]) / 255, coded, atol=0.01)


@pytest.mark.parametrize("level", [0.0, 1e-30, 0.3, 1.0])
def test_colour_channels_of_grey_are_zero(level: float, dtype: torch.dtype) -> None:
    image = torch.full((1, 3, 4, 4), level, dtype=dtype)
    for channels in (opponent_colours(image), double_opponency(image)):
        assert torch.isfinite(channels).all()
        assert channels[:, 1:].abs().max() == 0


def test_rows_that_are_worked_on_together_change_no_bit(monkeypatch) -> None:
    image = torch.rand(2, 3, 37, 50, generator=torch.Generator().manual_seed(0))
    expected = double_opponency(image)
    monkeypatch.setattr("semfov.baselines.saliency.opponent._PIXELS", 300)
    assert torch.equal(double_opponency(image), expected)


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


def test_itti_koch_equals_the_steps_in_opencv(photograph: np.ndarray, dtype: torch.dtype) -> None:
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


def test_gradients_without_normalising_and_of_a_uniform_image():
    image = torch.rand(1, 3, 20, 26, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(IttiKoch(normalise=False), image, fast_mode=True)
    image = torch.full((1, 3, 40, 40), 0.5, requires_grad=True)
    itti_koch_saliency(image).sum().backward()
    assert image.grad is not None
    assert torch.isfinite(image.grad).all()


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
def test_vocus2_equals_the_steps_in_opencv(photograph, fusion, centre, surround, scales, dtype):
    image = torch.from_numpy(photograph).permute(2, 0, 1)[None].to(dtype)
    saliency = VOCUS2(centre, surround, scales=scales, fusion=fusion)(image)
    assert saliency.dtype == dtype
    expected = opencv_vocus2(opponents(photograph), centre, surround, scales, fusion)
    np.testing.assert_allclose(saliency[0].numpy(), expected, atol=2e-5)


def test_saliency_in_lab_equals_that_of_lab_channels(photograph: np.ndarray) -> None:
    lab = plain_lab(photograph)
    expected = opencv_vocus2(np.moveaxis(lab, -1, 0), 2.0, 6.0, 2, "mean")
    saliency = VOCUS2(color_space="lab")(torch.from_numpy(photograph).permute(2, 0, 1)[None])
    np.testing.assert_allclose(saliency[0].numpy(), expected, atol=2e-5)
    assert np.abs(expected - opencv_vocus2(opponents(photograph), 2.0, 6.0, 2, "mean")).max() > 0.05


MODELS = pytest.mark.parametrize(
    ("model", "settings"),
    [
        (itti_koch_saliency, [{}]),
        (vocus2_saliency, [{"fusion": "mean"}, {"fusion": "max"}]),
        (partial(vocus2_saliency, color_space="lab"), [{"fusion": "mean"}, {"fusion": "max"}]),
    ],
    ids=["itti-koch", "opponent", "lab"],
)


@MODELS
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (2, 3), (7, 5), (20, 33), (64, 64), (33, 200)])
def test_any_size_and_uniform_images(size, model, settings, dtype):
    check_any_size_and_uniform_images(model, settings, torch.rand(1, 3, *size, dtype=dtype))


@MODELS
@pytest.mark.parametrize("size", [(1, 1), (33, 200)])
def test_any_size_and_uniform_images_on_cuda(size, model, settings):
    with a_gpu():
        check_any_size_and_uniform_images(model, settings, torch.rand(1, 3, *size, device="cuda"))


def check_any_size_and_uniform_images(model, settings, image):
    saliency = model(image)
    assert saliency.shape == (1, *image.shape[-2:])
    assert torch.isfinite(saliency).all()
    for each in settings:
        for uniform in (image[..., :1, :1].expand_as(image), torch.zeros_like(image)):
            assert model(uniform, **each).abs().max() == 0


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


COLOURS = (opponent_colours, double_opponency, lab_colours)


@pytest.mark.parametrize(
    ("calls", "shapes"),
    [
        (COLOURS, [(3, 4, 4), (1, 1, 4, 4), (1, 1, 3, 4, 4), (1, 3, 0, 4)]),
        ((gaussian_blur,), [(3, 4), (1, 1, 0, 4)]),
        ((IttiKoch(), VOCUS2()), [(1, 4, 8, 8), (2, 3, 8, 8, 8), (1, 3, 0, 8)]),
    ],
    ids=["colours", "blur", "models"],
)
def test_what_is_no_image_is_refused(calls, shapes):
    for call in calls:
        for image in map(torch.zeros, shapes):
            refused("image", call, image, **({"sigma": 1.0} if call is gaussian_blur else {}))
        if call in COLOURS:
            refused("image: expected", call, torch.zeros(1, 3, 4, 4, dtype=torch.uint8))
    refused("sigma", gaussian_blur, torch.zeros(1, 1, 4, 4), 0.0)
