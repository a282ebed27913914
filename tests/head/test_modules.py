"""The parts of a head as submodules of other modules."""

from functools import cache

import torch

from semfov import Eye, Foveation, HeadAgent
from semfov.belief.observers import SemanticMap, SemanticSearch
from semfov.head import ExploreGain, Panorama, PerSecond, SearchGain, Speeds
from semfov.head.belief import SceneObserver
from semfov.head.views import Views
from semfov.settings import ExploreSettings
from tests.base_tester import BaseTester
from tests.small import Blobs, detections, look, model, rand, search_model


@cache
def views():
    """All looks at a small panorama."""
    return Views(Panorama(rand(3, 60, 120), (64, 48)))


def searcher():
    """An observer of searches in the small panorama."""
    return SceneObserver(SemanticSearch(search_model().requires_grad_(False)), views())


class SceneTester(BaseTester):
    """Tests of a module that acts in its own scene, one episode at a time."""

    test_device = None  # the geometry of a scene is on the CPU; of a head, the eye alone is on a GPU

    def inputs(self):
        return tuple(each[:1] for each in look()[:2])

    @staticmethod
    def seen(observer, scores, boxes):
        """An observer's belief after a look at cell 55 of the first pose."""
        grid = views().grid
        return observer(observer.start(1, grid, scores), detections(scores, boxes), grid.centres[55][None], grid, 2)


class TestSceneObserver(SceneTester):
    def make(self):
        return searcher()

    @staticmethod
    def call(module, scores, boxes):
        return SceneTester.seen(module, scores, boxes).probability(2)


class TestSearchGain(SceneTester):
    def make(self):
        return SearchGain(views())

    @staticmethod
    def call(module, scores, boxes):
        belief = SceneTester.seen(searcher(), scores, boxes)
        return module(belief, 0, range(len(views())))


class TestExploreGain(SceneTester):
    def make(self):
        return ExploreGain(views())

    @staticmethod
    def call(module, scores, boxes):
        mapper = SceneObserver(SemanticMap(model().requires_grad_(False)), views())
        return module(SceneTester.seen(mapper, scores, boxes), 0, [0, 1])


class TestPerSecond(SceneTester):
    def make(self):
        return PerSecond(SearchGain(views()), Speeds(), 55)

    @staticmethod
    def call(module, scores, boxes):
        belief = SceneTester.seen(searcher(), scores, boxes)
        return module(belief, torch.zeros(1, len(views().grid), dtype=torch.bool))


class TestHeadAgent(BaseTester):
    on_cpu = True

    def make(self):
        return HeadAgent(Eye(Foveation(20.0), Blobs()), search_model(), model()).eval().requires_grad_(False)

    def inputs(self):
        return (rand(3, 60, 120),)

    @staticmethod
    def call(module, image):
        path = module.explore(Panorama(image, (64, 48)), ExploreSettings(passes=2))
        return path.maps.clone()  # a copy outside inference mode
