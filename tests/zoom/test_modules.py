"""The parts of the zooming eye as submodules of other modules."""

import torch

from semfov.agents import ZoomAgent
from semfov.settings import ExploreSettings
from semfov.zoom import GlimpseEvidence, WindowEye
from semfov.zoom.certainty import FACTS, Certainty
from tests.base_tester import BaseTester, GraphTester, TensorTester
from tests.small import Blobs, rand


class TestGlimpseEvidence(TensorTester):
    """Evidence about the presence of a class after a search."""

    batched = (0, 1)

    def make(self):
        return GlimpseEvidence(3).eval()

    def inputs(self):
        return rand(5), rand(5)

    @staticmethod
    def call(module, best, expected):
        return module.presence(best, expected)


class TestCertainty(GraphTester):
    """Probabilities of objects by facts about them, and the number of those that no look has shown."""

    def make(self):
        return Certainty(0.5, rand(len(FACTS)).tolist(), scale=0.5, strength=4.0, faint=0.25, promise=0.4)

    def inputs(self):
        return (rand(6, len(FACTS)),)

    @staticmethod
    def call(module, facts):
        mean, variance = module.unseen((5.0, 4.0), promised=25.0, discoveries=3.0)
        return module.probability(facts) * mean + variance


class TestWindowEye(BaseTester):
    """Pictures are bytes, as in files, and stay bytes."""

    on_cpu = True

    def make(self):
        return WindowEye(Blobs())

    def inputs(self):
        return (rand(3, 150, 200) * 255).byte(), torch.tensor([[90.0, 60.0, 1.0], [20.0, 100.0, 0.5]])

    @staticmethod
    def call(module, picture, fixations):
        return module(picture, fixations).scores


class TestZoomAgent(BaseTester):
    on_cpu = True

    def make(self):
        return ZoomAgent(WindowEye(Blobs()), GlimpseEvidence(3)).eval()

    def inputs(self):
        return ((rand(3, 300, 400) * 255).byte(),)

    @staticmethod
    def call(module, picture):
        return module.explore(picture, ExploreSettings(passes=3, min_gain=0.0)).candidates.boxes
