"""Searches with closer looks: what an eye sees closely, and the decisions of an agent that looks closely."""

from dataclasses import dataclass

import pytest
import torch

from semfov import ActivePerception, Belief, Eye, Foveation, InputError
from semfov.belief.observers import Observer, Semantic
from semfov.belief.target_evidence import Thresholds
from semfov.detection import Candidates
from semfov.gaze.policies import Policy
from tests.decision.test_rule import Nothing, Scripted, Square, cells
from tests.decision.test_verifier import AT, FromScore
from tests.refusals import refused


class Fine(Square):
    """Detects red that is at least 30 pixels wide on the canvas as class 1, and smaller red as class 2."""

    def propose(self, canvas):
        found = super().propose(canvas)
        if found.boxes.numel() and float(found.boxes[0, 0, 2] - found.boxes[0, 0, 0]) < 30:
            return Candidates(found.boxes, found.classes.flip(-1))
        return found


def agent(observer, detector=None, thresholds=AT):
    eye = Eye(Foveation(200.0), detector or Square(), reference=160.0)
    verification = FromScore(thresholds=thresholds)
    search, explore = (observer, Policy("non-predictive")), (Semantic(3), Policy("random"))
    return ActivePerception(eye, search, explore, verification=verification, grid=(4, 3)).eval()


@pytest.mark.parametrize("box", [(130.0, 90, 150, 110), (125.0, 95, 140, 118), (110.0, 60, 160, 120)])
def test_boxes_of_a_closer_look_are_in_pixels_of_the_image(image, box):
    seen = agent(Scripted((cells(), 0.5))).eye.close_up(image[None], torch.tensor(box))
    assert seen.count.tolist() == [1]
    torch.testing.assert_close(seen.boxes[0, 0], torch.tensor([130.0, 90, 150, 110]), atol=1.0, rtol=0)


def test_a_closer_look_shows_more_than_the_whole_image_to_one_box_of_one_image(image):
    eye = Eye(Foveation(200.0), Fine(), reference=160.0)
    whole = eye.detector(image[None])
    close = eye.close_up(image[None], whole.boxes[0, 0])
    assert (int(whole.labels[0, 0]), int(close.labels[0, 0])) == (2, 1)
    eye = Eye(Foveation(200.0), Square(), reference=160.0)
    refused("image: expected a tensor of shape", eye.close_up, image, torch.zeros(4))
    refused("box: expected a tensor of shape", eye.close_up, image[None], torch.zeros(3))


def test_the_search_ends_with_the_box_of_the_closer_look(image):
    script = [(cells(c5=0.4), 0.6), (cells(c11=0.9), 0.9), (cells(c11=0.95), 0.97)]
    looking = agent(Scripted(*script))
    scanpath = looking.search(image, "red", start=0)
    assert scanpath.cells.tolist() == [0, 5, 11]
    assert (scanpath.found, scanpath.decision.outcome, scanpath.decision.cell) == (True, "found", 11)
    torch.testing.assert_close(scanpath.decision.box, torch.tensor([130.0, 90, 150, 110]), atol=1.0, rtol=0)
    seen = looking.eye.close_up(image[None], scanpath.detections[2].boxes[0, 0])
    assert scanpath.decision.place == pytest.approx(float(seen.scores[0, 0, 1]), abs=1e-6)
    (look,) = scanpath.closer
    assert (look.fixation, look.target, look.cell) == (2, 1, 11)
    assert scanpath.describe().startswith("“red” found after 2 gaze shifts and 1 closer look (probability 0.")
    assert scanpath.why_it_ended() == "A closer look confirmed the target."


def test_what_looks_like_the_target_from_afar_is_not_found_closely(image):
    """Seen closely, the square has no score for green; the belief alone would have found it."""
    script = [(cells(c11=0.9, rest=0.05), 0.95)]
    alike = agent(Scripted(*script), Fine())
    assert alike.search(image, "green", start=11, closer=0).decision.outcome == "found"
    scanpath = alike.search(image, "green", start=11)
    assert scanpath.decision.outcome == "absent"
    assert not scanpath.found
    assert [look.place < 0.2 for look in scanpath.closer] == [True]


def test_without_closer_looks_or_without_their_model_the_belief_decides(image):
    script = [(cells(c5=0.4), 0.9), (cells(c11=0.9), 0.9), (cells(c11=0.95), 0.97)]
    made = agent(Scripted(*script))
    plain = ActivePerception(
        made.eye, (Scripted(*script), Policy("non-predictive")), (Semantic(3), Policy("random")), grid=(4, 3)
    ).eval()
    for one in (
        made.search(image, "red", start=0, closer=0),
        agent(Scripted(*script), thresholds=None).search(image, "red", start=0),
    ):
        other = plain.search(image, "red", start=0)
        assert one.cells.tolist() == other.cells.tolist()
        assert one.decision.outcome == other.decision.outcome
        assert (one.decision.place, one.closer) == (pytest.approx(0.95), ())  # of the cell, by the belief


def test_thresholds_can_be_changed_and_are_checked(image):
    script = [(cells(c11=0.9, rest=0.2), 0.9)]
    assert agent(Scripted(*script)).search(image, "red", start=11, confirm=0.99).decision.outcome != "found"
    assert agent(Scripted(*script)).search(image, "red", start=11, confirm=0.5).decision.outcome == "found"
    for wrong in (-1, 101, 0.5):
        with pytest.raises(InputError, match="closer: expected a whole number from 0 to 100"):
            agent(Scripted(*script)).search(image, "red", closer=wrong)


def test_given_boxes_end_a_search_without_closer_looks(image):
    script = [(cells(c11=0.9), 0.9)]
    boxes = [[130.0, 90, 150, 110]]
    assert agent(Scripted(*script)).search(image, "red", start=11, boxes=boxes).closer == ()


def test_the_picture_and_the_page_show_closer_looks(image):
    from semfov.report.episode import _about_data
    from semfov.viz import plot_scanpath

    scanpath = agent(Scripted((cells(c11=0.9, rest=0.05), 0.95)), Fine()).search(image, "green", start=11)
    figure = plot_scanpath(scanpath)
    (axes,) = figure.axes
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    assert "not confirmed by a closer look" in texts
    x, y = scanpath.closer[0].box[:2].tolist()
    assert (pytest.approx(x), pytest.approx(y)) in [patch.get_xy() for patch in axes.patches]
    assert "Closer look at column 3, row 2: probability 0." in _about_data(scanpath, None)["decision"]


@dataclass(frozen=True)
class Table(Belief):
    """A belief about two classes: each has its probability in the last cell, and 0.2 in the others."""

    last: tuple[float, float]
    closest: torch.Tensor

    def probability(self, target):
        return torch.tensor([[0.2] * 11 + [self.last[target - 1]]])

    def presence(self, target):
        return torch.tensor([self.last[target - 1]])

    def map(self, function):
        return Table(self.last, function(self.closest))


class Both(Observer):
    """Returns scripted beliefs about two classes, one per look."""

    def __init__(self, *script):
        super().__init__()
        self.script, self.looks = script, 0

    def start(self, batch, grid, like):
        return Table((0.5, 0.5), like.new_ones(1, len(grid)))

    def weigh(self, detections, fixation, grid, target=None):
        return Nothing(0)

    def update(self, belief, look):
        self.looks += 1
        return Table(self.script[self.looks - 1], belief.closest)


def test_a_search_for_several_classes_names_the_class_that_was_looked_at_closely(image):
    """At the end green is more probable than red, but the closer look was at red."""
    looking = agent(Both((0.6, 0.1), (0.6, 0.9)), Fine(), Thresholds(confirm=0.8, give_up=0.1, place=0.3))
    scanpath = looking.search(image, {"red": 1.0, "green": 0.9}, start=11, shifts=1)
    assert scanpath.found
    assert [scanpath.classes[look.target] for look in scanpath.closer] == ["red"]
    assert scanpath.classes[scanpath.target] == "red"
