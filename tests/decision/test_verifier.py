"""The verifier: closer looks of searches with known beliefs, step by step."""

from types import SimpleNamespace

import pytest
import torch

from semfov import Detections, Grid
from semfov.belief import Verification
from semfov.belief.target_evidence import Thresholds
from semfov.decision import CandidateCells, Verifier
from tests.decision.test_rule import Known, random_looks
from tests.refusals import refused
from tests.small import iou

GRID = Grid(4, 3, (160, 120))
AT = Thresholds(confirm=0.7, give_up=0.1, place=0.3)


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
    closer = Closer(scores)
    return Verifier(Told(), CandidateCells(GRID, 1), closer, options.pop("thresholds", AT), **options), closer


def test_a_sure_closer_look_ends_the_search_with_its_place():
    judge, closer = verifier({5: 0.9})
    assert int(judge(step(0, {5: 0.6}, [0], 0.9, look(5)))) == 0  # the most probable cell was not fixated
    assert closer.cells == []
    last = step(1, {5: 0.6}, [0, 5], 0.9, look(5))
    assert int(judge(last)) == 1
    decision = judge.conclude()
    assert (decision.outcome, decision.cell, closer.cells) == ("found", 5, [5])
    assert decision.place == pytest.approx(0.9)
    assert decision.box.tolist() == box_of(5)
    assert decision.probability >= decision.place


def test_between_confirm_and_sure_the_search_goes_on_and_takes_the_best_place():
    judge, closer = verifier({5: 0.75, 7: 0.8, 2: 0.4}, most=3)
    assert int(judge(step(0, {5: 0.6, 7: 0.4, 2: 0.35}, [5], 0.9, look(5, 7, 2)))) == 0
    assert closer.cells == [5]  # the next best cell was not fixated
    last = step(1, {5: 0.6, 7: 0.5, 2: 0.45}, [5, 7, 2], 0.9)
    assert int(judge(last)) == 1  # after two closer looks no third one is needed
    assert closer.cells == [5, 7]
    decision = judge.conclude()
    assert (decision.cell, decision.outcome) == (7, "found")
    assert [each.place for each in judge.looks] == pytest.approx([0.75, 0.8])
    assert [each.fixation for each in judge.looks] == [0, 1]


@pytest.mark.parametrize(("presence", "outcome"), [(0.9, "undecided"), (0.1, "absent")])
def test_without_a_confirmed_place_the_presence_decides(presence, outcome):
    judge, closer = verifier({5: 0.01 if presence < 0.5 else 0.6})
    last = step(0, {5: 0.6}, [5], presence, look(5))
    # No other cell is worth a look.
    assert int(judge(last)) > 1
    assert closer.cells == [5]
    decision = judge.conclude()
    assert decision.outcome == outcome
    assert (decision.cell, decision.box, decision.place) == (None, None, None)
    assert decision.probability == pytest.approx(judge.looks[0].presence)


def test_what_is_probable_enough_is_examined_even_if_not_fixated():
    judge, closer = verifier({9: 0.95}, thresholds=Thresholds(0.7, 0.5, 0.3))
    last = step(0, {9: 0.4, 3: 0.2}, [0], 0.6, look(9, 3))
    assert int(judge(last)) == 1
    assert closer.cells == [9]
    assert judge.conclude().cell == 9
    judge, closer = verifier({9: 0.95}, thresholds=Thresholds(0.7, 0.5, 0.41))
    last = step(0, {9: 0.4}, [9], 0.6, look(9))
    assert int(judge(last)) > 1
    assert closer.cells == []
    assert judge.conclude().probability == pytest.approx(0.6)


def test_when_the_shifts_are_spent_what_is_left_of_closer_looks_is_made():
    judge, closer = verifier({5: 0.6, 7: 0.75})
    last = step(0, {5: 0.5, 7: 0.4}, [5], 0.8, look(5, 7))
    assert int(judge(last)) == 0
    assert closer.cells == [5]
    assert judge.conclude().cell == 7
    assert closer.cells == [5, 7]


def test_as_many_closer_looks_as_are_allowed():
    for most in (1, 2):
        judge, closer = verifier({5: 0.1, 7: 0.1, 2: 0.1}, most=most)
        assert int(judge(step(0, {5: 0.6, 7: 0.55, 2: 0.5}, [5, 7, 2], 0.9, look(5, 7, 2)))) > 1
        assert len(closer.cells) == most


def test_a_wrong_setting_is_named():
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
        candidate = candidates.due(0.0, last=True)
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
    assert candidates.due(0.0, last=True) is None
