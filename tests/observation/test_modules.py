"""Observation models as submodules of other modules."""

import torch

from semfov.observation import FoldedObservationModel, Presence
from tests.base_tester import GraphTester
from tests.small import model, rand


class TestFovealObservationModel(GraphTester):
    batched = (0, 1)
    autocast = 0.0

    def make(self):
        return model()

    def inputs(self):
        return rand(5, 6, 4).softmax(-1), rand(5, 6)


class TestFoldedObservationModel(TestFovealObservationModel):
    def make(self):
        return FoldedObservationModel(model())


class TestPresence(GraphTester):
    batched = (0,)
    differentiable = (0,)
    autocast = 0.0

    def make(self):
        return Presence(torch.tensor(-0.4), torch.tensor([0.7, 0.2]), torch.tensor([0.2, 0.5, 0.8]))

    def inputs(self):
        return (rand(5, 2),)
