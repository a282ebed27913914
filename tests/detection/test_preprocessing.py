"""What becomes of a picture on its way to a canvas: its place, its size, and its values."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from semfov.detection import letterbox
from semfov.detection.placement import resize
from semfov.detection.preprocessing import Preprocessing
from tests.refusals import refused


def by_the_formula(unit, channels, scale, mean, std):
    column = (slice(None), None, None)
    return ((unit if channels == "rgb" else unit[:, ::-1]) * scale - np.array(mean)[column]) / np.array(std)[column]


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
    expected = by_the_formula(canvas.double().numpy(), channels, scale, mean, std)
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
    expected = by_the_formula(source / 255, wanted.channels, wanted.scale, wanted.mean, wanted.std)
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


sides = st.integers(1, 90)


@given(sides, sides, st.sampled_from([None, 32]), st.booleans(), st.sampled_from([torch.float32, torch.float64]))
def test_boxes_and_points_are_mapped_to_the_canvas_and_back(width, height, stride, stretch, dtype):
    canvas, placement = letterbox(
        torch.zeros(1, 3, height, width, dtype=dtype), (64, 48), stride=stride, stretch=stretch
    )
    assert canvas.dtype == dtype
    assert placement.size == (width, height)
    image = torch.tensor([[0.0, 0.0, width, height], [0.3 * width, 0.1 * height, 0.9 * width, 0.8 * height]]).to(dtype)
    scale, offset = torch.tensor(placement.scale * 2).to(dtype), torch.tensor(placement.offset * 2).to(dtype)
    torch.testing.assert_close(placement.boxes_to_image(image * scale + offset), image, atol=1e-3, rtol=1e-5)
    # A point is the centre of a pixel, half a pixel from its edges, both in the image and on the canvas.
    points = torch.rand(5, 2, dtype=dtype) * torch.tensor([width, height])
    there = placement.points_to_canvas(points)
    box = torch.cat([there + 0.5, there + 0.5], -1)
    back = placement.boxes_to_image(box)[:, :2] - 0.5
    inside = ((points + 0.5 >= 0) & (points + 0.5 <= torch.tensor([width, height]))).all(-1)
    torch.testing.assert_close(back[inside], points[inside], atol=1e-3, rtol=1e-5)


@given(sides, sides, st.sampled_from([None, 32]))
def test_the_image_is_at_the_place_given_by_the_placement(width, height, stride):
    canvas, placement = letterbox(torch.ones(1, 1, height, width), (64, 64), fill=0.25, stride=stride)
    bright = canvas[0, 0] > 0.99
    rows, columns = bright.nonzero(as_tuple=True)
    left, top = placement.offset
    inner = (placement.scale[0] * width, placement.scale[1] * height)
    assert (int(columns.min()), int(rows.min())) == (left, top)
    assert (int(columns.max()) + 1 - left, int(rows.max()) + 1 - top) == pytest.approx(inner)
    assert bool((canvas[0, 0][~bright] == 0.25).all())
    cut_out = placement.cut_out(canvas)
    assert cut_out.numel() == bright.sum()
    assert bool((cut_out > 0.99).all())
    if stride is None:
        assert canvas.shape[-2:] == (64, 64)
    else:
        assert all(side % stride == 0 for side in canvas.shape[-2:])


def test_resize_equals_bilinear_opencv_down_to_half_the_size_and_pillow_below():
    for size in [(37, 29), (60, 45), (100, 81)]:
        image = np.random.default_rng(0).random((58, 74, 3), dtype=np.float32)
        expected = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
        actual = resize(torch.from_numpy(image).permute(2, 0, 1)[None], size)[0].permute(1, 2, 0)
        np.testing.assert_allclose(actual.numpy(), expected, atol=1e-5)
    for size in [(36, 58), (74, 20), (30, 7), (1, 1)]:
        # Bilinear resizing in Pillow has antialiasing.
        image = np.random.default_rng(0).random((58, 74), dtype=np.float32)
        expected = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR))
        actual = resize(torch.from_numpy(image)[None, None], size)[0, 0]
        np.testing.assert_allclose(actual.numpy(), expected, atol=1e-5)


def test_resize_to_the_same_size_is_a_copy_and_letterbox_is_differentiable():
    image = torch.rand(1, 3, 8, 8)
    canvas = resize(image, (8, 8))
    canvas.zero_()
    assert image.any()
    image = torch.rand(1, 1, 5, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: letterbox(x, (9, 9))[0], (image,))


@pytest.mark.parametrize("size", [(700, 500), (300, 200)])
def test_resize_is_reproducible_on_one_thread_and_agrees_on_two(size, threads):
    image = torch.rand(1, 3, 480, 640)
    (one, again), (two, _) = [[resize(image, size) for _ in range(2)] for _ in threads()]
    assert torch.equal(one, again)
    torch.testing.assert_close(two, one, atol=5e-5, rtol=0)


def test_refuses_what_is_no_batch_of_images():
    refused("floating-point pixels", letterbox, torch.zeros(1, 3, 8, 8, dtype=torch.uint8), (32, 32))
    refused("image", letterbox, torch.zeros(3, 8, 8), (32, 32))
    refused("image", letterbox, torch.zeros(1, 3, 0, 8), (32, 32))
