"""The search on one screen gives the numbers of the product, to the bit."""

import pytest
import torch

from examples.one_screen import Searcher
from semfov import ActivePerception, example

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def searcher():
    return Searcher()


@pytest.fixture(scope="module")
def agent():
    return ActivePerception.published(search="non-predictive")


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(
    ("name", "start", "outcome"), [("boat", 0, "found"), ("person", 5, "found"), ("cup", 44, "undecided")]
)
def test_the_search_on_one_screen_is_that_of_the_agent(searcher, agent, name, start, outcome):
    image = example("beach")
    target = agent.classes.index(name)
    with torch.inference_mode():
        shown = searcher.search(image, target, start)
    record = agent.search(image, name, start=start, how="fovea")
    assert [look.cell for look in shown.looks] == record.cells.tolist()
    for number, look in enumerate(shown.looks):
        assert torch.equal(look.fixation, record.fixations[number])
        assert torch.equal(look.beta / look.beta.sum(-1, keepdim=True), record.probabilities[number])
        assert torch.equal(look.detections.boxes[0], record.detections[number].boxes[0])
        assert torch.equal(look.detections.scores[0], record.detections[number].scores[0])
    assert record.decision.outcome == outcome
    assert record.decision.probability == shown.probability
    if outcome == "found":
        assert torch.equal(record.decision.box, shown.box)
    else:
        assert shown.box is None
