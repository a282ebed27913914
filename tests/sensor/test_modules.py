"""Sensors as submodules of other modules."""

import torch

from semfov.sensor import Foveation, Glimpse, LogPolar, MultiScaleFovea, Perspective, RandomFoveation
from tests.base_tester import GraphTester, TensorTester
from tests.small import rand

# Fixations off the centres of pixels, where bilinear interpolation has no derivative.
GAZES = torch.tensor([[20.3, 30.1], [45.7, 9.4]])


class TestFoveation(GraphTester):
    batched = (0, 1)
    differentiable = (0, 1)

    def make(self):
        return Foveation(9.0, levels=2, learnable=True)

    def inputs(self):
        return rand(2, 3, 48, 64), GAZES


class TestFoveationAsOpenCV(TestFoveation):
    def make(self):
        return Foveation(9.0, levels=2, convention="opencv")

    def inputs(self):
        return rand(2, 3, 33, 47), GAZES


class TestLogPolar(GraphTester):
    batched = (0, 1)
    differentiable = (0, 1)

    def make(self):
        return LogPolar(9.0)

    def inputs(self):
        return rand(2, 3, 48, 64), GAZES


class TestMultiScaleFovea(GraphTester):
    batched = (0, 1)
    differentiable = (0, 1)

    def make(self):
        return MultiScaleFovea(16, 3)

    def inputs(self):
        return rand(2, 3, 48, 64), GAZES


class TestPerspective(TensorTester):
    batched = (0, 1)

    def make(self):
        return Perspective((20, 16))

    def inputs(self):
        poses = torch.tensor([[30.0, 10.0, 60.0], [170.0, -80.0, 90.0]])
        return rand(2, 3, 32, 64), poses[:, None]


class TestGlimpse(TensorTester):
    batched = (0, 1, 2)

    def make(self):
        return Glimpse((32, 24))

    def inputs(self):
        return rand(2, 3, 48, 64), GAZES[:, None], torch.tensor([[0.5], [1.0]])


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
