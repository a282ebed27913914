"""Closer looks in a stream: they take frames of their own, their verdicts fade, and a still picture is a search."""

import math
from itertools import pairwise

import pytest
import torch
from scipy.ndimage import find_objects, label

from semfov import ActivePerception, Detections, Eye, Foveation
from semfov.belief.observers import Semantic
from semfov.decision import CandidateCells, Verifier
from semfov.detection import Candidates, Detector
from semfov.episode import Forgetting
from semfov.gaze.policies import Policy
from semfov.observation.thresholds import Thresholds
from tests.decision.test_rule import Scripted
from tests.decision.test_verifier import AT, GRID, Closer, FromScore, Told, box_of, look, step

SURE, GREY = 0.9, torch.full((3, 120, 160), 0.4)


class Spots(Detector):
    """Detects each red spot; the score for red (class 1) is its largest contrast, the rest is that for green."""

    def __init__(self) -> None:
        super().__init__("spots", ("red", "green"), (160, 120))

    def propose(self, canvas):
        red = (canvas[0, 0] - canvas[0, 1]).cpu()
        places = find_objects(label((red > 0.1).numpy())[0])
        if not places:
            return Candidates(canvas.new_zeros(1, 0, 4), canvas.new_zeros(1, 0, 2))
        boxes = [[float(x.start), float(y.start), float(x.stop), float(y.stop)] for y, x in places]
        scores = [min(float(red[place].max()), 0.95) for place in places]
        return Candidates(canvas.new_tensor([boxes]), canvas.new_tensor([[[s, 0.95 - s] for s in scores]]))


class Lasting(Scripted):
    """Scripted beliefs that no forgetting changes."""

    def fade(self, belief, look, keep, visited):
        return belief


def spots(*cells, contrast=0.8):
    """A picture with a red spot in some cells."""
    picture = GREY.clone()
    for cell in cells:
        row, column = divmod(cell, 4)
        picture[0, row * 40 + 10 : row * 40 + 30, column * 40 + 10 : column * 40 + 30] = 0.1 + contrast
        picture[1:, row * 40 + 10 : row * 40 + 30, column * 40 + 10 : column * 40 + 30] = 0.1
    return picture


def agent(observer, thresholds=AT, verification=True):
    eye = Eye(Foveation(60.0), Spots(), reference=160.0)
    model = FromScore(thresholds=thresholds) if verification else None
    search, explore = (observer, Policy("non-predictive")), (Semantic(3), Policy("random"))
    return ActivePerception(eye, search, explore, verification=model, grid=(4, 3)).eval()


def script(seed, length=12):
    """Random beliefs, most cells of which are improbable."""
    generator = torch.Generator().manual_seed(seed)
    chances = torch.rand(length, 12, generator=generator) ** 3 * (0.25 if seed % 4 == 3 else 0.9)
    return [(each.tolist(), float(each.max())) for each in chances]


def test_a_still_picture_at_rate_zero_is_searched_frame_by_frame(one_thread):
    """The same looks, closer looks and decision, to the bit; only a place that is not sure is found earlier."""
    ways = set()
    for seed in range(12):
        picture = spots(0, 5, 7, 10, contrast=(0.9, 0.72, 0.3)[seed % 3])
        searched = agent(Scripted(*script(seed))).search(picture, "red", seed=seed, closer=3)
        live = agent(Lasting(*script(seed))).live("red", rate=0, seed=seed, closer=3)
        moments = [live.step(picture) for _ in range(len(searched.cells) + len(searched.closer))]
        assert [each.number for each in moments] == list(range(len(moments)))
        plain = [each for each in moments if each.examined is None]
        assert [each.cell for each in plain] == searched.cells.tolist()
        for moment, seen in zip(plain, [each.detections for each in searched.fixated], strict=True):
            assert torch.equal(moment.seen.boxes, seen.boxes)
        closely = [each.examined for each in moments if each.examined is not None]
        for one, other in zip(closely, searched.closer, strict=True):
            assert torch.equal(one.box, other.box)
            # A moment has one look of the fovea, and a search has all of them.
            apart = {"box": None, "fixation": 0, "index": None}
            assert one.fixation == 0
            assert vars(one) | apart == vars(other) | apart
        for before, after in pairwise(moments):
            assert after.cell == before.next_cell
        assert searched.ending == "decision"
        got, expected = moments[-1].decision, searched.decision
        assert vars(got) | {"box": None} == vars(expected) | {"box": None}
        assert expected.box is None or torch.equal(got.box, expected.box)
        for moment in moments[:-1]:
            if moment.decision.outcome == "found":
                assert 0.7 <= moment.decision.place < 0.85
            else:
                assert moment.decision.outcome == "undecided"
        ways.add((expected.outcome, bool(searched.closer)))
    assert ways == {("found", True), ("absent", True), ("absent", False), ("undecided", True)}


def test_a_closer_look_takes_the_frame_of_a_look():
    """The detector runs once in each frame; the closer look is at the frame itself, and the gaze goes on after it."""
    chances = [0.02] * 12
    chances[5] = 0.6
    made = agent(Lasting((chances, 0.9)))
    passes, propose = [], made.eye.detector.propose
    made.eye.detector.propose = lambda canvas: passes.append(1) or propose(canvas)
    live = made.live("red", rate=2.5, start=5)
    first = live.step(spots(5, contrast=0.9))
    assert (first.cell, first.next_cell, first.examined) == (5, 5, None)
    assert first.decision.outcome == "undecided"
    moved = torch.roll(spots(5, contrast=0.9), 6, -1)
    moment = live.step(moved)
    assert moment.cell == 5
    torch.testing.assert_close(moment.examined.box, torch.tensor([56.0, 50, 76, 70]), atol=1.5, rtol=0)
    torch.testing.assert_close(moment.seen.boxes[0, 0], moment.examined.box)
    assert (moment.decision.outcome, moment.decision.cell) == ("found", 5)
    assert moment.decision.place == moment.examined.place > 0.75
    assert torch.equal(moment.decision.box, moment.examined.box)
    assert moment.belief is first.belief
    assert set(moment.seconds[0]) == {"detect"}
    after = live.step(moved)
    assert after.examined is None
    assert after.cell != 5
    assert after.cell == moment.next_cell
    assert after.decision.outcome == "found"
    assert len(passes) == 3


class Counted(Semantic):
    """The paper's belief, with thresholds."""

    thresholds = Thresholds(0.9, 0.01)


def test_evidence_fades_in_the_frame_of_a_closer_look_too():
    """β − β₀ is multiplied by e^(−rt) over the t seconds from a look to the next one, with a closer look in between."""
    live = agent(Counted(3, prior=0.25), Thresholds(0.99, 0.01, 0.3)).live("red", rate=5, start=5)
    first = live.step(spots(5))
    assert first.next_cell == 5
    assert live.step(GREY).examined is not None
    after = live.step(GREY)
    torch.testing.assert_close(after.belief.beta - 0.25, math.exp(-0.4) * (first.belief.beta - 0.25))
    again = live.step(GREY)
    torch.testing.assert_close(again.belief.beta - 0.25, math.exp(-0.6) * (first.belief.beta - 0.25))
    # Inhibition of return counts the seconds of this frame, too: 0.139 of them, 3.47 frames.
    assert [moment.visited[5] for moment in (after, again, live.step(GREY))] == [True, True, False]


def verifier(scores, rate, **options):
    return Verifier(Told(), CandidateCells(GRID, 1, Forgetting(rate)), AT, **options), Closer(scores)


def faded(told, here, weight):
    """The mean of log odds, written out."""
    mean = weight * math.log(told / (1 - told)) + (1 - weight) * math.log(here / (1 - here))
    return 1 / (1 + math.exp(-mean))


def test_the_verdict_fades_towards_the_belief():
    rate = 2.5
    judge, closer = verifier({5: SURE}, rate)
    judge.see(step(0, {5: 0.6}, [5], 0.5, look(5)))
    judge.wait()
    told = judge.examine(closer(judge.candidate.box))
    assert (told.place, told.presence) == (pytest.approx(0.9), pytest.approx(0.45, abs=0.5))
    assert judge.decision().place == told.place
    for number in range(1, 12):
        now, age = step(number, {5: 0.3}, [5], 0.2), number / 10
        judge.wait(0.1)
        judge.see(now)
        place = faded(told.place, 0.3, math.exp(-rate * age))
        decision = judge.decision()
        presence = faded(told.presence, 0.2, math.exp(-rate * age)) if age < math.log(2) / rate else 0.2
        assert (decision.outcome == "found") == (place >= 0.7)
        assert decision.place == (pytest.approx(place, abs=1e-5) if place >= 0.7 else None)
        assert decision.probability == pytest.approx(max(presence, place if place >= 0.7 else 0), abs=1e-5)
    assert place < 0.7


def test_a_found_target_is_followed_in_a_scene_that_changes():
    """Box and cell follow the detections; without forgetting, and without a detection, they stay."""
    for rate in (1.25, 0.0):
        judge, closer = verifier({5: SURE}, rate)
        judge.see(step(0, {5: 0.6}, [5], 0.9, look(5)))
        judge.wait()
        judge.examine(closer(judge.candidate.box))
        box = torch.tensor(box_of(5))
        for shift in (8.0, 16.0, 24.0, 32.0):
            judge.wait()
            # The detection is larger than the closer look's box, and a better one shows another class.
            wide = box + torch.tensor([shift - 3, -3.0, shift + 3, 3.0])
            other = box + torch.tensor([shift + 2, 0.0, shift + 2, 0.0])
            scores = torch.tensor([[[0.2, 0.8, 0.0], [0.0, 0.1, 0.9]]])
            now = step(
                1,
                {5: 0.6, 6: 0.6},
                [5],
                0.9,
                Detections(torch.stack([wide, other])[None], scores, torch.ones(1, 2).bool()),
            )
            judge.see(now)
        decision = judge.decision()
        expected = box + (torch.tensor([32.0, 0.0, 32.0, 0.0]) if rate else 0.0)
        torch.testing.assert_close(decision.box, expected)
        assert decision.cell == (6 if rate else 5)
        judge.wait()
        judge.see(step(2, {5: 0.6, 6: 0.6}, [5], 0.9, look(11)))
        torch.testing.assert_close(judge.decision().box, expected)


def test_a_belief_that_rises_does_not_find_a_place_that_was_dismissed():
    judge, closer = verifier({5: 0.4}, 2.5)
    judge.see(step(0, {5: 0.6}, [5], 0.9, look(5)))
    judge.wait()
    judge.examine(closer(judge.candidate.box))
    for number in range(1, 20):
        judge.wait()
        now = step(number, {5: 0.99}, [0], 0.99)
        judge.see(now)
        assert judge.decision().outcome != "found"
    assert not judge.verdicts


@pytest.mark.parametrize(("rate", "free"), [(2.5, 7), (7.5, 3), (0.0, None)])
def test_a_place_may_be_examined_again_when_half_of_the_verdict_is_left(rate, free):
    """ln 2 / 2.5 s are 6.9 frames of 25 a second, and ln 2 / 7.5 s 2.3; without forgetting never."""
    judge, closer = verifier({5: 0.4}, rate)
    examined = []
    for number in range(20):
        judge.wait()
        now = step(number, {5: 0.6}, [5], 0.9, look(5))
        if judge.candidate is None:
            judge.see(now)
        else:
            judge.examine(closer(judge.candidate.box))
            examined.append(number)
    assert examined[0] == 1
    # The place is free in this frame, which is a look; the frame after it is a closer look.
    gaps = {after - before for before, after in pairwise(examined)}
    assert gaps == (set() if free is None else {free + 1})
    assert len(judge.verdicts) <= 2


def test_a_new_verdict_replaces_the_old_one_of_the_same_place():
    judge, closer = verifier({5: SURE}, 7.5)
    judge.see(step(0, {5: 0.6}, [5], 0.9, look(5)))
    judge.wait()
    judge.examine(closer(judge.candidate.box))
    closer.scores[5] = 0.4
    for number in range(1, 4):
        judge.wait()
        now = step(number, {5: 0.95}, [5], 0.9, look(5))
        judge.see(now)
        assert judge.decision().outcome == "found"
    judge.wait()
    judge.examine(closer(judge.candidate.box))
    assert judge.decision().outcome != "found"
    assert [each.look.place for each in judge.verdicts] == [pytest.approx(0.4)]


def test_closer_looks_are_as_many_as_allowed_until_half_of_the_evidence_is_forgotten():
    for most in (1, 2):
        judge, closer = verifier(dict.fromkeys(range(12), 0.3), 2.5, most=most)
        closely = []
        for number in range(60):
            judge.wait()
            now = step(number, dict.fromkeys(range(12), 0.6), range(12), 0.9, look(*range(12)))
            closely.append(judge.candidate is not None)
            if judge.candidate is None:
                judge.see(now)
            else:
                judge.examine(closer(judge.candidate.box))
        # A closer look counts for 6 frames after its own.
        assert max(sum(closely[begin : begin + 7]) for begin in range(54)) == most
        assert sum(closely) >= 6 * most


def test_recent_detections_count_more_as_evidence():
    """Two places, equally probable: the one that was seen later is examined, unless nothing is forgotten."""
    for rate, cell in ((5, 7), (0.0, 5)):
        judge, _ = verifier({}, rate)
        judge.see(step(0, {5: 0.6, 7: 0.6}, [0], 0.9, look(5, score=0.8)))
        judge.wait()
        judge.see(step(1, {5: 0.6, 7: 0.6}, [5, 7], 0.9, look(7, score=0.75)))
        assert judge.candidate.cell == cell
        assert judge.candidate.evidence == pytest.approx(0.75 if cell == 7 else 0.8)
        assert judge.candidate.box.tolist() == box_of(cell)


def test_thresholds_are_those_of_the_verification_unless_given():
    """A belief that fades gives up at its own threshold, since it stays less certain than in a search."""

    def thresholds(**options):
        return agent(Counted(3)).live("red", **options)._episodes["fovea"].plan.thresholds

    assert thresholds(rate=0) == AT
    assert thresholds() == Thresholds(AT.confirm, Counted.thresholds.stop_below, AT.place)
    assert thresholds(confirm=0.99, stop_below=0.5) == Thresholds(0.99, 0.5, AT.place)
    assert thresholds(closer=0) == Counted.thresholds


def test_absent_is_said_when_no_cell_is_worth_a_look_and_no_place_is_left():
    judge, _ = verifier({}, 2.5)
    for cells, presence, outcome in (({9: 0.2}, 0.2, "undecided"), ({}, 0.2, "absent"), ({}, 0.6, "undecided")):
        judge.wait()
        now = step(0, cells, [0], presence, Detections.empty(1, 3))
        judge.see(now)
        assert judge.decision().outcome == outcome
