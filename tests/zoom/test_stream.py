"""Windows of the frames of a stream: a still picture gives the looks of a search, and a new one is looked at anew."""

import math

import pytest
import torch

from semfov import ActivePerception, Detections, InputError, WindowEye, ZoomAgent
from semfov.zoom import GlimpseEvidence, Lattice
from semfov.zoom.glances import Glance, Window
from semfov.zoom.objects import without_replaced
from tests.refusals import refused
from tests.zoom.test_closer import Fickle, evidence


def same_looks(moments, path):
    """Whether moments hold the looks of a path, to the bit."""
    last = moments[-1]
    assert [moment.window for moment in moments] == [glance.window for glance in path.glances]
    assert [moment.next_window for moment in moments[:-1]] == [moment.window for moment in moments[1:]]
    assert last.values == path.values
    for look, glance in zip(last.glances, path.glances, strict=True):
        assert torch.equal(look.detections.boxes, glance.detections.boxes)
        assert torch.equal(look.detections.scores, glance.detections.scores)
    assert torch.equal(last.candidates.boxes, path.candidates.boxes)
    assert last.object_rows() == path.object_rows()


@pytest.mark.parametrize("target", [None, 3, [1, 3]])
def test_a_still_picture_at_rate_zero_gives_the_looks_of_an_exploration(agent, picture, target, one_thread):
    path = agent.find_all(picture, target, passes=9)
    targets = {None: (), 3: (3,)}.get(target) if not isinstance(target, list) else tuple(target)
    live = agent.episode(None, targets, rate=0)
    moments = [live.step(picture) for _ in path.glances]
    same_looks(moments, path)
    assert moments[-1].decision is None
    assert (moments[-1].target, moments[-1].targets) == (path.target, path.targets)
    assert moments[-1].describe() == moments[-1].objects_in_words() == path.objects_in_words()


@pytest.mark.parametrize("kind", ["closely", "plain", "slices"])
def test_a_still_picture_at_rate_zero_gives_the_looks_of_a_search(detector, picture, kind, one_thread):
    """With closer looks, each of which takes a frame, without them, and without learned evidence."""
    model = {"closely": evidence(), "plain": GlimpseEvidence(3, 8), "slices": None}[kind]
    agent = ZoomAgent(WindowEye(detector), model).eval()
    path = agent.search(picture, "red")
    live = agent.episode(1, rate=0)
    moments = [live.step(picture) for _ in path.glances]
    same_looks(moments, path)
    last = moments[-1]
    assert last.decision.outcome == path.decision.outcome == "found"
    assert last.decision.probability == path.decision.probability
    assert last.decision.box.tolist() == path.decision.box.tolist()
    assert [look.number for look in last.closer] == [look.number for look in path.closer]
    assert (last.examined is not None) == (kind == "closely")
    # The stream goes on after the end of the search.
    assert live.step(picture).number == len(moments)


def test_the_looks_at_what_is_refuted_closely_are_those_of_a_search(picture, one_thread):
    image = torch.zeros_like(picture)
    image[1, 320:344, 640:664] = 1
    image[:, [0, 0, -1, -1], [0, -1, 0, -1]] = 0.02  # no blank ground
    agent = ZoomAgent(WindowEye(Fickle().eval()), evidence(presence=0.3))
    path = agent.search(image, "red", closer=2)
    live = agent.episode(1, rate=0, closer=2)
    moments = [live.step(image) for _ in path.glances]
    same_looks(moments, path)
    assert (path.decision.outcome, moments[-1].decision.outcome) == ("absent", "absent")
    assert len(path.closer) == len(moments[-1].closer) == 2


def test_looks_are_forgotten_by_the_frames_that_passed(agent, picture):
    """A twin keeps the date of each look; the overview is kept until there is a new one."""
    live, dates, now = agent.episode(rate=math.log(2) / 4.5), {}, 0.0
    for passed in (1, 1, 1, 1, 3, 0.5, 6, 1, 1, 1):
        moment = live.step(picture, passed)
        now += passed
        dates[moment.window] = now
        expected = {window for window, date in dates.items() if window.level == 0 or now - date <= 4.5}
        assert {look.window for look in moment.glances} == expected
        due = now + 1 - next(date for window, date in dates.items() if window.level == 0) > 4.5
        assert due == (moment.next_window.level == 0)
    assert passed == 1
    assert len(dates) > len(expected)


@pytest.mark.slow
def test_objects_that_move_or_leave_are_forgotten(agent):
    """A square jumps to another place: soon it is shown there, and nowhere else."""

    def frame(x):
        image = torch.zeros(3, 768, 1024)
        image[:, [0, 0, -1, -1], [0, -1, 0, -1]] = 0.02  # no blank ground
        image[0, 320:352, x : x + 32] = 1
        return image

    live = agent.episode(rate=0.04)
    kept = agent.episode(rate=0)
    for x in [160] * 24 + [800] * 20:
        moment, old = live.step(frame(x)), kept.step(frame(x))
        if x == 160:
            before = moment.objects
    assert ((before.boxes[:, 0] - 160).abs() < 17).all()
    assert ((moment.objects.boxes[:, 0] - 800).abs() < 17).all()
    assert len(before) > 0
    assert len(moment.objects) > 0
    assert (old.objects.boxes[:, 0] < 500).any(), "at rate 0 nothing is forgotten"


def test_a_found_target_is_lost_when_it_leaves(detector, picture):
    agent = ZoomAgent(WindowEye(detector), evidence())
    live = agent.episode(1, rate=0.1)
    found = [live.step(picture).decision.outcome for _ in range(12)]
    gone = [live.step(torch.zeros_like(picture)).decision for _ in range(20)]
    assert "found" in found
    assert [decision.outcome for decision in gone[-5:]] != ["found"] * 5
    assert gone[-1].outcome != "found"


def test_a_later_look_as_close_replaces_what_earlier_ones_showed():
    """Brute force over every pair of a box and a later window."""
    lattice, generator = Lattice.over((1024, 768), (128, 128)), torch.Generator().manual_seed(0)
    windows = [(0, 0, 0), (1, 4, 4), (2, 8, 8), (1, 0, 0), (2, 20, 20), (0, 0, 0), (2, 10, 9)]
    glances = []
    for action in windows:
        low = torch.rand(6, 2, generator=generator) * 700
        boxes = torch.cat([low, low + 40], -1)[None]
        detections = Detections(boxes, torch.full((1, 6, 3), 0.5), torch.ones(1, 6, dtype=torch.bool))
        glances.append(Glance(Window.on(lattice, action), detections, torch.arange(6) % 2 == 0, torch.zeros(2), None))
    kept = without_replaced(glances, lattice)
    for number, (glance, left) in enumerate(zip(glances, kept, strict=True)):
        expected = []
        for place, (x1, y1, x2, y2) in enumerate(glance.detections.boxes[0].tolist()):
            hidden = False
            for later in glances[number + 1 :]:
                a, b, c, d = later.window.region(lattice)
                w, h = (x2 - x1) / 2, (y2 - y1) / 2
                inside = (
                    a <= max(x1 - w, 0) and b <= max(y1 - h, 0) and min(x2 + w, 1024) <= c and min(y2 + h, 768) <= d
                )
                hidden |= inside and later.window.level >= glance.window.level
            if not hidden:
                expected.append(place)
        assert torch.equal(left.detections.boxes[0], glance.detections.boxes[0, expected])
        assert torch.equal(left.cut, glance.cut[expected])
    assert sum(len(look.cut) for look in kept) < sum(len(look.cut) for look in glances)


@pytest.fixture
def raw(detector):
    agent = ActivePerception.raw(detector)
    return agent


def test_the_first_frame_decides_how_a_stream_is_looked_at(raw, picture):
    for size, how, kind in ((128, "fovea", "FoveaMoment"), (1024, "windows", "WindowMoment")):
        live = raw.live("red")
        assert live.how == "auto"
        moment = live.step(picture[:, :size, :size])
        assert (live.how, type(moment).__name__) == (how, kind)
        assert moment.describe().startswith("red: ") or "p(red)" in moment.describe()
    assert type(raw.live("red", how="fovea").step(picture)).__name__ == "FoveaMoment"
    small = raw.live(["red", "blue"]).step(picture[:, :128, :128])
    assert (type(small).__name__, small.targets) == ("WindowMoment", (1, 3))
    assert raw.live(["red"]).describe() == "finding all “red”"


def test_arguments_that_do_not_suit_the_kind_of_look_are_refused(raw, picture):
    refused(r"how: expected 'fovea', 'windows' or 'auto' for a stream; .* got head", raw.live, "red", how="head")
    refused(r"target: expected one class, or None; .* how='windows'", raw.live, ["red", "blue"], how="fovea")
    refused(r"start: expected None for frames that are looked at by windows", raw.live, "red", how="windows", start=3)
    live = raw.live("red", start=3)
    refused("start: expected None", live.step, picture)
    running = raw.live(how="windows")
    running.step(picture)
    with pytest.raises(
        InputError, match=r"frame: expected 1024 × 768 pixels, the size of the first frame, got 1024 × 700"
    ):
        running.step(picture[:, :700])
    refused(r"frame: expected a picture, got None \(OpenCV gives None after the last frame", running.step, None)
