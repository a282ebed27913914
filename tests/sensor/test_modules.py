"""Sensors as submodules of other modules."""

import copy

import pytest
import torch

from semfov.sensor import Foveation, LogPolar, MultiScaleFovea, RandomFoveation
from tests.base_tester import GraphTester, Host, TensorTester
from tests.refusals import refused
from tests.small import close, draw, rand

# Fixations off the centres of pixels, where bilinear interpolation has no derivative.
GAZES = torch.tensor([[20.3, 30.1], [45.7, 9.4]])


class TestFoveation(GraphTester):
    batched = (0, 1)
    differentiable = (0, 1)

    def make(self, levels=2):
        return Foveation(9.0, levels=levels, learnable=True)

    def traced(self):
        """All levels have the same graph."""
        return Host(self.make(levels=1), self.call)

    def inputs(self):
        return rand(2, 3, 48, 64), GAZES


class TestFoveationAsOpenCV(TestFoveation):
    def make(self, levels=2):
        return Foveation(9.0, levels=levels, convention="opencv")

    def inputs(self):
        return rand(2, 3, 33, 47), GAZES


class TestLogPolar(GraphTester):
    batched = (0, 1)
    differentiable = (0, 1)

    def make(self):
        return LogPolar(9.0)

    def inputs(self):
        return rand(2, 3, 48, 64), GAZES


class TestMultiScaleFovea(TestFoveation):
    traced = GraphTester.traced

    def make(self):
        return MultiScaleFovea(16, 3)


def test_a_sensor_with_a_computed_width_is_copied_as_far_as_pytorch_copies_it():
    """An optimiser's average of weights copies modules; a tensor that was computed belongs to a graph."""
    leaf = torch.tensor(12.0, requires_grad=True)
    image = rand(1, 3, 48, 64)
    for sensor in (Foveation(leaf), Foveation(torch.nn.Parameter(leaf.detach())), Foveation(9.0, growth=leaf)):
        copied = copy.deepcopy(sensor)
        close(copied(image, GAZES[:1]), sensor(image, GAZES[:1]))
        assert copied.sigma is not sensor.sigma
        with torch.no_grad():
            copied.sigma.fill_(1.0)
        assert sensor.sigma.item() > 1
    assert [*Foveation(torch.nn.Parameter(leaf.detach())).state_dict()] == ["given_sigma", "_extra_state"]
    refused("^sigma: expected .* leaf where a sensor is copied, got one that was computed", copy.deepcopy,
            Foveation(leaf * 1))  # fmt: skip
    refused("^growth: expected .* leaf where a sensor is copied, got one that was computed", copy.deepcopy,
            torch.nn.Sequential(Foveation(5.0, growth=leaf * 1)))  # fmt: skip
    twice = torch.nn.ModuleList([Foveation(9.0)] * 2)
    first, second = copy.deepcopy(twice)
    assert first is second


of_each_sensor = pytest.mark.parametrize(
    ("sensor", "prepare"),
    [
        (Foveation(9.0, levels=2), "pyramid"),
        (Foveation(9.0, levels=2, convention="opencv"), "pyramid"),
        (LogPolar(9.0), "pyramid"),
        (MultiScaleFovea(16, 3), "means"),
    ],
)


@of_each_sensor
@pytest.mark.parametrize("size", [(20, 27), (170, 164)])
def test_many_fixations_equal_a_loop_over_them(sensor, prepare, size, device):
    """Also of an image that was prepared before."""
    image, gaze = draw(2, 3, *size, device=device), (30 * draw(2, 4, 2)).to(device)
    sensor = copy.deepcopy(sensor).double().to(device)
    many, state = sensor(image, gaze), getattr(sensor, prepare)(image)
    assert many.shape[:2] == (2, 4)
    for g in range(4):
        close(many[:, g], sensor(state, gaze[:, g]))
        close(many[1, g], sensor(image[1:], gaze[1, g])[0])


@of_each_sensor
def test_one_picture_equals_a_batch_of_one(sensor, prepare):
    """Of any common type, with one fixation or several, and row by row in `vmap`."""
    image, gaze = draw(2, 3, 20, 27), torch.tensor([[8.3, 9.1], [12.0, 4.6]], dtype=torch.float64)
    sensor = copy.deepcopy(sensor).double()
    first = sensor(image[:1], gaze[:1])[0]
    close(sensor(image[0], gaze[0]), first)
    close(sensor(getattr(sensor, prepare)(image[0]), gaze[0])[0], first)
    close(sensor(image[0], gaze), sensor(image[:1], gaze[None])[0])
    close(sensor(image[0], gaze[0].tolist()), first)
    close(torch.func.vmap(sensor)(image, gaze), sensor(image, gaze))


@of_each_sensor
def test_bytes_are_shares_of_white(sensor, prepare):
    """The same as floats, also where the sum of two bytes is no byte."""
    pixels = (255 * draw(2, 3, 20, 27)).round()
    shares = (pixels / 255).to(torch.float32)
    gaze = torch.tensor([8.0, 9.0])
    assert torch.equal(sensor(pixels.to(torch.uint8), gaze), sensor(shares, gaze))


@of_each_sensor
def test_bad_input(sensor, prepare):
    image, gaze = torch.rand(2, 3, 8, 8), torch.tensor([4.0, 4.0])
    for arguments, message in (
        ((image, gaze * torch.nan), "gaze: expected finite numbers"),
        ((image, torch.tensor([[[torch.inf, 1.0]]] * 2)), "gaze: expected finite numbers"),
        *(((image, torch.zeros(shape)), "gaze: expected") for shape in ((3,), (), (3, 2), (1, 4, 2), (1, 2, 4, 2))),
        ((image[0, 0, 0], gaze), "image: expected"),
        ((image[:, :, :0], gaze), "image: expected at least one pixel"),
        ((image[None], gaze), "image: expected a picture of shape"),
        ((tuple(image), gaze), "image: expected"),
    ):
        refused(message, sensor, *arguments)


class TestRandomFoveation(TensorTester):
    """At fixations that were drawn before."""

    batched = (0, 1, 2)

    def make(self):
        return RandomFoveation((5.0, 9.0), p=1.0)

    def inputs(self):
        return rand(2, 3, 48, 64), 40 * rand(2, 2), torch.tensor([5.0, 9.0])

    @staticmethod
    def call(module, image, gaze, sigma):
        places = {"gaze": gaze, "sigma": sigma}
        about = {"batch_prob": torch.ones(len(image)), "forward_input_shape": torch.tensor(image.shape)}
        return module(image, params=places | about)
