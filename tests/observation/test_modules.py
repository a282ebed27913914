"""Observation models as submodules of other modules."""

from semfov.observation import FoldedObservationModel
from tests.base_tester import GraphTester
from tests.small import model, rand


class TestFovealObservationModel(GraphTester):
    batched = (0, 1)
    # Logarithms of small scores are multiplied by large parameters.
    autocast = 0.05

    def make(self):
        return model()

    def inputs(self):
        return rand(5, 6, 4).softmax(-1), rand(5, 6)


class TestFoldedObservationModel(TestFovealObservationModel):
    def make(self):
        return FoldedObservationModel(model())
