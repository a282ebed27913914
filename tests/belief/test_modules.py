"""Verification and observers as submodules of other modules."""

from functools import partial

from semfov.belief import Verification
from semfov.belief.observers import AnyOf, Semantic, SemanticMap, SemanticSearch
from tests.base_tester import GraphTester, Host, make_testers
from tests.small import GRID, detections, look, model, observing, rand, search_model


class TestVerification(GraphTester):
    batched = (0,)
    differentiable = (0,)
    autocast = 0.0

    def make(self):
        return Verification()

    def inputs(self):
        return (rand(3, 7),)


class LookTester(GraphTester):
    """Tests of a module that takes one look."""

    batched = (0, 1, 2)

    def inputs(self):
        return look()


class ObserverTester(LookTester):
    """An observer's belief about class 2 after the same detections from two fixations."""

    @staticmethod
    def call(module, scores, boxes, fixation, looks=2):
        belief, seen = module.start(len(scores), GRID, scores), detections(scores, boxes)
        for number in range(looks):
            belief = module(belief, seen, fixation + 15 * number, GRID, 2)
        return belief.probability(2)

    def traced(self):
        """Both looks have the same graph."""
        return self.host(partial(self.call, looks=1))


class TestAnyOf(ObserverTester):
    def make(self):
        return AnyOf(SemanticSearch(search_model()), {1: 0.3, 2: 1.0})

    def traced(self):
        """All classes have the same graph."""
        return Host(AnyOf(SemanticSearch(search_model()), {2: 1.0}), partial(self.call, looks=1))


class PartTester(ObserverTester):
    """An observer that is traced as a part of another one."""

    test_export = None


globals().update(
    make_testers(
        PartTester,
        {
            "SemanticSearch": lambda: SemanticSearch(search_model()),
            "SemanticMap": lambda: SemanticMap(model().requires_grad_(False)),
        },
    )
)
globals().update(
    make_testers(
        ObserverTester,
        {
            "Semantic": observing,
            "SemanticWithMisses": lambda: Semantic(4, misses=model().requires_grad_(False), memory="closest"),
            "AnyOfOneMap": lambda: AnyOf(SemanticMap(model().requires_grad_(False)), {1: 0.3, 2: 1.0}),
        },
    )
)
