"""Closer looks at candidates: their order, what they show, and decisions that follow them."""

from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch

from semfov import ActivePerception, Belief, Detections, Eye, Foveation, Grid, InputError
from semfov.belief import Verification
from semfov.belief.observers import Observer, Semantic
from semfov.decision import CandidateCells, Verifier
from semfov.detection import Candidates
from semfov.gaze.policies import Policy
from semfov.observation.thresholds import Thresholds
from tests.decision.test_rule import Known, Nothing, Scripted, Square, cells, random_looks
from tests.refusals import refused
from tests.small import iou

GRID = Grid(4, 3, (160, 120))
AT = Thresholds(confirm=0.7, stop_below=0.1, place=0.3)


def box_of(cell):
    """A box a little smaller than a cell."""
    row, column = divmod(cell, 4)
    return [column * 40 + 4.0, row * 40 + 4.0, column * 40 + 36.0, row * 40 + 36.0]


def look(*cells, score=0.8):
    """One look with a detection of class 1 in each of some cells."""
    boxes = torch.tensor([[box_of(cell) for cell in cells]]).view(1, len(cells), 4)
    scores = torch.tensor([1 - score, score, 0.0]).expand(1, len(cells), 3)
    return Detections(boxes, scores, torch.ones(1, len(cells), dtype=torch.bool))


def step(shift, chances, visited, presence, detections=None):
    """A step of one search: probabilities by cell, all others 0.02."""
    cells = torch.full((1, 12), 0.02)
    for cell, chance in chances.items():
        cells[0, cell] = chance
    seen = torch.zeros(1, 12, dtype=torch.bool)
    seen[0, list(visited)] = True
    belief = Known(cells, torch.tensor([presence]), cells)
    return SimpleNamespace(
        shift=shift,
        cell=torch.tensor([list(visited)[-1]]),
        belief=belief,
        visited=seen,
        detections=look() if detections is None else detections,
    )


class Told(Verification):
    """Gives the probability that closer looks have as their highest score of class 1, whatever else is seen."""

    def forward(self, features):
        return torch.stack([features[..., 6], features[..., 6] / 2], -1)


class FromScore(Verification):
    """Gives the score of the target in the closer look as the probability of the place, and of presence."""

    def forward(self, features):
        return torch.stack([features[..., 6], features[..., 6]], -1)


class Closer:
    """Closer looks with given scores by cell; remembers which cells were examined."""

    def __init__(self, scores):
        self.scores, self.cells = scores, []

    def __call__(self, box):
        cell = int(GRID.footprint(box[None], "soft")[0].argmax())
        self.cells.append(cell)
        score = self.scores[cell]
        return Detections(box[None, None], torch.tensor([[[1 - score, score, 0.0]]]), torch.ones(1, 1).bool())


def verifier(scores, **options):
    return Verifier(Told(), CandidateCells(GRID, 1), options.pop("thresholds", AT), **options), Closer(scores)


def outcome_after(judge, look, closer):
    """The outcome after a look and the closer looks that are due then."""
    judge.see(look)
    judge.look_closely(closer)
    return judge.outcome()


def decision_at_the_end(judge, closer):
    """The decision after the closer looks that are due when no other look follows."""
    judge.end()
    judge.look_closely(closer)
    return judge.final_decision()


def test_a_sure_closer_look_ends_the_search_with_its_place():
    judge, closer = verifier({5: 0.9})
    assert (
        outcome_after(judge, step(0, {5: 0.6}, [0], 0.9, look(5)), closer) == 0
    )  # the most probable cell was not fixated
    assert closer.cells == []
    last = step(1, {5: 0.6}, [0, 5], 0.9, look(5))
    assert outcome_after(judge, last, closer) == 1
    decision = decision_at_the_end(judge, closer)
    assert (decision.outcome, decision.cell, closer.cells) == ("found", 5, [5])
    assert decision.place == pytest.approx(0.9)
    assert decision.box.tolist() == box_of(5)
    assert decision.probability >= decision.place


def test_between_confirm_and_sure_the_search_goes_on_and_takes_the_best_place():
    judge, closer = verifier({5: 0.75, 7: 0.8, 2: 0.4}, most=3)
    assert outcome_after(judge, step(0, {5: 0.6, 7: 0.4, 2: 0.35}, [5], 0.9, look(5, 7, 2)), closer) == 0
    assert closer.cells == [5]  # the next best cell was not fixated
    last = step(1, {5: 0.6, 7: 0.5, 2: 0.45}, [5, 7, 2], 0.9)
    assert outcome_after(judge, last, closer) == 1  # after two closer looks no third one is needed
    assert closer.cells == [5, 7]
    decision = decision_at_the_end(judge, closer)
    assert (decision.cell, decision.outcome) == (7, "found")
    assert [each.place for each in judge.looks] == pytest.approx([0.75, 0.8])
    assert [each.fixation for each in judge.looks] == [0, 1]


@pytest.mark.parametrize(("presence", "outcome"), [(0.9, "undecided"), (0.1, "absent")])
def test_without_a_confirmed_place_the_presence_decides(presence, outcome):
    judge, closer = verifier({5: 0.01 if presence < 0.5 else 0.6})
    last = step(0, {5: 0.6}, [5], presence, look(5))
    # No other cell is worth a look.
    assert outcome_after(judge, last, closer) > 1
    assert closer.cells == [5]
    decision = decision_at_the_end(judge, closer)
    assert decision.outcome == outcome
    assert (decision.cell, decision.box, decision.place) == (None, None, None)
    assert decision.probability == pytest.approx(judge.looks[0].presence)


def test_what_is_probable_enough_is_examined_even_if_not_fixated():
    judge, closer = verifier({9: 0.95}, thresholds=Thresholds(0.7, 0.5, 0.3))
    last = step(0, {9: 0.4, 3: 0.2}, [0], 0.6, look(9, 3))
    assert outcome_after(judge, last, closer) == 1
    assert closer.cells == [9]
    assert decision_at_the_end(judge, closer).cell == 9
    judge, closer = verifier({9: 0.95}, thresholds=Thresholds(0.7, 0.5, 0.41))
    last = step(0, {9: 0.4}, [9], 0.6, look(9))
    assert outcome_after(judge, last, closer) > 1
    assert closer.cells == []
    assert decision_at_the_end(judge, closer).probability == pytest.approx(0.6)


def test_as_many_closer_looks_as_are_allowed_are_made_also_when_the_shifts_are_spent():
    judge, closer = verifier({5: 0.6, 7: 0.75})
    last = step(0, {5: 0.5, 7: 0.4}, [5], 0.8, look(5, 7))
    assert outcome_after(judge, last, closer) == 0
    assert closer.cells == [5]
    assert decision_at_the_end(judge, closer).cell == 7
    assert closer.cells == [5, 7]
    for most in (1, 2):
        judge, closer = verifier({5: 0.1, 7: 0.1, 2: 0.1}, most=most)
        assert outcome_after(judge, step(0, {5: 0.6, 7: 0.55, 2: 0.5}, [5, 7, 2], 0.9, look(5, 7, 2)), closer) > 1
        assert len(closer.cells) == most
    for most in (0, 101, 1.5):
        refused("most: expected a whole number", verifier, {}, most=most)
    refused("thresholds: expected", verifier, {}, thresholds=None)


@pytest.mark.parametrize("seed", range(3))
def test_candidates_come_in_the_order_of_a_loop(seed):
    """Cells by probability times the best score and footprint; what was examined is left out, in later looks too."""
    looks, chances = random_looks(3, 5, seed), torch.rand(12, generator=torch.Generator().manual_seed(seed))
    candidates, free, examined = CandidateCells(GRID, 2), set(range(12)), []
    probable = Known(chances[None], torch.ones(1), chances[None])

    def see(detections):
        state = {"shift": 0, "belief": probable, "visited": torch.zeros(1, 12).bool()}
        candidates.see(SimpleNamespace(**state, detections=detections))

    for number in range(2):
        see(looks[number : number + 1])
    weight = GRID.footprint(looks.boxes, "soft")
    for turn in range(4):
        if turn == 1:
            see(looks[2:])
        value, place = 0.0, None
        for cell in sorted(free):
            for one in range(2 + (turn > 0)):
                for other in range(5):
                    box = looks.boxes[one, other]
                    same = any(iou(box.tolist(), each.tolist()) >= 0.5 for each in examined)
                    if same or not looks.mask[one, other]:
                        continue
                    evidence = float(weight[one, other, cell] * looks.scores[one, other, 2])
                    if evidence * float(chances[cell]) > value * (1 + 1e-6):
                        value, place = evidence * float(chances[cell]), cell
        candidate = candidates.due(Thresholds(1.0, 0.0), last=True)
        if place is None:
            assert candidate is None
            break
        assert candidate.cell == place
        assert candidate.probability == float(chances[place])
        assert candidate.evidence * candidate.probability == pytest.approx(value)
        closer = candidate.box + 7
        candidates.dismiss(candidate, closer)
        covered = GRID.footprint(torch.stack([candidate.box, closer]), "soft").amax(0)
        free -= {cell for cell in range(12) if cell == place or float(covered[cell]) >= 0.5}
        examined += [candidate.box, closer]
    probable = Known(torch.zeros(1, 12), torch.ones(1), chances[None])
    see(looks[:1])
    assert candidates.due(Thresholds(1.0, 0.0), last=True) is None


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
    looking = agent(Both((0.6, 0.1), (0.6, 0.9)), Fine(), Thresholds(confirm=0.8, stop_below=0.1, place=0.3))
    scanpath = looking.search(image, {"red": 1.0, "green": 0.9}, start=11, shifts=1)
    assert scanpath.found
    assert [scanpath.classes[look.target] for look in scanpath.closer] == ["red"]
    assert scanpath.classes[scanpath.target] == "red"
