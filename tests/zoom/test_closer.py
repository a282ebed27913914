"""Closer looks of a search by windows, and of one in a photograph."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from semfov import Detections, WindowEye, ZoomAgent
from semfov.belief.prior import Prior
from semfov.belief.verification import Verification
from semfov.decision import OUTCOMES, CandidatePlace, CandidatePlaces, Decision, Verifier
from semfov.detection.objects import FAINTEST
from semfov.episode import Forgetting
from semfov.io.storage import read, write_file
from semfov.motion import CameraStep, Motion
from semfov.observation.matching import box_iou
from semfov.observation.thresholds import Thresholds
from semfov.settings import FindSettings, SearchSettings, StreamSettings
from semfov.zoom import GlimpseEvidence, Lattice
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.certainty import FACTS, Certainty
from semfov.zoom.closer import closer_window, look_closely
from semfov.zoom.decision import LastingAbsence
from semfov.zoom.evidence import PhotographEvidence
from semfov.zoom.looks import LiveWindowLooks, Window, WindowLook, WindowLooks
from semfov.zoom.objects import probable_objects
from semfov.zoom.places import ObjectPlaces, ObjectVerifier, SearchFacts, TargetFacts
from semfov.zoom.slices import ranked, raw, usual_slices
from tests.motion.test_camera import scene
from tests.refusals import refused, unusable
from tests.small import Coloured
from tests.zoom.test_carrying import Patches

AT = Thresholds(confirm=0.6, stop_below=0.01, place=0.2)
LATTICE = Lattice.over((1024, 768), (128, 128))


class FromScore(Verification):
    """The probability of the place is the score of the target in the closer look; that of the picture is given."""

    def __init__(self, presence=0.4, **given):
        super().__init__(**given)
        self.presence = presence

    def forward(self, features):
        return torch.stack([features[..., 6], torch.full_like(features[..., 6], self.presence).logit()], -1)


class Sized(Coloured):
    """One box around all pixels of a pure colour, whose score grows with its size up to 16 pixels."""

    def __init__(self):
        super().__init__(("red", "green", "blue"), (128, 128), fill=0.0)

    def propose(self, canvas):
        pure = (2 * canvas - canvas.sum(1, keepdim=True)).clamp(0, 1)
        found = super().propose(pure.where(pure > 0.4, torch.zeros(())))
        sides = (found.boxes[..., 2:] - found.boxes[..., :2]).amax(-1)
        return replace(found, classes=found.classes * (sides / 16).clamp(max=1)[..., None])


class Fickle(Sized):
    """Takes a small green thing for red: seen closely, from 30 pixels on, it is green."""

    def propose(self, canvas):
        found = super().propose(canvas)
        sides = (found.boxes[..., 2:] - found.boxes[..., :2]).amax(-1, keepdim=True)
        red, green, blue = found.classes.unbind(-1)
        mistaken = torch.stack([0.7 * green, torch.zeros_like(green), blue], -1)
        return replace(found, classes=torch.where((sides < 30) & (green > red)[..., None], mistaken, found.classes))


def by(fact):
    """The certainty of an object whose log odds are one of the facts about it."""
    return Certainty(0.0, tuple(float(each == fact) for each in FACTS))


def evidence(certainty=None, **thresholds):
    """An object is as probable as its score in the closest look, and the odds of the picture are their number."""
    torch.manual_seed(0)
    model = GlimpseEvidence(3, thresholds=Thresholds(0.3, 0.01), places=replace(AT, **thresholds))
    model.certainty = by("sharpest") if certainty is None else certainty
    with torch.no_grad():
        model.whole.weight.copy_(torch.tensor([[0.0, 1.0]]))
    return model.eval()


def seen(boxes, scores):
    """A look with some detections of class 1 of 2."""
    vectors = torch.tensor([[1 - score, score, 0.0] for score in scores]).view(1, -1, 3)
    found = Detections(torch.tensor(boxes).view(1, -1, 4), vectors, torch.ones(1, len(boxes), dtype=torch.bool))
    show = torch.tensor([max(scores, default=0.0), 0.0])
    return WindowLook(Window.on(LATTICE, (0, 0, 0)), found, torch.zeros(len(boxes), dtype=torch.bool), show, None)


class Scripted(WindowLooks):
    """Closer looks that show class 1 with given scores at the middle of their window, in the size asked for."""

    lattice = LATTICE

    def __init__(self, scores, side=40.0):
        self.scores, self.side, self.windows = list(scores), side, []

    def see(self, windows, *, hints=True):
        assert hints
        (window,) = windows
        self.windows.append(window)
        x, y = (window.within[0] + window.within[2]) / 2, (window.within[1] + window.within[3]) / 2
        half = self.side / 2
        return [seen([[x - half, y - half, x + half, y + half]], [self.scores.pop(0)])]


@pytest.mark.parametrize(
    "box", [(300.0, 200, 500, 260), (0.0, 0, 30, 90), (990.0, 740, 1024, 768), (5.0, 5, 1000, 700)]
)
def test_the_window_shows_the_box_with_its_surroundings_and_lies_in_the_picture(box):
    x1, y1, x2, y2 = closer_window(LATTICE, torch.tensor(box)).within
    assert 0 <= x1 <= box[0]
    assert box[2] <= x2 <= 1024
    assert 0 <= y1 <= box[1]
    assert box[3] <= y2 <= 768
    # A square of three box sides, and at most one octave closer than the last level, which shows native pixels.
    side = max(3 * max(box[2] - box[0], box[3] - box[1]), 64)
    assert (x2 - x1, y2 - y1) == pytest.approx((min(side, 1024), min(side, 768)))
    magnification = closer_window(LATTICE, torch.tensor(box)).fixation[2]
    assert magnification == pytest.approx(min(128 / (x2 - x1), 128 / (y2 - y1)))
    assert magnification <= 2 * LATTICE.magnifications[-1] + 1e-9


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("share", [None, 0.1])
def test_the_surest_object_is_looked_at_first_and_each_place_once(seed, share):
    """Of the objects that an exploration of the same looks would list; the others overlap those by half."""
    random = torch.Generator().manual_seed(seed)
    certainty = some_certainty(seed)
    facts = SearchFacts(ZoomBelief(LATTICE, evidence(certainty), 1))
    for number in range(3):
        corner = torch.rand(6, 2, generator=random) * 200
        boxes = torch.cat([corner, corner + 40 + 40 * torch.rand(6, 2, generator=random)], 1)
        look = seen(boxes.tolist(), torch.rand(6, generator=random).tolist())
        facts.add(replace(look, window=Window.overview(LATTICE) if number == 0 else Window.on(LATTICE, (1, 0, 0))))
    prior = Prior(0.5 if share is None else share, 0.5)
    places = ObjectPlaces(facts, prior=prior)
    presence = facts.presence()
    places.see(TargetFacts(look.detections, 3, presence, 0.0))
    listed, _ = probable_objects([each.look for each in facts.looks], LATTICE, 1, certainty)
    expected = []
    for box, chance in zip(listed.boxes, listed.scores.tolist(), strict=True):
        if not expected or float(box_iou(torch.stack([other for other, _ in expected]), box[None]).max()) < 0.5:
            expected.append((box, prior.at_place(chance, presence)))
    assert 3 < len(expected) < 18
    for least in (0.2, 0.5):
        # While looks are worth a pass the place has to be likely; after the last one another threshold counts.
        sure = places.due(replace(AT, place=least), last=False)
        assert (sure is not None) == (expected[0][1] >= 0.5)
    for box, probability in expected:
        place = places.due(replace(AT, place=0.0), last=True)
        assert torch.equal(place.box, box)
        assert place.probability == pytest.approx(probability, rel=1e-5)
        assert places.due(replace(AT, place=probability + 1e-6), last=True) is None
        places.dismiss(place, place.box)
    assert places.due(replace(AT, place=0.0), last=True) is None


class Listed(CandidatePlaces):
    """The boxes of the last look that were not examined, in their order, each as probable as the picture."""

    likely = 0.7
    target = 1

    def see(self, look):
        self._look = look
        self._next = look.next_index
        self.detections = look.detections
        self.presence = look.presence

    def shown_at(self, candidate):
        return None

    hit_chance = property(lambda self: self._look.hit_chance)

    def due(self, thresholds, *, last):
        boxes = self._look.detections.boxes[0]
        free = boxes[~self._are_examined(boxes)]
        if not len(free) or self.presence < (thresholds.place if last else self.likely):
            return None
        return CandidatePlace(free[0], 0.8, self.presence)

    def probability(self, look):
        return self.presence


def verifier(model, scores, most=2):
    """A verifier of the target in class 1."""
    looks = Scripted(scores)
    return Verifier(model, Listed(), AT, most), lambda box: look_closely(looks, box).detections


def look(number, presence, left, *boxes):
    """A look of a search that shows the target in some boxes with a score of 0.8."""
    return TargetFacts(seen(list(boxes), [0.8] * len(boxes)).detections, number, presence, left)


ONE, OTHER = [100.0, 100, 140, 140], [500.0, 500, 540, 540]


@pytest.mark.parametrize(
    ("scores", "over", "presence", "count", "outcome"),
    [
        ([0.9], False, 0.7, 1, "found"),  # sure
        ([0.7, 0.5], False, 0.7, 2, "found"),  # probable enough, and no further closer look is allowed
        ([0.5, 0.1], False, 0.7, 2, "undecided"),
        ([0.5, 0.1], False, 0.3, 2, "absent"),
        ([0.5, 0.1], True, 0.3, 2, "absent"),
    ],
)
def test_decisions_follow_the_closer_looks(scores, over, presence, count, outcome):
    judge, close_up = verifier(FromScore(presence), scores)
    judge.see(look(5, 0.9, 0.0 if over else 0.5, ONE, OTHER))
    made = judge.look_closely(close_up)
    assert [each.index for each in judge.looks] == list(range(5, 5 + count))
    assert [round(each.place, 4) for each in judge.looks] == scores
    assert [round(each.probability, 4) for each in made] == [0.9] * count
    assert OUTCOMES[judge.outcome()] == judge.decision_if_ended_now().outcome == outcome
    assert judge.presence == pytest.approx(presence)
    assert judge.best.place == pytest.approx(max(scores))


@pytest.mark.parametrize(
    ("scores", "outcome"), [([0.7, 0.5], 1), ([0.5, 0.1, 0.3, 0.65], 1), ([0.5, 0.1, 0.3, 0.4], 0)]
)
def test_closer_looks_go_on_until_a_place_is_probable_enough(scores, outcome):
    judge, close_up = verifier(FromScore(0.3), list(scores), most=9)
    judge.see(look(5, 0.9, 0.5, ONE, OTHER, *([x, 300.0, x + 40, 340] for x in (200.0, 700.0))))
    judge.look_closely(close_up)
    assert [round(each.place, 4) for each in judge.looks] == scores
    assert judge.outcome() == outcome


def test_improbable_places_are_examined_only_at_the_end():
    for chance, over, count in ((0.69, False, 0), (0.71, False, 2), (0.21, True, 2), (0.19, True, 0)):
        judge, close_up = verifier(FromScore(), [0.1, 0.1])
        judge.see(look(1, chance, 0.5, ONE, OTHER), last=over)
        assert len(judge.look_closely(close_up)) == count
        assert judge.outcome() == (2 if count else 0)
        assert judge.decision_if_ended_now().outcome == ("absent" if count else "undecided")


@pytest.mark.parametrize("looks", [0, 1])
def test_what_the_camera_turns_away_from_is_forgotten_and_found_anew(looks):
    """By 120 degrees and on to 360: what was at one place before is at no place then, until it is seen again."""
    lens = np.array([[600.0, 0, 120], [0, 600, 120], [0, 0, 1]])
    third = cv2.Rodrigues(np.array([0, np.radians(120), 0]))[0]
    motion = Motion(lens @ third @ np.linalg.inv(lens))
    judge, close_up = verifier(FromScore(0.7), [0.8, 0.7])
    judge.see(look(1, 0.9, 0.5, ONE))
    for _ in range(looks):
        judge.examine(close_up(judge.candidate.box))
    for _ in range(3):
        judge.follow(CameraStep(motion), (240, 240))
        assert judge.candidate is None
        assert not judge.verdicts
    judge.see(look(5, 0.9, 0.5, ONE))
    assert judge.candidate.box.tolist() == ONE


def test_a_search_looks_closely_before_it_finds(picture):
    agent = ZoomAgent(WindowEye(Sized().eval()), evidence())
    plain = agent.search(picture, "red", SearchSettings(closer=0))
    assert (plain.decision.outcome, plain.decision.place, plain.closer) == ("found", None, ())
    path = agent.search(picture, "red")
    (look,) = path.closer
    assert (path.decision.outcome, look.number) == ("found", path.passes)
    assert (look.index, path.decision.place) == (path.passes - 1, look.place)
    assert path.decision.probability == pytest.approx(max(look.place, look.presence))
    # The look is a window around the surest object of the looks before it, as soon as it is likely.
    known = [
        probable_objects(path.window_looks[:number], path.lattice, 1, by("sharpest"))[0]
        for number in range(1, path.passes)
    ]
    assert [float(objects.scores[:1].sum()) >= 0.5 for objects in known] == [*[False] * (len(known) - 1), True]
    assert path.window_looks[look.index].window == closer_window(path.lattice, known[-1].boxes[0])
    assert path.decision.box.tolist() == look.box.tolist()
    x1, y1, x2, y2 = path.decision.box.tolist()
    assert max(x1, 640) < min(x2, 672)
    assert max(y1, 320) < min(y2, 352)
    assert path.why_it_ended() == "A closer look confirmed the target."
    # It costs one of the passes: the last one goes to the place that is the most probable so far.
    short = agent.search(picture, "red", SearchSettings(passes=path.passes - 1))
    assert (short.passes, short.decision.outcome) == (path.passes - 1, "found")
    assert [look.number for look in short.closer] == [short.passes]
    assert agent.search(picture, "red", SearchSettings(passes=1)).closer == ()


def test_what_looks_like_the_target_from_afar_is_not_found_closely(picture):
    """Green squares look red until a look enlarges them beyond the magnification of the last level."""
    image = 0.03 * torch.rand(picture.shape, generator=torch.Generator().manual_seed(0))  # ground that is not blank
    image[:, 320:344, 640:664] = torch.tensor([0.0, 1, 0])[:, None, None]
    agent = ZoomAgent(WindowEye(Fickle().eval()), evidence())
    assert agent.search(image, "red", SearchSettings(closer=0)).decision.outcome == "found"
    path = agent.search(image, "red", SearchSettings(closer=1))
    assert path.decision.outcome == "absent"
    assert path.decision.box is None
    (look,) = path.closer
    assert look.place < path.looks[look.index].value
    assert path.why_it_ended() == "No closer look was sure enough."
    # As long as nothing is found the search goes on.
    looked = []
    path = agent.search(image, "red", SearchSettings(confirm=1.0, on_look=lambda record: looked.append(record.passes)))
    assert path.passes > path.closer[0].number
    assert path.decision.outcome != "found"
    assert looked == [*range(1, path.passes + 1)]


def test_the_limits_of_a_search_hold(picture):
    agent = ZoomAgent(WindowEye(Sized().eval()), evidence())
    assert len(agent.search(picture, "red", SearchSettings(confirm=1.0, closer=1)).closer) == 1
    for passes in (1, 2, 3):
        path = agent.search(picture, "red", SearchSettings(passes=passes, confirm=1.0, stop_below=0.0))
        assert path.passes <= passes


def test_evidence_without_thresholds_of_places_makes_no_closer_looks(picture):
    unfitted = evidence()
    unfitted.places = None
    expected = ZoomAgent(WindowEye(Sized().eval()), evidence()).search(picture, "red", SearchSettings(closer=0))
    path = ZoomAgent(WindowEye(Sized().eval()), unfitted).search(picture, "red")
    assert path.closer == ()
    assert path.decision.probability == expected.decision.probability
    assert [look.window for look in path.window_looks] == [look.window for look in expected.window_looks]


def some_certainty(seed):
    """A certainty with weights drawn at random, which tells objects that are there."""
    weights = 0.3 * torch.randn(len(FACTS), generator=torch.Generator().manual_seed(seed))
    return Certainty(1.0, (1.0, *weights[1:].tolist()))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("share", [None, 0.4])
def test_a_place_is_as_probable_as_the_object_that_an_exploration_lists_there(picture, seed, share):
    """Of the same looks, the closer one among them; the picture's odds are the number of all objects."""
    certainty = some_certainty(seed)
    agent = ZoomAgent(WindowEye(Sized().eval()), evidence(certainty))
    path = agent.search(picture, "red", SearchSettings(confirm=1.0, stop_below=0.0, passes=10, prior=share))
    assert path.closer
    prior = Prior(0.5 if share is None else share, 0.5)
    for look in path.closer:
        looks = path.window_looks[: look.index + 1]
        objects, _ = probable_objects(looks, path.lattice, 1, certainty)
        (number,) = (objects.boxes == look.box).all(-1).nonzero()[:, 0].tolist()
        place, count = float(objects.scores[number]), float(objects.scores.sum())
        presence = max((count + 0.001) / (1 + count + 0.001), place)
        assert look.place == pytest.approx(prior.at_place(place, presence), rel=1e-5)
        assert look.presence == pytest.approx(prior(presence), rel=1e-5)


@pytest.mark.parametrize("name", ["yolox-nano", "nanodet-plus-m-1.5x", "yolov3-tiny"])
@pytest.mark.parametrize("score", [0.2, 0.5, 0.8])
def test_a_closer_look_that_shows_nothing_lowers_the_probability_of_a_place(name, score):
    certainty = GlimpseEvidence.from_pretrained(name).certainty
    far = replace(seen([ONE], [score]), window=Window.overview(LATTICE))
    close = replace(seen([], []), window=closer_window(LATTICE, torch.tensor(ONE)))
    before, after = (probable_objects(looks, LATTICE, 1, certainty)[0] for looks in ([far], [far, close]))
    assert float(after.scores) < float(before.scores)


def test_a_place_where_looks_show_no_object_any_more_is_hardly_the_target():
    """A stream has forgotten the looks that showed the candidate when the closer look is made."""
    facts = SearchFacts(ZoomBelief(LATTICE, evidence(), 1))
    facts.add(replace(seen([[700.0, 100, 740, 140]], [0.8]), window=Window.overview(LATTICE)))
    judge = ObjectVerifier(ObjectPlaces(facts), AT, 9)
    judge.see(TargetFacts(facts.looks[0].look.detections, 1, facts.presence(), 0.0))
    facts.see([replace(seen([ONE, OTHER], [0.5, 0.3]), window=Window.overview(LATTICE))])
    look = judge.examine(Detections.empty(1, 2))
    assert look.place == pytest.approx(0.001)
    assert look.box.tolist() == [700.0, 100, 740, 140]
    assert look.presence == pytest.approx(0.801 / 1.801, rel=1e-4)


def test_the_picture_is_as_probable_as_after_all_closer_looks():
    """A closer look that has told more of it is contradicted by the one after it."""
    boxes = [ONE, OTHER, [700.0, 100, 740, 140]]
    whole = replace(seen(boxes, [0.5, 0.49, 0.5]), window=Window.overview(LATTICE))
    facts = SearchFacts(ZoomBelief(LATTICE, evidence(), 1))
    facts.add(whole)
    judge = ObjectVerifier(ObjectPlaces(facts), replace(AT, place=0.0), 2)
    judge.see(TargetFacts(whole.detections, 1, facts.presence(), 0.0))
    for score, count in ((0.3, 1.29), (0.1, 0.89)):
        box = judge.candidate.box
        close = replace(seen([box.tolist()], [score]), window=closer_window(LATTICE, box))
        facts.add(close)
        look = judge.examine(close.detections)
        assert look.presence == pytest.approx(count / (1 + count), abs=2e-3)
        assert judge.presence == pytest.approx(look.presence)
    assert [look.place for look in judge.looks] == pytest.approx([0.3, 0.1], abs=1e-4)
    assert judge.decision().outcome == "absent"


def test_a_place_of_a_stream_stays_as_probable_as_the_object_that_looks_show_there():
    """The closer look counts among them until half of its evidence has faded."""
    whole = replace(seen([ONE], [0.3]), window=Window.overview(LATTICE))
    facts = SearchFacts(ZoomBelief(LATTICE, evidence(), 1), latest=True)
    facts.add(whole)
    forgetting = Forgetting(0.25)
    judge = ObjectVerifier(ObjectPlaces(facts, forgetting), AT, 9)
    judge.see(TargetFacts(whole.detections, 1, facts.presence(), 0.0), last=True)
    close = replace(seen([ONE], [0.9]), window=closer_window(LATTICE, judge.candidate.box))
    facts.add(close)
    judge.examine(close.detections)
    judge.wait(0.9 * forgetting.span)
    judge.see(TargetFacts(whole.detections, 2, facts.presence(), 0.0))
    assert judge.decision().place == pytest.approx(0.9, abs=1e-3)
    # Without it there is what the others show.
    facts.see([whole])
    judge.see(TargetFacts(whole.detections, 3, facts.presence(), 0.0))
    left = forgetting.share_left(0.9 * forgetting.span)
    odds = left * math.log(9) + (1 - left) * math.log(3 / 7)
    assert judge.decision().place == pytest.approx(1 / (1 + math.exp(-odds)), abs=1e-3)


def found_box(shift, window):
    """The box of an object that was found at `ONE`, after a look at a window that shows it shifted to the right."""
    whole = replace(seen([ONE], [0.3]), window=Window.overview(LATTICE))
    facts = SearchFacts(ZoomBelief(LATTICE, evidence(), 1), latest=True)
    facts.add(whole)
    judge = ObjectVerifier(ObjectPlaces(facts, Forgetting(0.25)), AT, 9)
    judge.see(TargetFacts(whole.detections, 1, facts.presence(), 0.0, whole.window), last=True)
    close = replace(seen([ONE], [0.9]), window=closer_window(LATTICE, judge.candidate.box))
    facts.add(close)
    judge.examine(close.detections)
    judge.wait(0.04)
    moved = seen([[ONE[0] + shift, ONE[1], ONE[2] + shift, ONE[3]]], [0.8])
    judge.see(TargetFacts(moved.detections, 2, facts.presence(), 0.0, window))
    return (judge.decision().box - torch.tensor(ONE)).tolist()


def test_a_found_object_is_moved_by_looks_that_place_it_as_exactly():
    """Coarse looks, and windows whose border cuts it, move it only where its box fits no more."""
    width = ONE[2] - ONE[0]
    closest = LATTICE.levels - 1
    across, down = LATTICE.places(closest)
    close = [Window.on(LATTICE, (closest, x, y)) for y in range(down) for x in range(across)]
    holding, cutting = [], []
    for window in close:
        left, top, right, bottom = window.region(LATTICE)
        if top <= ONE[1] and ONE[3] <= bottom and left < ONE[2] and ONE[0] < right:
            (holding if left <= ONE[0] and ONE[2] <= right else cutting).append(window)
    a_little, far = 0.2 * width, 0.4 * width  # overlaps of .67 and .43
    for window, shift, expected in (
        (Window.overview(LATTICE), a_little, 0.0),
        (Window.overview(LATTICE), far, far),
        (holding[0], a_little, a_little),
        (cutting[0], a_little, 0.0),
        (cutting[0], far, far),
        (None, a_little, a_little),
    ):
        assert found_box(shift, window) == pytest.approx([expected, 0.0, expected, 0.0], abs=1e-3)


def still_stream(frames):
    """What a search of a stream decides of each frame of a still picture without the target, whose looks fade soon."""
    picture = np.repeat(scene(2, side=1100)[:768, :1024].mean(-1, keepdims=True) / 4 + 60, 3, -1).astype(np.uint8)
    live = ZoomAgent(WindowEye(Sized()), evidence()).stream(1, (), StreamSettings(rate=2.0, stop_below=0.35))
    return [live.step(picture).decision for _ in range(frames)]


def test_a_still_picture_that_lacks_the_target_lacks_it_from_then_on():
    """Windows are free for another look after .35 s, and a search might go on there."""
    outcomes = [decision.outcome for decision in still_stream(40)]
    first = outcomes.index("absent")
    assert 0 < first < 20
    assert set(outcomes[:first]) == {"undecided"}
    assert set(outcomes[first:]) == {"absent"}


def test_a_camera_that_turns_to_other_ground_lacks_nothing_yet():
    """`absent` is not said of what no look has covered."""
    ground = np.repeat(scene(2, side=2300)[:768].mean(-1, keepdims=True) / 4 + 60, 3, -1).astype(np.uint8)
    live = ZoomAgent(WindowEye(Sized()), evidence()).stream(1, (), StreamSettings(rate=1.0, stop_below=0.35))
    outcomes = []
    for left in (0,) * 12 + (1200,) * 2:
        moment = live.step(ground[:, left : left + 1024], pose=Motion.similarity(shift=(-left, 0)))
        outcomes.append(moment.decision.outcome)
    assert outcomes[11:] == ["absent", "undecided", "undecided"]


@pytest.mark.parametrize("scale", [2.0, 0.4])
def test_the_magnification_of_a_verdict_follows_the_zoom_of_a_camera(scale):
    """A closer look has as many pixels for the object, whatever the present frame shows it with."""
    whole = replace(seen([ONE], [0.3]), window=Window.overview(LATTICE))
    facts = SearchFacts(ZoomBelief(LATTICE, evidence(), 1), latest=True)
    facts.add(whole)
    judge = ObjectVerifier(ObjectPlaces(facts, Forgetting(0.25)), AT, 9)
    judge.see(TargetFacts(whole.detections, 1, facts.presence(), 0.0, whole.window), last=True)
    close = replace(seen([ONE], [0.9]), window=closer_window(LATTICE, judge.candidate.box))
    facts.add(close)
    judge.examine(close.detections)
    (before,) = judge.verdicts
    judge.follow(CameraStep(Motion.similarity(scale=scale)), LATTICE.size)
    (after,) = judge.verdicts
    widths = [float(verdict.look.box[2] - verdict.look.box[0]) for verdict in (before, after)]
    assert after.magnification * widths[1] == pytest.approx(before.magnification * widths[0])
    assert before.magnification == pytest.approx(close.window.fixation[2])


def test_objects_that_stay_unsure_do_not_keep_a_stream_from_other_windows():
    """Each is due again when its look has aged, and the looks that showed it age, too."""
    torch.manual_seed(0)
    model = GlimpseEvidence(2, thresholds=Thresholds(0.3, 0.01), places=Thresholds(0.97, 0.01, 0.2)).eval()
    model.certainty = Certainty(0.9, (0.0,) * len(FACTS))
    with torch.no_grad():
        model.whole.weight.copy_(torch.tensor([[0.0, 1.0]]))
    picture = np.full((768, 1024, 3), 90, np.uint8)
    for x, y in ((100, 100), (600, 120), (300, 500), (820, 560), (500, 330)):
        picture[y : y + 60, x : x + 60] = 255, 0, 0
    live = ZoomAgent(WindowEye(Patches()), model).stream(1, (), StreamSettings(rate=1.0))
    closer = 0
    for _ in range(20):
        moment = live.step(picture, passed=0.3)
        assert len(moment.looks) <= 6
        closer += moment.examined is not None
    assert 5 <= closer <= 15


ABSENT, OPEN, LIKELY = Decision("absent", 0.3), Decision("undecided", 0.4), Decision("undecided", 0.6)


@pytest.mark.parametrize(
    ("decisions", "seconds", "outcome"),
    [
        ((ABSENT,), 0.9, "absent"),
        ((ABSENT, OPEN), 0.9, "absent"),
        ((OPEN,), 0.0, "undecided"),
        ((ABSENT,), 1.1, "undecided"),  # no look of that time counts any more
        ((ABSENT, LIKELY), 0.0, "undecided"),
        ((ABSENT, Decision("found", 0.9)), 0.0, "undecided"),
    ],
)
def test_a_target_stays_absent_while_a_look_counts_unless_something_says_otherwise(decisions, seconds, outcome):
    absence = LastingAbsence(Forgetting(math.log(2)))  # looks count for a second
    for decision in decisions:
        absence.see(decision)
    absence.wait(seconds)
    assert absence.kept(OPEN) == Decision(outcome, 0.4)
    assert absence.kept(LIKELY) == LIKELY


def test_an_absence_ends_with_its_scene_and_lasts_in_no_picture():
    absence = LastingAbsence(Forgetting(1.0))
    looks = [object()]  # some are in view
    for camera, in_view, outcome in (
        (CameraStep(Motion.still()), looks, "absent"),
        (CameraStep(None), looks, "undecided"),
        (CameraStep(Motion.still()), [], "undecided"),
    ):
        absence.see(ABSENT)
        absence.follow(camera, in_view)
        assert absence.kept(OPEN).outcome == outcome
    for forgetting in (None, Forgetting()):
        absence = LastingAbsence(forgetting)
        absence.see(ABSENT)
        assert absence.kept(OPEN) == OPEN


def test_thresholds_of_places_are_saved_with_the_evidence(tmp_path):
    torch.manual_seed(0)
    model = GlimpseEvidence(3, places=AT)
    model.save(tmp_path / "own.safetensors")
    assert GlimpseEvidence.from_pretrained(tmp_path / "own.safetensors").places == AT
    other = GlimpseEvidence(3)
    other.load_state_dict(model.state_dict())
    assert other.places == AT
    tensors, record = read(tmp_path / "own.safetensors", "glimpse-evidence")
    without = {name: each for name, each in record.items() if name != "places"}
    write_file(tmp_path / "without.safetensors", tensors, without)
    assert GlimpseEvidence.from_pretrained(tmp_path / "without.safetensors").places is None
    old = tensors | {"verification.linear.weight": torch.zeros(2, 7), "verification.linear.bias": torch.zeros(2)}
    write_file(tmp_path / "old.safetensors", old, record)
    again = "another version of semfov wrote it, fit it again: semfov fit {} --data.root PHOTOS --data.annotations"
    for metadata, detector in (
        ({}, "MODEL.onnx"),
        ({"detector": {}}, "MODEL.onnx"),
        ({"detector": {"name": "mine"}}, "MODEL.onnx"),  # of the file `mine.onnx`, which the command would need
        ({"detector": {"name": "x; rm -rf y"}}, "MODEL.onnx"),
        ({"detector": {"name": ["yolox-nano"]}}, "MODEL.onnx"),
        ({"detector": {"name": "yolox-s"}}, "yolox-s"),
    ):
        write_file(tmp_path / "old.safetensors", old, record | {"metadata": metadata})
        message = f"not a complete model of evidence .*; if {again.format(detector)}"
        unusable(message, GlimpseEvidence.from_pretrained, tmp_path / "old.safetensors")


SIZE = (192, 144)
OVER = Lattice.over(SIZE, (128, 128))


@pytest.fixture
def photograph():
    """192 × 144 px, black, with a red square of 32 px, and a third of one, which the whole shows faintly."""
    image = torch.zeros(3, 144, 192)
    image[0, 96:128, 144:176] = 1
    image[0, 8:16, 8:16] = 1
    return image


def own_evidence(place=0.1, confirm=0.6):
    torch.manual_seed(0)
    certainty = Certainty(0.0, tuple(float(each == "sharpest") for each in FACTS), strength=1.0)
    own = PhotographEvidence(3, certainty=certainty, thresholds=Thresholds(confirm, place, place))
    with torch.no_grad():
        own.whole.weight.copy_(torch.tensor([[1.0, 0.5]]))
        own.whole.bias.fill_(0.25)
        own.usual.copy_(torch.tensor([0.0, -1.0, 2.0]))
    return GlimpseEvidence(3, thresholds=Thresholds(0.9, 0.3), photograph=own).eval().requires_grad_(False)


def test_a_file_keeps_the_evidence_for_photographs(tmp_path):
    model = own_evidence()
    model.photograph.window = (0.5, 3.0)
    model.save(tmp_path / "own.safetensors")
    again = GlimpseEvidence.from_pretrained(tmp_path / "own.safetensors")
    assert all(torch.equal(tensor, again.state_dict()[name]) for name, tensor in model.state_dict().items())
    assert again.photograph.thresholds == model.photograph.thresholds == Thresholds(0.6, 0.1, 0.1)
    assert again.photograph.window == (0.5, 3.0)
    assert again.photograph.certainty.numbers == model.photograph.certainty.numbers
    assert again.photograph.shares is None
    model.photograph.shares = SHARES
    model.save(tmp_path / "own.safetensors")
    assert torch.equal(GlimpseEvidence.from_pretrained(tmp_path / "own.safetensors").photograph.shares, SHARES)
    GlimpseEvidence(3).save(tmp_path / "without.safetensors")
    assert GlimpseEvidence.from_pretrained(tmp_path / "without.safetensors").photograph is None


def test_presence_follows_the_formula_with_certainty_of_its_own():
    own = own_evidence().photograph
    for score, target, usual in ((0.3, 1, 0.0), (0.01, 2, -1.0), (0.9, 3, 2.0)):
        expected = math.log(score / (1 - score)) + 0.5 * usual + 0.25
        assert float(own.presence(torch.tensor(score), torch.tensor(target))) == pytest.approx(expected, abs=1e-5)
    model = own_evidence()
    assert model.certainty_in(OVER) is model.photograph.certainty
    assert model.certainty_in(Lattice.over((1024, 768), (128, 128))) is model.certainty


@pytest.mark.parametrize("size", [(640, 480), (480, 640), (640, 200), (416, 416), (90, 60)])
def test_slices_of_a_photograph_show_all_of_it_enlarged(size):
    lattice = Lattice.over(size, (416, 416))
    shown = torch.zeros(size[1], size[0], dtype=torch.bool)
    for window in usual_slices(lattice):
        x1, y1, x2, y2 = map(int, window.within)
        shown[y1:y2, x1:x2] = True
        assert window.fixation[2] > 1.6 * lattice.magnifications[0]
    assert bool(shown.all())


def test_slices_are_ranked_by_the_hints_whose_centre_they_show(detector, photograph):
    source = LiveWindowLooks(eye := WindowEye(detector), eye.open(photograph))
    (whole,) = source.see([Window.overview(source.lattice)])
    windows = usual_slices(source.lattice)
    values = []
    for window in windows:
        x1, y1, x2, y2 = window.within
        inside = [
            float(scores[0])
            for box, scores in zip(whole.hints.boxes.tolist(), whole.hints.scores, strict=True)
            if x1 <= (box[0] + box[2]) / 2 < x2 and y1 <= (box[1] + box[3]) / 2 < y2
        ]
        values.append(sum(inside))
        assert raw(whole, window, [1]) == pytest.approx(sum(inside), abs=1e-5)
        assert raw(whole, window, [1], most=True) == pytest.approx(max(inside, default=0.0), abs=1e-6)
    ((first, value),) = ranked(windows, [1])([whole], set())
    assert value == pytest.approx(max(values), abs=1e-5)
    assert first == windows[values.index(max(values))]


def test_the_window_of_a_place_is_chosen_once(monkeypatch):
    asked = []

    def counted(lattice, box, window):
        asked.append(box)
        return closer_window(lattice, box, window)

    monkeypatch.setattr("semfov.zoom.places.closer_window", counted)
    facts = SearchFacts(ZoomBelief(OVER, own_evidence(), 1))
    facts.add(replace(seen([[10.0, 10, 30, 30], [150.0, 90, 170, 110]], [0.8, 0.7]), window=Window.overview(OVER)))
    places = ObjectPlaces(facts)
    places.see(TargetFacts(facts.looks[0].look.detections, 1, facts.presence(), 0.0))
    for number in (1, 2):
        place = places.due(Thresholds(1.0, 0.01), last=True)
        assert places.shown_at(place) is None
        assert places.closer_magnification(place) > 1.0
        places.count_look(place)
        places.dismiss(place, place.box)
        assert len(asked) == number


@pytest.mark.parametrize("share", ["fit", 0.2])
def test_a_place_of_a_photograph_is_of_the_object_there_by_a_regression(detector, photograph, share):
    """Of the same looks, the closer one among them; before it, too."""
    model = own_evidence(place=0.0, confirm=1.0)
    model.photograph.shares = SHARES
    with torch.no_grad():
        model.photograph.place.weight.fill_(0.5)
        model.photograph.place.bias.fill_(1.5)
    path = ZoomAgent(WindowEye(detector), model).search(photograph, "red", SearchSettings(prior=share))
    prior = Prior.of(share, float(SHARES[0]))
    assert path.closer
    for look in path.closer:
        looks = path.window_looks[: look.index + 1]
        objects, _ = probable_objects(looks, path.lattice, 1, model.photograph.certainty)
        certainty = min(float(objects.scores[(objects.boxes == look.box).all(-1)].max()), 1 - 1e-4)
        chance = 1 / (1 + math.exp(-1.5 - 0.5 * math.log(certainty / (1 - certainty))))
        best = min(max(float(each.show[0]) for each in looks), 1 - 1e-4)
        presence = 1 / (1 + math.exp(-0.25 - math.log(best / (1 - best))))
        assert look.place == pytest.approx(prior.at_place(chance, presence), rel=1e-4)


def test_a_user_who_stops_later_gets_closer_looks_at_less_probable_places(detector, photograph):
    agent = ZoomAgent(WindowEye(detector), own_evidence(place=0.9, confirm=1.0))
    assert (
        agent.search(photograph, "red").passes < agent.search(photograph, "red", SearchSettings(stop_below=0.0)).passes
    )


def test_the_window_of_a_closer_look_shows_other_places_too():
    x1, y1, x2, y2 = closer_window(OVER, torch.tensor([150.0, 100, 160, 110])).within
    assert (x2 - x1, y2 - y1) == pytest.approx((0.6 * 192, 0.6 * 192))
    assert x1 <= 150
    assert x2 <= 192
    large = closer_window(OVER, torch.tensor([20.0, 20, 90, 60])).within
    assert large[2] - large[0] == pytest.approx(140)
    x1, y1, x2, y2 = closer_window(OVER, torch.tensor([150.0, 100, 160, 110]), (1 / 3, 3.0)).within
    assert (x1, y1, x2, y2) == pytest.approx((123, 73, 187, 137))


@pytest.mark.parametrize("window", [(0.6, 2.0), (0.4, 2.0), (0.3, 3.0)])
def test_evidence_says_how_large_the_window_of_a_closer_look_is(detector, photograph, window):
    model = own_evidence()
    model.photograph.window = window
    path = ZoomAgent(WindowEye(detector), model).search(photograph, "red", SearchSettings(closer=1))
    whole, closer = path.window_looks
    box = whole.detections.boxes[0, whole.detections.scores[0, :, 1].argmax()]
    side = float((box[2:] - box[:2]).max())
    x1, _, x2, _ = closer.window.within
    assert x2 - x1 == pytest.approx(max(window[0] * 192, window[1] * side))


def test_a_search_of_a_photograph_decides_after_closer_looks(detector, photograph):
    agent = ZoomAgent(WindowEye(detector), own_evidence())
    path = agent.search(photograph, "red")
    assert path.decision.outcome == "found"
    x1, y1, x2, y2 = path.decision.box.tolist()
    assert x1 < 160 < x2
    assert y1 < 112 < y2
    assert path.passes == 1 + len(path.closer)
    assert [look.index for look in path.closer] == list(range(1, path.passes))
    nothing = agent.search(photograph, "blue")
    assert nothing.decision.outcome == "absent"
    assert nothing.passes == 1
    assert "the detector missed it" in nothing.why_it_ended()
    seen = torch.tensor([0.0, 0.0, FAINTEST + 1e-6])
    looks = tuple(replace(look, shown=replace(look.shown, show=seen)) for look in nothing.looks)
    shown = replace(nothing, looks=looks)
    assert "worth a pass" in shown.why_it_ended()


SHARES = torch.tensor([0.7, 0.4, 0.2])


def evidence_with_shares(**thresholds):
    model = own_evidence(**thresholds)
    model.photograph.shares = SHARES
    return model


def test_a_prior_changes_the_log_odds_of_a_search_by_that_of_the_fit(detector, photograph):
    agent = ZoomAgent(WindowEye(detector), evidence_with_shares())
    for number, target in enumerate(("red", "green", "blue")):
        usual = agent.search(photograph, target, SearchSettings(closer=0, prior="fit")).decision.probability
        for prior in (0.05, 0.6, float(SHARES[number]), None):
            rare = agent.search(photograph, target, SearchSettings(closer=0, prior=prior)).decision.probability
            odds = 1 if prior is None else prior / (1 - prior)
            expected = usual / (1 - usual) * odds / (SHARES[number] / (1 - SHARES[number]))
            assert rare / (1 - rare) == pytest.approx(float(expected), rel=1e-4)


def test_a_record_says_what_its_probability_assumes_and_gives_others(detector, photograph, picture):
    agent = ZoomAgent(WindowEye(detector), evidence_with_shares())
    usual = agent.search(photograph, "green", SearchSettings(closer=0))
    assert (usual.prior, usual.assumed) == (None, 0.5)
    fitted = agent.search(photograph, "green", SearchSettings(closer=0, prior="fit"))
    assert (fitted.prior, fitted.assumed) == (None, pytest.approx(0.4))
    for share in (0.05, 0.4, 0.9):
        searched = agent.search(photograph, "green", SearchSettings(closer=0, prior=share))
        assert (searched.prior, searched.assumed) == (share, share)
        assert usual.probability_at(share) == pytest.approx(searched.decision.probability, rel=1e-4)
        assert searched.probability_at(0.5) == pytest.approx(usual.decision.probability, rel=1e-4)
    assert usual.probability_at(usual.assumed) == usual.decision.probability
    assert agent.search(picture, "green", SearchSettings(passes=1, closer=0)).assumed == 0.5
    assert ZoomAgent(WindowEye(detector), own_evidence()).search(photograph, "green").assumed is None
    moment = agent.stream(2, (), StreamSettings(prior=0.2), follows=False).step(photograph)
    assert (moment.prior, moment.assumed) == (0.2, 0.2)


def test_closer_looks_read_the_probabilities_of_the_fit_and_give_those_of_the_prior(detector, photograph):
    model, share = evidence_with_shares(place=0.0, confirm=1.0), 0.1
    agent = ZoomAgent(WindowEye(detector), model)
    usual, rare = (agent.search(photograph, "red", SearchSettings(prior=prior)) for prior in ("fit", share))
    prior = Prior(share, float(SHARES[0]))
    assert len(usual.closer) == len(rare.closer) > 1
    for before, after in zip(usual.closer, rare.closer, strict=True):
        assert torch.equal(before.box, after.box)
        assert after.presence == pytest.approx(prior(before.presence), rel=1e-5)
        assert after.place == pytest.approx(prior.at_place(before.place, before.presence), rel=1e-5)
    assert rare.decision.probability < usual.decision.probability


def test_thresholds_are_compared_with_the_probability_for_the_prior(detector, photograph):
    agent = ZoomAgent(WindowEye(detector), evidence_with_shares())
    assert agent.search(photograph, "red").decision.outcome == "found"
    rare = agent.search(photograph, "red", SearchSettings(prior=1e-6))
    # No place is worth a pass where hardly any photograph holds the class.
    assert (rare.passes, rare.decision.outcome) == (1, "absent")


def test_a_prior_in_a_large_picture_is_compared_with_one_half(picture):
    agent = ZoomAgent(WindowEye(Sized().eval()), evidence())
    usual, fitted, rare = (
        agent.search(picture, "red", SearchSettings(passes=1, closer=0, prior=prior)).decision
        for prior in (None, "fit", 0.1)
    )
    assert usual.probability == fitted.probability
    assert rare.probability == pytest.approx(Prior(0.1, 0.5)(usual.probability), rel=1e-5)


def test_a_prior_needs_the_shares_of_the_fit(detector, photograph):
    for models in (own_evidence(), None):
        agent = ZoomAgent(WindowEye(detector), models)
        refused("prior: expected None for models", agent.search, photograph, "red", SearchSettings(prior=0.2))


def test_a_stream_of_a_photograph_gives_what_a_search_gives(detector, photograph):
    agent = ZoomAgent(WindowEye(detector), own_evidence())
    path = agent.search(photograph, "red")
    assert path.passes == 1 + len(path.closer) > 1
    live = agent.stream(1, (), StreamSettings(rate=0.0), follows=False)
    for _ in range(path.passes):
        live.step(photograph)
    moment = live.moment()
    assert moment.decision.outcome == path.decision.outcome
    assert moment.decision.probability == pytest.approx(path.decision.probability, abs=1e-9)
    assert torch.equal(moment.decision.box, path.decision.box)
    assert moment.examined.index == path.passes - 1
    assert [look.number for look in moment.closer] == [look.number for look in path.closer]
    assert [look.box.tolist() for look in moment.closer] == [look.box.tolist() for look in path.closer]
    path = ZoomAgent(WindowEye(detector), own_evidence()).search(photograph, "red", SearchSettings(closer=0))
    assert path.passes == 1
    assert not path.closer


def test_all_objects_of_a_photograph_are_those_of_the_whole_and_of_slices(detector, photograph):
    agent = ZoomAgent(WindowEye(detector), own_evidence())
    one, all_ = (agent.find_all(photograph, "red", FindSettings(passes=passes)) for passes in (1, 5))
    assert [look.window for look in all_.window_looks[:1]] == [look.window for look in one.window_looks]
    assert {look.window for look in all_.window_looks[1:]} == set(usual_slices(all_.lattice))
    assert len(all_.objects) >= len(one.objects)
    assert all_.ending == "windows" or all_.passes == 5


def test_a_place_that_leaves_the_frame_counts_again_when_it_comes_back():
    judge, close_up = verifier(FromScore(0.7), [0.8])
    judge.see(look(1, 0.9, 0.5, ONE))
    judge.examine(close_up(judge.candidate.box))
    assert judge.decision().outcome == "found"
    out = Motion.similarity(shift=(-125, 0))  # the box reaches from 100 to 140, and its middle to the left of the frame
    judge.follow(CameraStep(out), LATTICE.size)
    judge.see(TargetFacts(seen([OTHER], [0.0]).detections, 2, 0.1, 0.5))
    assert judge.looks == []
    assert judge.decision().outcome != "found"
    assert judge.presence == pytest.approx(0.1)
    judge.follow(CameraStep(out.inverse()), LATTICE.size)
    decision = judge.decision()
    assert decision.outcome == "found"
    torch.testing.assert_close(decision.box, judge.looks[0].box)
    assert decision.box.tolist() == pytest.approx(ONE, abs=1e-3)


@pytest.mark.parametrize("large", [True, False])
def test_evidence_in_double_precision_searches_alike(large, picture, photograph):
    image, evidence_of = (picture, evidence) if large else (photograph, own_evidence)
    one, other = (
        ZoomAgent(WindowEye(Sized().eval()), model).search(image, "red", SearchSettings(passes=6))
        for model in (evidence_of(), evidence_of().double())
    )
    assert [look.window for look in other.window_looks] == [look.window for look in one.window_looks]
    assert other.decision.outcome == one.decision.outcome
    assert other.decision.probability == pytest.approx(one.decision.probability, abs=1e-5)


def panned(picture, lefts, width=512):
    """Frames of a camera that turns to the right over a picture, each with its pose."""
    for left in lefts:
        yield picture[..., left : left + width], [[1, 0, lefts[0] - left], [0, 1, 0]]


LEFTS = [200] * 6 + [300, 400, 500, 600, 760, 760, 760, 600, 400, 200]


@pytest.fixture(scope="module")
def pan():
    """Moments, each with the left edge of its frame; a red square is at x from 640 to 703, y from 320 to 383."""
    ground = 0.03 * torch.rand(3, 768, 1280, generator=torch.Generator().manual_seed(0))  # not blank
    ground[:, 320:384, 640:704] = torch.tensor([1.0, 0, 0])[:, None, None]
    live = ZoomAgent(WindowEye(Sized()), evidence()).stream(1, (), StreamSettings(rate=0.25))
    frames = panned(ground, LEFTS)
    return [(live.step(frame, pose=pose), left) for (frame, pose), left in zip(frames, LEFTS, strict=True)]


def test_a_search_finds_what_the_frame_shows_and_remembers_the_rest(pan):
    """What has left the frame is neither found nor listed, and is found again where the camera comes back."""
    outcomes = [moment.decision.outcome == "found" for moment, _ in pan]
    first = outcomes.index(True)
    assert first < 6
    assert outcomes[first:] == [left < 704 for left in LEFTS[first:]]
    for moment, left in pan[first:]:
        if left < 704:
            x1, y1, x2, y2 = moment.decision.box.tolist()
            assert 640 - left < (x1 + x2) / 2 < 704 - left
            assert 320 < (y1 + y2) / 2 < 384
        else:
            assert moment.decision.box is None
            assert len(moment.objects) == 0
            assert moment.closer == ()


def test_a_frame_without_the_target_is_judged_by_what_it_shows(pan):
    gone = [moment.decision.probability for moment, left in pan if left > 704]
    there = [moment.decision.probability for moment, left in pan if left < 704 and moment.decision.outcome == "found"]
    assert max(gone) < 0.5 < min(there)


def test_a_moment_and_its_page_have_the_looks_that_the_frame_shows(pan):
    for moment, _ in pan:
        data = moment.page_data()
        for look, shown in zip(moment, data["looks"], strict=True):
            for x1, y1, x2, y2 in (look.region, shown["box"]):
                assert 0 <= x1 < x2 <= 512
                assert 0 <= y1 < y2 <= 768
            x, y = look.fixation
            assert 0 <= x < 512
            assert 0 <= y < 768
        for found in data["objects"]:
            assert 0 <= (found["box"][0] + found["box"][2]) / 2 < 512


def test_looks_are_carried_along_in_a_frame_that_is_spent_on_a_closer_look(picture):
    """The camera goes on by 40 px in every frame; the overview shows the first frame."""
    live = ZoomAgent(WindowEye(Sized()), evidence()).stream(1, (), StreamSettings(rate=0.25))
    picture[0, 320:384, 640:704] = 1
    lefts = range(0, 480, 40)
    overviews = []
    for (frame, pose), left in zip(panned(picture, lefts, 800), lefts, strict=True):
        moment = live.step(frame, pose=pose)
        if moment.examined is not None:
            overviews.append((moment.looks[0].region[2], 800 - left))
            break
    ((right, expected),) = overviews
    assert expected < 800
    assert right == pytest.approx(expected)


def test_a_closer_look_counts_where_the_camera_has_moved_to():
    """Green squares look red from afar; after the closer look the picture is not taken to hold red in later frames."""
    ground = 0.03 * torch.rand(3, 768, 1280, generator=torch.Generator().manual_seed(0))
    ground[:, 320:344, 640:664] = torch.tensor([0.0, 1, 0])[:, None, None]
    live = ZoomAgent(WindowEye(Fickle().eval()), evidence()).stream(1, (), StreamSettings(rate=0.05))
    presence = []
    for frame, pose in panned(ground, [200] * 6 + [210, 220, 230, 240], 800):
        moment = live.step(frame, pose=pose)
        presence.append((live._session.decisions._facts.presence(), len(moment.closer)))
    before = [p for p, closer in presence if not closer]
    after = [p for p, closer in presence if closer]
    assert presence[-4][1] == 1
    assert max(after) < 0.1 < max(before)


def test_with_poses_of_a_still_camera_a_search_is_the_same_to_the_bit(picture, one_thread):
    agent = ZoomAgent(WindowEye(Sized().eval()), evidence())
    still = agent.stream(1, (), StreamSettings(rate=0.75), follows=False)
    posed = agent.stream(1, (), StreamSettings(rate=0.75))
    for _ in range(8):
        one, other = still.step(picture), posed.step(picture, pose=np.eye(3))
        assert one.decision.probability == other.decision.probability
        assert one.decision.outcome == other.decision.outcome
        assert [look.region for look in one] == [look.region for look in other]
        assert torch.equal(one.objects.boxes, other.objects.boxes)


def test_an_object_that_fills_a_large_picture_needs_no_closer_look():
    """The look at the whole shows it as closely; a later frame, and one that the camera has moved to, show others."""
    boxes = torch.tensor([[[10.0, 10, 1000, 750], [60.0, 60, 90, 90]]])
    whole = Detections(boxes, torch.tensor([[[0, 0.9, 0], [0, 0.89, 0]]]), torch.ones(1, 2).bool())

    facts = SearchFacts(ZoomBelief(LATTICE, evidence(by("score")), 1))
    facts.add(replace(seen(boxes[0].tolist(), [0.9, 0.89]), window=Window.overview(LATTICE)))

    def search(rate):
        places = ObjectPlaces(facts, Forgetting(rate))
        judge = ObjectVerifier(places, Thresholds(0.999, 1e-4), most=9)
        places.keep_whole(0, whole)
        judge.see(TargetFacts(whole, 3, 0.8, 0.3))
        return judge

    judge = search(0.0)
    assert judge.shown is whole
    look = judge.examine(judge.shown)
    assert (look.index, look.place) == (0, pytest.approx(0.9))
    assert facts.presence() < look.presence == look.place
    # A small place takes a pass.
    assert judge.candidate.box.tolist() == boxes[0, 1].tolist()
    assert judge.shown is None

    judge = search(2.5)
    assert judge.shown is whole
    judge.wait()
    assert judge.shown is None

    judge = search(0.0)
    judge.follow(CameraStep(Motion.similarity(shift=(5, 0))), LATTICE.size)
    assert judge.shown is None


def test_a_photograph_is_not_absent_while_a_closer_look_is_due(detector, photograph):
    """Presence is below one half, but the object that was found may still be the target."""
    model = own_evidence(place=0.1, confirm=0.6)
    with torch.no_grad():
        model.photograph.whole.bias.fill_(-20.0)
    agent = ZoomAgent(WindowEye(detector), model)
    first = agent.search(photograph, "red", SearchSettings(passes=1))
    assert (first.decision.outcome, first.ending) == ("undecided", "passes")
    assert agent.search(photograph, "red").decision.outcome == "found"
    live = agent.stream(1, (), StreamSettings(rate=0.75), follows=False)
    assert [live.step(photograph).decision.outcome for _ in range(3)] == ["undecided", "undecided", "found"]


def test_a_search_of_a_photograph_ends_where_the_class_is_next_to_impossible(detector, photograph):
    """No chance of a hit is left, however low `stop_below` is."""
    agent = ZoomAgent(WindowEye(detector), evidence_with_shares())
    path = agent.search(photograph, "red", SearchSettings(prior=1e-8, stop_below=0.0))
    assert (path.passes, path.decision.outcome, path.ending) == (1, "absent", "decision")


def test_faint_objects_of_a_rare_class_take_no_closer_looks_in_a_photograph(detector, photograph):
    """A prior of one half lifts them over the threshold, but the fit has seen no such places."""
    faint = 0.02 * photograph
    model = own_evidence(place=0.1, confirm=0.6)
    model.photograph.shares = torch.tensor([1e-3, 0.4, 0.2])
    search = ZoomAgent(WindowEye(detector), model).search
    assert search(faint, "red").passes == 1
    assert search(photograph, "red").passes > 1
