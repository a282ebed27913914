import math
import re

import numpy as np
import pytest
import torch

from semfov.sensor import Foveation, foveate, laplacian_pyramid
from tests.base_tester import graphs_of
from tests.refusals import refused
from tests.small import close, draw, rand

CONVENTIONS = ("kornia", "opencv")


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize(
    ("size", "growth"),
    [
        *((size, growth) for size in ((16, 24), (17, 13), (1, 1), (1, 6)) for growth in (1.0, 2.0)),
        pytest.param((164, 171), 2.0, marks=pytest.mark.slow),
    ],
)
def test_foveation_equals_plain_loops(reference_sensor, convention, growth, size):
    image, sigma = draw(1, 2, *size), (4.0, 2.5) if max(size) < 100 else (30.0, 30.0)
    settings = {"levels": 3, "growth": growth, "convention": convention}
    for gaze in ((3.0, 5.5), (-4.0, 30.0)) if max(size) < 100 else ((100.5, 20.0),):
        result = foveate(image, torch.tensor(gaze), sigma=torch.tensor([sigma]), **settings)
        close(result[0], reference_sensor.foveate(image[0].numpy(), gaze, sigma, *settings.values()))


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("size", [(5, 1), (20, 33), (333, 257), (131, 1)])
def test_very_large_sigma_leaves_the_image_unchanged(convention, size):
    image, gaze = draw(1, 3, *size, dtype=torch.float32), torch.tensor([[100.0, 50.0]])
    for sigma in (math.inf, 1e7):
        for levels in (0, 1, 6):
            close(foveate(image, gaze, sigma=sigma, levels=levels, convention=convention), image, 1e-5)


def test_no_fixations_and_no_levels():
    image = draw(2, 3, 12, 16)
    assert foveate(image, torch.zeros(2, 0, 2), sigma=3.0).shape == (2, 0, 3, 12, 16)
    assert torch.equal(foveate(image, torch.zeros(2, 5, 2), sigma=3.0, levels=0)[:, 4], image)
    assert torch.equal(foveate(image, torch.zeros(2), sigma=3.0, levels=0), image)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("size", [(20, 27), (170, 164)])
def test_sigma_may_differ_between_images_and_axes(convention, size):
    image, gaze = draw(2, 1, *size), 20 * draw(2, 3, 2)
    sigma = torch.tensor([[4.0, 9.0], [7.0, 3.0]])
    result = foveate(image, gaze, sigma=sigma, convention=convention)
    for b in range(2):
        one = foveate(image[b : b + 1], gaze[b : b + 1], sigma=sigma[b : b + 1], convention=convention)
        close(result[b : b + 1], one)
        # If the axes of all arguments are swapped, so are those of the result.
        swapped = foveate(
            image[b : b + 1].mT, gaze[b : b + 1].flip(-1), sigma=sigma[b : b + 1].flip(-1), convention=convention
        )
        close(swapped.mT, one)
        given = sigma[b : b + 1].tolist()
        close(foveate(image[b : b + 1], gaze[b : b + 1], sigma=given, convention=convention), one)
        close(foveate(image[b : b + 1], gaze[b : b + 1], sigma=np.array(given), convention=convention), one)
    equal = foveate(image, gaze, sigma=torch.tensor([4.0, 9.0]), convention=convention)
    close(equal[1:], foveate(image[1:], gaze[1:], sigma=9.0, convention=convention))


@pytest.mark.parametrize("levels", [0, 3])
@pytest.mark.parametrize("size", [(170, 164), (163, 2)])
def test_arguments_are_not_modified(levels, size):
    given = draw(1, 3, *size), torch.tensor([[5.0, 6.0]])
    before = [t.clone() for t in given]
    with torch.no_grad():
        foveate(*given, sigma=4.0, levels=levels).add_(1)
    assert all(map(torch.equal, given, before))


@pytest.mark.parametrize("size", [(20, 27), (170, 164)])
def test_writing_to_a_view_does_not_change_other_views(size):
    bands = laplacian_pyramid(draw(1, 3, *size), 3)
    gaze = torch.tensor([[[3.0, 4.0], [9.0, 2.0]]])
    with torch.no_grad():
        first = foveate(bands, gaze, sigma=5.0)
        expected = first.clone()
        first[0, 0].zero_()
        assert torch.equal(first[0, 1], expected[0, 1])
        assert torch.equal(foveate(bands, gaze, sigma=5.0), expected)
        assert torch.equal(first[0, 1], expected[0, 1])


@pytest.mark.parametrize("levels", [0, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_many_views_are_made_in_parts(monkeypatch, dtype, levels):
    """They are those of all at once, from images and from their pyramid, in parts of one view and of two."""
    monkeypatch.setattr("semfov.sensor.lines._KEPT", 0)  # in large pages of memory
    images, gaze = draw(3, 3, 170, 164).to(dtype), 160 * draw(3, 3, 2)
    bands = laplacian_pyramid(images, levels)
    at_once = foveate(images, gaze, sigma=5.0, levels=levels)
    for together in (0, 2 * images[0].numel()):
        monkeypatch.setattr("semfov.sensor.foveation._BLOCK", together)
        for source in (images, bands):
            views = foveate(source, gaze, sigma=5.0, levels=levels)
            assert views.dtype == dtype
            assert views.is_contiguous()
            torch.testing.assert_close(views, at_once, rtol=1e-6, atol=1e-6)
        one = foveate(images, gaze[:, 0], sigma=5.0, levels=levels)
        torch.testing.assert_close(one, views[:, 0], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("size", [(6, 5), (4, 162)])
def test_gradients(convention, size):
    image = draw(1, 1, *size).requires_grad_()
    gaze = (4 * draw(1, 2, 2)).requires_grad_()
    sigma = torch.tensor([[3.0, 2.0]], dtype=torch.float64, requires_grad=True)
    growth = torch.tensor(1.7, dtype=torch.float64, requires_grad=True)

    def sensor(image, gaze, sigma, growth):
        return foveate(image, gaze, sigma=sigma, levels=3, growth=growth, convention=convention)

    assert torch.autograd.gradcheck(sensor, (image, gaze, sigma, growth), fast_mode=size[1] > 100)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("size", [(20, 27), (141, 200)])
def test_view_is_equal_with_and_without_gradients(monkeypatch, convention, size):
    """Also for one fixation, where the finest band of a large image is not computed."""
    monkeypatch.setattr("semfov.sensor.foveation._LARGE", 140)
    image, gaze = draw(2, 3, *size), 20 * draw(2, 3, 2)
    recorded = foveate(image.clone().requires_grad_(), gaze, sigma=8.0, convention=convention)
    assert recorded.requires_grad
    close(recorded.detach(), foveate(image, gaze, sigma=8.0, convention=convention))
    close(recorded[:, 1].detach(), foveate(image, gaze[:, 1], sigma=8.0, convention=convention))
    with torch.inference_mode():
        close(recorded.detach(), foveate(image, gaze, sigma=8.0, convention=convention))


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_gradients_in_single_precision(convention):
    # Single and double precision use different code for the pyramid.
    gradients = []
    for dtype in (torch.float32, torch.float64):
        image = draw(2, 3, 150, 132).to(dtype).requires_grad_()
        gaze = (100 * draw(2, 3, 2)).to(dtype).requires_grad_()
        sigma = torch.tensor([30.0, 20.0], dtype=dtype, requires_grad=True)
        foveate(image, gaze, sigma=sigma, levels=3, convention=convention).square().mean().backward()
        gradients.append([t.grad.double() / t.grad.double().norm() for t in (image, gaze, sigma)])
    for single, double in zip(*gradients, strict=True):
        close(single, double, 1e-5)


@pytest.mark.parametrize("sigma", [1e-30, 1e-3, 1e30, math.inf])
def test_views_and_gradients_are_finite_for_extreme_sigma(sigma):
    image = draw(1, 1, 20, 27, dtype=torch.float32).requires_grad_()
    gaze = torch.tensor([[[5.0, 6.0], [1e30, -1e30]]], requires_grad=True)
    result = foveate(image, gaze, sigma=sigma)
    result.sum().backward()
    assert torch.isfinite(result).all()
    assert torch.isfinite(image.grad).all()
    # For smaller sigma, distances in units of sigma overflow.
    assert sigma < 1e-3 or torch.isfinite(gaze.grad).all()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_pair_of_numbers_is_along_x_and_y_for_any_number_of_images(count):
    """As a tensor, two numbers are the widths of two images."""
    image, gaze = draw(count, 3, 21, 27), torch.tensor([9.0, 8.0])
    expected = foveate(image, gaze, sigma=torch.tensor([[4.0, 9.0]] * count))
    for pair in ((4.0, 9.0), [4, 9], (torch.tensor(4.0), torch.tensor(9.0)), (4.0, torch.tensor(9.0))):
        close(foveate(image, gaze, sigma=pair), expected)
    close(foveate(image[0], gaze, sigma=(4.0, 9.0)), expected[0])
    width = torch.tensor(9.0, requires_grad=True)
    foveate(image, gaze, sigma=(4.0, width)).square().sum().backward()
    assert width.grad.abs() > 0


def test_learnable_sigma():
    image, gaze = draw(1, 1, 24, 24, dtype=torch.float32), torch.tensor([8.0, 8.0])
    assert not Foveation(5.0)(image, gaze).requires_grad
    sensor = Foveation(5.0, learnable=True)
    sensor(image, gaze).square().mean().backward()
    assert sensor.log_sigma.grad is not None
    assert sensor.log_sigma.grad.abs() > 0


def test_dtype_and_device_follow_a_large_image(dtype, device):
    image = draw(1, 3, 170, 164, device=device)
    expected = foveate(image, torch.tensor([9.0, 8.0], device=device), sigma=6.0)
    result = foveate(image.to(dtype), torch.tensor([9, 8], device=device), sigma=6.0)
    assert result.dtype == dtype
    assert result.device.type == device.type
    torch.testing.assert_close(result, expected.to(dtype), rtol=0, atol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("size", [(48, 64), (170, 164)])
def test_a_plain_compiler_makes_one_graph_whose_constants_are_kept(convention, size):
    """One graph for each size, without the operations that lay out the bands and make the matrices of the pyramid."""
    image, gaze = draw(1, 2, *size, dtype=torch.float32), 20 * draw(1, 3, 2, dtype=torch.float32)
    sensor = Foveation(7.0, levels=2, convention=convention)
    (graph,) = graphs_of(sensor, image, gaze)
    program = torch.export.export(sensor, (image, gaze))
    close(program.module()(image, gaze), sensor(image, gaze), 1e-6)
    for traced in (graph.graph, program.graph):
        operations = {str(getattr(node.target, "__name__", node.target)) for node in traced.nodes}
        made = {name for name in operations if re.search("arange|scatter|repeat_interleave|full|linspace", name)}
        assert made == set()


@pytest.mark.slow
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_a_compiled_sensor_takes_other_sizes(convention):
    sensor = Foveation(7.0, levels=1, convention=convention)
    torch.compiler.reset()
    compiled = torch.compile(sensor, fullgraph=True, backend="eager")
    for height, width in ((40, 50), (41, 53), (60, 50)):
        image, gaze = draw(1, 2, height, width, dtype=torch.float32), torch.tensor([9.0, 8.0])
        close(compiled(image, gaze), sensor(image, gaze), 1e-6)
    with torch.no_grad():
        close(compiled(image, gaze), sensor(image, gaze), 1e-6)


def test_module_equals_the_function():
    image, gaze = draw(2, 3, 33, 40), torch.tensor([[4.0, 9.0], [30.0, 2.0]])
    sensor = Foveation(6.0, levels=3, growth=1.0, convention="opencv")
    expected = foveate(image, gaze, sigma=6.0, levels=3, growth=1.0, convention="opencv")
    close(sensor(image, gaze), expected, 1e-6)
    assert sensor.extra_repr() == "sigma=6, levels=3, growth=1, convention='opencv'"
    for setting in ({"sigma": 0.0}, {"growth": 0.0}, {"levels": -1}, {"convention": "korina"}):
        refused(next(iter(setting)), Foveation, **{"sigma": 3.0} | setting)


IMAGE = torch.rand(2, 3, 8, 8)
GAZE = torch.tensor([4.0, 4.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"image": torch.rand(2, 8, 8)}, "image: expected a picture of shape"),
        ({"levels": -1}, "levels: expected 0 or more, got -1"),
        ({"sigma": 0.0}, "sigma: expected a positive number, got 0.0"),
        ({"sigma": -0.1}, r"sigma: expected a positive number, got -0\.1$"),
        ({"sigma": math.nan}, "sigma: expected a positive number, got nan"),
        ({"sigma": torch.tensor([1.0, -1.0])}, "sigma: expected a positive number"),
        ({"sigma": (3.0, 4.0, 5.0)}, "sigma: expected a number, a pair"),
        ({"sigma": (3.0, 0.0)}, "sigma: expected a positive number"),
        ({"sigma": torch.ones(3)}, "sigma: expected a number, a pair"),
        ({"sigma": torch.ones(2, 3)}, "sigma: expected a number, a pair"),
        ({"sigma": torch.ones(2, 2, 2)}, "sigma: expected a number, a pair"),
        ({"growth": 0.0}, "growth: expected a positive number, got 0.0"),
        ({"growth": torch.tensor(-1.0)}, "growth: expected a positive number, got -1.0"),
        ({"convention": "korina"}, "unknown pyramid convention 'korina'; did you mean 'kornia'"),
    ],
)
def test_bad_input(arguments, message):
    arguments = {"image": IMAGE, "gaze": GAZE, "sigma": 3.0} | arguments
    refused(message.replace("(", r"\("), foveate, **arguments)


@pytest.mark.parametrize("name", ["sigma", "growth"])
@pytest.mark.parametrize("kind", ["parameter", "result"])
def test_settings_of_another_module_stay_in_the_graph(name, kind):
    """The gradient is that of the function, at pictures and at canvases that are scaled."""
    value = torch.nn.Parameter(torch.tensor(6.0 if name == "sigma" else 1.5))
    given = {name: value if kind == "parameter" else 2 * value / 2}
    sensor = Foveation(**{"sigma": 6.0, **given})
    image, gaze = rand(1, 3, 20, 30), torch.tensor([9.0, 5.0])
    (slope,) = torch.autograd.grad(sensor(image, gaze).square().sum(), value, retain_graph=True)
    twin = torch.tensor(float(value.detach()), requires_grad=True)
    expected = foveate(image, gaze, **{"sigma": 6.0, "growth": 2.0, name: twin}).square().sum()
    torch.testing.assert_close(slope, torch.autograd.grad(expected, twin)[0])
    opened = sensor.open(image, torch.full((2,), 1.7))
    (scaled,) = torch.autograd.grad(sensor.look(opened, gaze[None]).square().sum(), value)
    assert float(scaled) != 0
    assert (kind == "parameter") == any(each is value for each in sensor.parameters())
    assert sensor.settings()[name] == float(value.detach())
    assert f"{name}={float(value.detach()):g}" in repr(sensor)


def test_a_plain_tensor_is_a_number():
    assert float(Foveation(torch.tensor(6.0)).sigma.detach()) == pytest.approx(6.0)
    refused(r"sigma: expected a number, got shape \(2,\)", Foveation, torch.tensor([6.0, 7.0]))
    refused("learnable: expected False", Foveation, torch.nn.Parameter(torch.tensor(6.0)), learnable=True)


def test_channels_last_are_refused_and_maps_of_features_are_not():
    sensor = Foveation(20.0)
    photographs = torch.rand(2, 24, 32, 3)
    message = r"image: expected .*, got \(2, 24, 32, 3\), .* take images\.permute\(0, 3, 1, 2\)"
    refused(message, sensor, photographs, (5, 5))
    assert sensor(photographs.permute(0, 3, 1, 2), (5, 5)).shape == (2, 3, 24, 32)
    assert sensor(torch.rand(2, 24, 5, 3), (1, 1)).shape == (2, 24, 5, 3)


def test_fixations_that_look_like_shares_are_warned_of():
    sensor = Foveation(20.0)
    photograph = torch.rand(1, 3, 64, 80)
    message = r"gaze: all fixations lie in the first pixel, .* take gaze \* \(width, height\)"
    for shares in ((0.5, 0.5), torch.tensor([[[0.2, 0.9], [0.5, 0.5]]])):
        with pytest.warns(UserWarning, match=message):
            sensor(photograph, shares)
    for pixels in ((0, 0), torch.zeros(2), torch.tensor([[[0.5, 0.5], [40.0, 30.0]]]), torch.zeros(1, 0, 2)):
        sensor(photograph, pixels)
