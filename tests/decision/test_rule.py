"""Decisions of searches: on constructed beliefs, against a loop, and of agents whose observers follow a script."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import ActivePerception, Belief, Detections, DirichletBelief, Eye, Foveation, Grid
from semfov.agents.fovea import _goal_cells
from semfov.belief.observers import Evidence, Observer, Semantic
from semfov.decision import Decision, decide, decision_without_closer_looks
from semfov.gaze.policies import Policy
from semfov.observation.thresholds import Thresholds
from tests.refusals import refused
from tests.small import Coloured

SIZE = (160, 120)
AT = Thresholds(0.8, 0.1)


@dataclass(frozen=True)
class Known(Belief):
    """A belief with given probabilities."""

    present: torch.Tensor
    anywhere: torch.Tensor
    closest: torch.Tensor

    def probability(self, target):
        return self.present

    def presence(self, target):
        return self.anywhere

    def map(self, function):
        return Known(function(self.present), function(self.anywhere), function(self.closest))


class Guided(Known):
    """A belief whose chance of a hit is a tenth of the probability in each cell."""

    def chance(self, target):
        return self.present / 10


def test_a_search_gives_up_by_the_chance_of_a_hit_and_thresholds_change_alone():
    """The probability of a cell given that no fixated cell holds the target."""
    stated = Known(torch.tensor([[0.7, 0.3, 0.2]]), torch.tensor([0.1]), torch.zeros(1, 3))
    visited = torch.tensor([[True, False, False]])
    assert int(decide(SimpleNamespace(belief=stated, visited=visited), 1, AT)) == 0
    guided = Guided(stated.present, stated.anywhere, stated.closest)
    assert int(decide(SimpleNamespace(belief=guided, visited=visited), 1, AT)) == 2
    assert AT.changed() == AT
    assert AT.changed(0.0, None) == Thresholds(0.0, 0.1)
    assert AT.changed(None, 0.0, 0.5) == Thresholds(0.8, 0.0, 0.5)


def test_presence_defaults_to_the_probability_of_the_most_probable_cell():
    beta = torch.tensor([[[1.0, 1.5], [8.0, 0.2], [9.0, 0.1]], [[3.0, 1.0], [8.0, 0.2], [9.0, 0.1]]])
    belief = DirichletBelief(beta)
    torch.testing.assert_close(belief.presence(1), torch.tensor([0.6, 0.25]))
    visited = torch.tensor([[True, False, False]] * 2)
    found = decide(SimpleNamespace(belief=belief, visited=visited), torch.tensor([1, 1]), AT)
    assert found.tolist() == [3, 2]


probability = st.sampled_from([0.0, 0.05, 0.1, 0.3, 0.5, 0.8, 0.9]) | st.floats(0, 1, width=32)


@st.composite
def batches(draw):
    searches, cells = draw(st.integers(1, 5)), draw(st.integers(1, 6))

    def rows(what):
        return [[draw(what) for _ in range(cells)] for _ in range(searches)]

    presence = [draw(probability) for _ in range(searches)]
    thresholds = Thresholds(draw(probability), draw(probability), draw(probability))
    return rows(probability), rows(st.booleans()), presence, thresholds


@given(batches())
def test_decisions_of_a_batch_equal_a_loop(batch):
    cells, visited, presence, thresholds = batch
    confirm, stop_below, place = thresholds.confirm, thresholds.stop_below, thresholds.place
    stated = SimpleNamespace(
        belief=Known(torch.tensor(cells).double(), torch.tensor(presence).double(), torch.zeros(())),
        visited=torch.tensor(visited),
    )
    got = decide(stated, torch.ones(len(cells), dtype=torch.long), thresholds).tolist()
    for row, outcome in enumerate(got):
        exact = torch.tensor(cells[row]).double().tolist()
        looked = max([0.0, *(value for value, seen in zip(exact, visited[row], strict=True) if seen)])
        left = [value for value, seen in zip(exact, visited[row], strict=True) if not seen]
        anywhere = float(torch.tensor(presence[row]).double())
        if anywhere >= confirm and looked >= place and looked >= 0.9 * max(exact):
            assert outcome == 1
        elif max([0.0, *left]) < stop_below:
            assert outcome == (2 if anywhere < 0.5 else 3)
        else:
            assert outcome == 0


def random_looks(count, most, seed):
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(count, most, 2, generator=generator) * 100
    boxes = torch.cat([corner, corner + 5 + torch.rand(count, most, 2, generator=generator) * 50], -1)
    scores = torch.rand(count, most, 4, generator=generator).softmax(-1)
    return Detections(boxes, scores, torch.rand(count, most, generator=generator) < 0.6)


def test_a_decision_has_no_box_where_no_detection_overlaps_the_cell():
    far = Detections(torch.tensor([[[130.0, 100, 150, 110]]]), torch.full((1, 1, 4), 0.25), torch.ones(1, 1).bool())
    masked, belief = replace(far, mask=torch.zeros(1, 1).bool()), Known(torch.zeros(1, 12), torch.ones(1), None)
    for looks, cell in (([], 0), ([Detections.empty(1, 3)], 0), ([far], 0), ([masked], 11)):
        assert decision_without_closer_looks(1, belief, looks, Grid(4, 3, SIZE), 1, cell).box is None
    assert decision_without_closer_looks(1, belief, [far], Grid(4, 3, SIZE), 1, 11).box.tolist() == [130, 100, 150, 110]


class Square(Coloured):
    """Detects the bounding box of red pixels (class 1) with a high score."""

    def __init__(self) -> None:
        super().__init__(size=SIZE, score=0.9)


@dataclass(frozen=True)
class Nothing(Evidence):
    """A look without information; the observer counts the looks."""

    count: int

    def __getitem__(self, index):
        return self

    @classmethod
    def join(cls, looks):
        return looks[0]


class Scripted(Observer):
    """Returns scripted beliefs, one per look: `(probabilities of 12 cells, presence)`; the last one is repeated."""

    by_target = True

    def __init__(self, *script, thresholds=AT):
        super().__init__()
        self.script, self.chosen, self.looks = script, thresholds, 0

    @property
    def thresholds(self):
        return self.chosen

    def start(self, batch, grid, like):
        self.looks = 0
        return Known(like.new_full((1, len(grid)), 0.5), like.new_full((1,), 0.5), like.new_ones(1, len(grid)))

    def weigh(self, detections, fixation, grid, target=None):
        return Nothing(0)

    def update(self, belief, look):
        cells, presence = self.script[min(self.looks, len(self.script) - 1)]
        self.looks += 1
        return Known(torch.tensor([cells]), torch.tensor([presence]), belief.closest)


def cells(**at):
    """Probabilities of 12 cells: 0.2 unless given."""
    return [at.get(f"c{cell}", at.get("rest", 0.2)) for cell in range(12)]


def agent(observer):
    eye = Eye(Foveation(200.0), Square(), reference=160.0)
    return ActivePerception(
        eye, (observer, Policy("non-predictive")), (Semantic(3), Policy("random")), grid=(4, 3)
    ).eval()


def test_search_ends_when_the_target_is_found(image):
    script = [(cells(c5=0.4), 0.9), (cells(c11=0.9), 0.9), (cells(c11=0.95), 0.97)]
    scanpath = agent(Scripted(*script)).search(image, "red", start=0)
    assert scanpath.cells.tolist() == [0, 5, 11]
    assert scanpath.found
    decision = scanpath.decision
    assert (decision.outcome, decision.cell) == ("found", 11)
    assert decision.probability == pytest.approx(0.97)
    torch.testing.assert_close(decision.box, torch.tensor([130.0, 90, 150, 110]), atol=6, rtol=0)
    boxes = torch.cat([seen.boxes[0] for seen in scanpath.detections])
    assert bool((boxes == decision.box).all(-1).any())
    assert scanpath.describe() == "“red” found after 2 gaze shifts (probability 0.97, 0.95 at this place)"
    # The object has the probability of its place, not that of the picture.
    assert scanpath.objects.scores[scanpath.confirmed].tolist() == pytest.approx([0.95])


def test_the_target_may_be_found_in_another_cell_than_the_last_fixation(image):
    """The most probable cell was fixated earlier than the last look, and the box may lie in another cell."""
    script = [(cells(c3=0.5), 0.3), (cells(c7=0.7), 0.9), (cells(c3=0.7), 0.9)]
    scanpath = agent(Scripted(*script)).search(image, "red", start=0)
    assert scanpath.cells.tolist() == [0, 3, 7]
    # The only box lies in the last cell of the grid.
    assert (scanpath.decision.outcome, scanpath.decision.cell) == ("found", 11)
    assert scanpath.decision.box is not None


@pytest.mark.parametrize("seed", range(3))
def test_cell_and_box_of_the_decision_equal_a_loop(seed):
    grid, looks = Grid(4, 3, SIZE), random_looks(3, 4, seed)
    parts = [looks[row : row + 1] for row in range(3)]
    known = torch.rand(1, 12, generator=torch.Generator().manual_seed(seed))
    belief = Known(known, torch.tensor([0.75]), known)
    weight = grid.footprint(looks.boxes, "soft")
    for target in (1, 2, 3):
        value = []
        for cell in range(12):
            best, expected = 0.0, None
            for look, detection in looks.mask.nonzero().tolist():
                score = float(weight[look, detection, cell] * looks.scores[look, detection, target])
                if score > best * (1 + 1e-6):
                    best, expected = score, looks.boxes[look, detection].tolist()
            made = decision_without_closer_looks(1, belief, parts, grid, target, cell)
            assert (made.cell, made.box if made.box is None else made.box.tolist()) == (cell, expected)
            value.append(float(known[0, cell]) * best)
        decision = decision_without_closer_looks(1, belief, parts, grid, target)
        assert decision.cell == value.index(max(value))
        assert torch.equal(
            decision.box, decision_without_closer_looks(1, belief, parts, grid, target, decision.cell).box
        )
    assert decision.probability == 0.75
    assert decision_without_closer_looks(2, belief, parts, grid, 2) == Decision("absent", 0.75)
    # Without detections the belief alone decides.
    made = decision_without_closer_looks(1, belief, [Detections.empty(1, 3)], grid, 2)
    assert made == Decision("found", 0.75, int(known.argmax()), None, float(known.max()))


@pytest.mark.parametrize(
    ("presence", "outcome", "words"),
    [(0.09, "absent", "not there"), (0.2, "absent", "probably not there"), (0.7, "undecided", "undecided")],
)
def test_search_gives_up_and_describes_the_outcome(image, presence, outcome, words):
    script = [(cells(c5=0.4), 0.3), (cells(rest=0.04, c5=0.6), presence)]
    scanpath = agent(Scripted(*script)).search(image, "red", start=0)
    assert scanpath.cells.tolist() == [0, 5]
    assert not scanpath.found
    assert scanpath.decision == Decision(outcome, pytest.approx(presence), confirm=AT.confirm)
    assert scanpath.describe() == f"“red” {words} after 1 gaze shift (probability {presence:.2f})"


def test_searches_decide_when_no_shifts_or_no_cells_are_left(image):
    scanpath = agent(Scripted((cells(), 0.1))).search(image, "red", start=0, shifts=4)
    assert scanpath.shifts == 4
    assert scanpath.decision == Decision("undecided", pytest.approx(0.1), confirm=AT.confirm)
    assert scanpath.describe() == "“red” undecided after 4 gaze shifts (probability 0.10)"
    # After every cell was visited, no cell is left to look at.
    scanpath = agent(Scripted((cells(), 0.1))).search(image, "red", start=0, shifts=40)
    assert sorted(scanpath.cells.tolist()) == list(range(12))
    assert scanpath.decision.outcome == "absent"
    script = [(cells(c5=0.4), 0.3), (cells(c5=0.9), 0.9)]
    scanpath = agent(Scripted(*script)).search(image, "red", start=0, shifts=1)
    assert scanpath.decision.outcome == "found"
    scanpath = agent(Scripted((cells(c0=0.9), 0.9))).search(image, "red", start=0, shifts=0)
    assert (scanpath.decision.outcome, scanpath.shifts) == ("found", 0)


def test_search_takes_thresholds_as_arguments(image):
    script = [(cells(c5=0.4), 0.3), (cells(c5=0.6), 0.6)]
    searcher = agent(Scripted(*script))
    assert searcher.search(image, "red", start=0, confirm=0.6 - 1e-6).decision.outcome == "found"
    assert searcher.search(image, "red", start=0, confirm=0.61, shifts=3).decision.outcome == "undecided"
    ended = searcher.search(image, "red", start=0, stop_below=0.41)
    assert (ended.decision.outcome, ended.shifts) == ("absent", 0)
    # Giving one threshold does not change the other.
    assert searcher.search(image, "red", start=0, stop_below=0.3, shifts=1).decision.outcome == "undecided"
    assert searcher.search(image, "red", start=0, confirm=0.5, shifts=1).decision.outcome == "found"


def test_search_with_annotated_boxes_makes_no_decision(image):
    script = [(cells(c5=0.95), 0.9), (cells(c5=0.95), 0.9), (cells(c6=0.95), 0.9)]
    boxes = torch.tensor([[85.0, 45, 90, 50]])
    scanpath = agent(Scripted(*script)).search(image, "red", start=0, boxes=boxes, shifts=1)
    assert scanpath.cells.tolist() == [0, 5]
    assert (scanpath.found, scanpath.decision) == (False, None)
    assert scanpath.describe() == "“red” not found in 1 gaze shift"
    script[1] = (cells(c6=0.3), 0.9)
    scanpath = agent(Scripted(*script)).search(image, "red", start=0, boxes=boxes)
    assert scanpath.cells.tolist() == [0, 5, 6]
    assert (scanpath.found, scanpath.decision) == (True, None)
    assert scanpath.describe() == "“red” found after 2 gaze shifts"


def test_exploration_makes_no_decision(image):
    scanpath = agent(Scripted((cells(), 0.5))).explore(image, start=0, shifts=1)
    assert scanpath.decision is None
    assert scanpath.describe() == "explored with 1 gaze shift: 1 object found"


def test_without_thresholds_a_detection_confirms_the_target(image):
    """With Kaplan's rule the score of a detection that overlaps the fixated cell confirms the target."""
    searcher = agent(Semantic(3))
    scanpath = searcher.search(image, "red", start=0)
    assert scanpath.found
    assert scanpath.decision.outcome == "found"
    assert scanpath.decision.cell == int(scanpath.cells[-1])
    goal = Grid(4, 3, SIZE).footprint(scanpath.detections[-1].boxes)[0].any(0)
    assert bool(goal[scanpath.cells[-1]])
    assert not goal[scanpath.cells[:-1]].any()
    assert scanpath.decision.probability == pytest.approx(float(scanpath.posterior[-1].max()))
    assert torch.equal(scanpath.decision.box, scanpath.detections[-1].boxes[0, 0])
    # Such a search never gives up, and finds nothing if no detection reaches the score.
    for options in ({"confirm": 0.95}, {"confirm": 0.95, "stop_below": 1.0}):
        never = searcher.search(image, "red", start=0, shifts=40, **options)
        assert len(never) == 12
        assert (never.found, never.decision.outcome) == (False, "undecided")
    assert searcher.search(image, "green", start=0, shifts=3).decision.outcome == "undecided"


def test_goal_cells_are_the_cells_that_boxes_overlap():
    grid = Grid(4, 2, (80, 40))
    assert _goal_cells([[0, 0, 20, 20], [61, 21, 80, 40]], grid, torch.zeros(())).nonzero()[:, 0].tolist() == [0, 7]
    for wrong, message in (
        ([[20, 0, 0, 20]], "x1 < x2"),
        ([0.0, 0, 20, 20], "shape"),
        (torch.rand(2, 5), "shape"),
        ([[0, 0, math.inf, 5]], "finite"),
    ):
        refused(f"boxes: .*{message}", _goal_cells, wrong, grid, torch.zeros(()))
