"""The eye and the agent as parts of a user's modules; every public module has a tester."""

from importlib import import_module
from inspect import isabstract, isclass
from pathlib import Path

import torch
from torch import nn
from torchmetrics import Metric

from docs.api import entries
from semfov import ActivePerception, Eye, Foveation
from semfov.gaze import Policy
from tests.base_tester import BaseTester, TensorTester
from tests.small import GRID, Blobs, observing, rand


class TestEye(TensorTester):
    batched = (1,)
    test_no_rows = None  # a detector needs an image

    def make(self):
        return Eye(Foveation(9.0), Blobs(), reference=64.0)

    def inputs(self):
        return rand(1, 3, 48, 64), torch.tensor([[20.0, 30.0], [5.0, 6.0]])

    @staticmethod
    def call(module, image, fixations):
        return module(image, fixations).scores


class TestActivePerception(TensorTester):
    """The beliefs of an agent after looks at three given cells."""

    test_shapes = test_no_rows = None  # one image at a time
    on_cpu = True  # what one episode believes

    def make(self):
        strategy = (observing(), Policy("saliency", values=rand(len(GRID))))
        eye = Eye(Foveation(9.0), Blobs(), reference=64.0)
        return ActivePerception(eye, strategy, strategy, grid=(GRID.columns, GRID.rows))

    def inputs(self):
        return (rand(1, 3, 48, 64),)

    @staticmethod
    def call(module, image):
        return module.explore(image, start=5, shifts=2).probabilities


def find_testers() -> dict[str, type[BaseTester]]:
    """All testers by name."""
    found = {}
    for file in sorted(Path(__file__).parent.rglob("test_modules.py")):
        folder = file.relative_to(Path(__file__).parents[1]).with_suffix("")
        found |= vars(import_module(".".join(folder.parts)))
    return {name: thing for name, thing in found.items() if isclass(thing) and issubclass(thing, BaseTester)}


def test_every_public_module_has_a_tester():
    """Those of the API reference; metrics have no output."""
    modules = {
        name
        for things in entries().values()
        for name, thing in things
        if isclass(thing) and issubclass(thing, nn.Module) and not isabstract(thing) and not issubclass(thing, Metric)
    }
    assert modules
    assert sorted(modules - {name.removeprefix("Test") for name in find_testers()}) == []


def test_the_page_on_testing_shows_a_complete_tester():
    root = Path(__file__).parents[1]
    shown = (root / "docs/testing.md").read_text(encoding="utf-8").partition("```python\n")[2].partition("```")[0]
    assert "class TestLogPolar(GraphTester):" in shown
    assert shown in (root / "tests/sensor/test_modules.py").read_text(encoding="utf-8")
