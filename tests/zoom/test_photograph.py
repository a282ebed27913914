"""Photographs, which one look shows whole: their evidence, the worth of closer looks, slices, and decisions."""

import math
from dataclasses import replace

import pytest
import torch

from semfov import Detections, WindowEye, ZoomAgent
from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import Verification, closer_features
from semfov.zoom import GlimpseEvidence, Lattice
from semfov.zoom.certainty import FACTS, Certainty
from semfov.zoom.closer import PhotographPlaces, WindowLook, closer_window
from semfov.zoom.evidence import PhotographEvidence
from semfov.zoom.glances import LiveGlances, Window
from semfov.zoom.slices import ranked, raw, usual_slices

SIZE = (192, 144)
LATTICE = Lattice.over(SIZE, (128, 128))


class FromScore(Verification):
    """Both probabilities are the score of the target in the closer look."""

    def forward(self, features):
        return features[..., 6:7].expand(*features.shape[:-1], 2)


@pytest.fixture
def photograph():
    """192 × 144 px, black, with a red square of 32 px, and a third of one, which the whole shows faintly."""
    image = torch.zeros(3, 144, 192)
    image[0, 96:128, 144:176] = 1
    image[0, 8:16, 8:16] = 1
    return image


def evidence(give_up=0.1, confirm=0.6):
    torch.manual_seed(0)
    own = PhotographEvidence(3, certainty=Certainty(0.0, (1.0, *[0.0] * (len(FACTS) - 1)), 0.0, 1.0))
    own.verification = FromScore(thresholds=Thresholds(confirm, give_up, give_up))
    with torch.no_grad():
        own.whole.weight.copy_(torch.tensor([[1.0, 0.5]]))
        own.whole.bias.fill_(0.25)
        own.usual.copy_(torch.tensor([0.0, -1.0, 2.0]))
    return GlimpseEvidence(3, 8, thresholds=Thresholds(0.9, 0.3), photograph=own).eval().requires_grad_(False)


def test_a_file_keeps_the_evidence_for_photographs(tmp_path):
    model = evidence()
    plain = Verification(thresholds=model.photograph.verification.thresholds)
    model.photograph.verification, model.photograph.window = plain, (0.5, 3.0)
    model.save(tmp_path / "own.safetensors")
    again = GlimpseEvidence.from_pretrained(tmp_path / "own.safetensors")
    assert all(torch.equal(tensor, again.state_dict()[name]) for name, tensor in model.state_dict().items())
    assert again.photograph.verification.thresholds == plain.thresholds
    assert again.photograph.window == (0.5, 3.0)
    assert again.photograph.certainty == model.photograph.certainty
    GlimpseEvidence(3, 8).save(tmp_path / "without.safetensors")
    assert GlimpseEvidence.from_pretrained(tmp_path / "without.safetensors").photograph is None


def test_presence_follows_the_formula_with_certainty_of_its_own():
    own = evidence().photograph
    for score, target, usual in ((0.3, 1, 0.0), (0.01, 2, -1.0), (0.9, 3, 2.0)):
        expected = math.log(score / (1 - score)) + 0.5 * usual + 0.25
        assert float(own.presence(torch.tensor(score), torch.tensor(target))) == pytest.approx(expected, abs=1e-5)
    model = evidence()
    assert model.certainty_in(LATTICE) is model.photograph.certainty
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
    glances = LiveGlances(eye := WindowEye(detector), eye.open(photograph))
    (whole,) = glances.see([Window.overview(glances.lattice)])
    windows = usual_slices(glances.lattice)
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


def test_a_closer_look_is_due_when_it_is_worth_a_pass():
    boxes = torch.tensor([[[10.0, 10, 30, 30], [60.0, 60, 80, 80], [120.0, 100, 140, 120]]])
    scores = torch.tensor([[[0, 0.5, 0], [0, 0.02, 0], [0, 0.001, 0]]])
    places = PhotographPlaces(1, LATTICE)
    places.see(WindowLook(Detections(boxes, scores, torch.ones(1, 3).bool()), 1, 0.8, 0.5, 0.0))

    def odds(p):
        return math.log(p / (1 - p))

    chances = [1 / (1 + math.exp(-(odds(0.8) + odds(score) - odds(0.5)))) for score in (0.5, 0.02)]
    first = places.due(0.3, last=True)
    assert first.probability == pytest.approx(chances[0], abs=1e-5)
    assert places.left == pytest.approx(chances[0], abs=1e-5)
    assert places.due(chances[0] + 1e-3, last=True) is None
    places.dismiss(first, first.box)
    places.record(first.box, 0.6, 0.7)
    # The rest is what the first place leaves; the third place is too faint.
    assert places.left == pytest.approx(chances[1] * 0.4, abs=1e-5)
    second = places.due(chances[1] * 0.4 - 1e-4, last=True)
    assert second.box.tolist() == boxes[0, 1].tolist()
    assert places.due(chances[1] * 0.4 + 1e-4, last=True) is None
    places.dismiss(second, second.box)
    assert places.left < 0


def test_a_place_that_only_the_whole_shows_closely_is_examined_without_a_pass():
    boxes = torch.tensor([[[10.0, 10, 180, 140], [60.0, 60, 80, 80]]])
    scores = torch.tensor([[[0, 0.5, 0.2], [0, 0.3, 0]]])
    places, looked = PhotographPlaces(1, LATTICE), []
    whole = Detections(boxes, scores, torch.ones(1, 2).bool())
    places.see(WindowLook(whole, 1, 0.8, 0.5, 0.0))

    def close_up(box):
        looked.append(box)
        return whole

    large = places.due(0.1, last=True)
    assert places.seen(large)
    features, box = places.examine(large, close_up)
    expected = closer_features(0.8, large.probability, 0.5, whole, large.box, 1)
    assert torch.equal(features, expected[0])
    assert (looked, places.record(box, 0.4, 0.5).number) == ([], 0)
    small = places.due(0.1, last=True)
    assert not places.seen(small)
    _, box = places.examine(small, close_up)
    assert (len(looked), places.record(box, 0.4, 0.5).number) == (1, 1)


def test_the_window_of_a_closer_look_shows_other_places_too():
    x1, y1, x2, y2 = closer_window(LATTICE, torch.tensor([150.0, 100, 160, 110])).within
    assert (x2 - x1, y2 - y1) == pytest.approx((0.6 * 192, 0.6 * 192))
    assert x1 <= 150
    assert x2 <= 192
    large = closer_window(LATTICE, torch.tensor([20.0, 20, 90, 60])).within
    assert large[2] - large[0] == pytest.approx(140)
    x1, y1, x2, y2 = closer_window(LATTICE, torch.tensor([150.0, 100, 160, 110]), (1 / 3, 3.0)).within
    assert (x1, y1, x2, y2) == pytest.approx((123, 73, 187, 137))


@pytest.mark.parametrize("window", [(0.6, 2.0), (0.4, 2.0), (0.3, 3.0)])
def test_evidence_says_how_large_the_window_of_a_closer_look_is(detector, photograph, window):
    model = evidence()
    model.photograph.window = window
    path = ZoomAgent(WindowEye(detector), model).search(photograph, "red", closer=1)
    whole, closer = path.glances
    box = whole.detections.boxes[0, whole.detections.scores[0, :, 1].argmax()]
    side = float((box[2:] - box[:2]).max())
    x1, _, x2, _ = closer.window.within
    assert x2 - x1 == pytest.approx(max(window[0] * 192, window[1] * side))


def test_hints_below_the_threshold_of_detections_are_places(detector, photograph):
    glances = LiveGlances(eye := WindowEye(detector), eye.open(photograph / 20))
    (whole,) = glances.see([Window.overview(glances.lattice)])
    assert not len(whole.detections.boxes[0])
    places = whole.candidates
    assert len(places.boxes[0]) == len(whole.hints.boxes) > 0
    assert places.scores[0, :, 1:].tolist() == whole.hints.scores.tolist()


def test_a_search_of_a_photograph_decides_after_closer_looks(detector, photograph):
    agent = ZoomAgent(WindowEye(detector), evidence())
    path = agent.search(photograph, "red")
    assert path.decision.outcome == "found"
    x1, y1, x2, y2 = path.decision.box.tolist()
    assert x1 < 160 < x2
    assert y1 < 112 < y2
    assert path.passes == 1 + len(path.closer)
    assert [look.number for look in path.closer] == list(range(1, path.passes))
    nothing = agent.search(photograph, "blue")
    assert nothing.decision.outcome == "absent"
    assert nothing.passes == 1
    assert "not something seen" in nothing.why_it_ended()
    seen = torch.tensor([0.0, 0.0, PhotographPlaces.least + 1e-6])
    shown = replace(nothing, glances=tuple(replace(glance, show=seen) for glance in nothing.glances))
    assert "worth a pass" in shown.why_it_ended()
    # Without a limit of their worth all places are looked at, however sure the first one is.
    made = [agent.search(photograph, "red", confirm=least, give_up=0.0).passes for least in (0.01, 0.9)]
    assert made[0] == made[1] > max(path.passes, 3)


def test_closer_looks_can_be_left_out(detector, photograph):
    path = ZoomAgent(WindowEye(detector), evidence()).search(photograph, "red", closer=0)
    assert path.passes == 1
    assert not path.closer


def test_a_stream_of_a_photograph_gives_what_a_search_gives(detector, photograph):
    agent = ZoomAgent(WindowEye(detector), evidence())
    path = agent.search(photograph, "red")
    live = agent.episode(1, rate=0.0)
    for _ in range(path.passes):
        live.look(photograph)
    moment = live.moment()
    assert moment.decision.outcome == path.decision.outcome
    assert moment.decision.probability == pytest.approx(path.decision.probability, abs=1e-9)
    assert torch.equal(moment.decision.box, path.decision.box)
    assert [look.box.tolist() for look in moment.closer] == [look.box.tolist() for look in path.closer]


def test_all_objects_of_a_photograph_are_those_of_the_whole_and_of_slices(detector, photograph):
    agent = ZoomAgent(WindowEye(detector), evidence())
    one, all_ = (agent.find_all(photograph, "red", passes=passes) for passes in (1, 5))
    assert [look.window for look in all_.glances[:1]] == [look.window for look in one.glances]
    assert {look.window for look in all_.glances[1:]} == set(usual_slices(all_.lattice))
    assert len(all_.objects) >= len(one.objects)
    assert all_.ending == "windows" or all_.passes == 5
