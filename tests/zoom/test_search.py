"""Searches by windows in pictures, and in frames that follow each other."""

import math
import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from torchvision.transforms.functional import to_pil_image

from semfov import ActivePerception, Detections, InputError, WindowEye, ZoomAgent
from semfov.agents.picture import OpenedPicture
from semfov.agents.window_objects import without_replaced
from semfov.data.images import to_bytes
from semfov.data.large import open_large
from semfov.settings import ExploreSettings, FindSettings, SearchSettings, StreamSettings
from semfov.zoom import GlimpseEvidence, Lattice, merge
from semfov.zoom.looks import LiveWindowLooks, Window, WindowLook
from tests.refusals import refused
from tests.small import agent as foveal_agent
from tests.zoom.test_closer import Fickle, Sized, evidence


def test_search_finds_a_target_in_the_picture_and_ends_without_one(agent, picture):
    path = agent.search(picture, "red")
    assert path.decision.outcome == "found"
    assert path.decision.probability >= 0.3
    x1, y1, x2, y2 = path.decision.box.tolist()
    assert max(x1, 640) < min(x2, 672)
    assert max(y1, 320) < min(y2, 352)
    assert path.passes == len(path.window_looks)
    path = agent.search(picture, "green", SearchSettings(passes=7))
    assert path.decision.outcome in ("absent", "undecided")
    assert path.passes <= 7
    assert path.decision.box is None


def test_scores_count_from_where_the_detector_says(agent, picture):
    """Also where evidence makes no probabilities of them; as the scores of a fovea do."""
    detector = agent.eye.detector
    usual = detector.score_threshold
    detector.score_threshold = 0.2
    for known in (None, agent.evidence):
        raw = ZoomAgent(WindowEye(detector), known)
        assert raw.find_all(picture, "blue", FindSettings(passes=1)).score_threshold == 0.2
        assert raw.find_all(picture, "blue", FindSettings(passes=1, score_threshold=0.4)).score_threshold == 0.4
    detector.score_threshold = usual


def test_a_record_keeps_its_reduced_picture_and_the_file(agent, picture, tmp_path):
    """However the file is given, also opened."""
    file = tmp_path / "squares.png"
    to_pil_image(torch.nn.functional.pad(picture, (0, 976))).save(file)
    for given in (file, str(file), open_large(file)):
        path = agent.find_all(given, "blue", FindSettings(passes=2))
        assert path.source == str(file)
        assert path.image.shape == (3, 492, 1280)
        assert path.plot().axes[0].images
    assert agent.search(picture, "red", SearchSettings(passes=2)).source is None


def test_the_records_of_each_look_have_the_picture(agent, picture):
    """So that they can be drawn while the episode runs."""
    for look, settings in (
        (partial(agent.search, picture, "green"), SearchSettings),
        (partial(agent.explore, picture), ExploreSettings),
    ):
        seen = []
        whole = look(settings(passes=2, on_look=seen.append))
        assert len(seen) == 2
        assert all(torch.equal(record.photograph, whole.photograph) for record in seen)
        assert seen[1].plot().axes[0].images


def test_find_all_finds_one_class_and_explore_finds_all(agent, picture):
    path = agent.find_all(picture, "blue", FindSettings(passes=30, min_gain=0.0))
    assert path.target == 3
    assert (path.objects.labels == 3).all()
    assert len(path.objects.above(0.3))
    everything = agent.find_all(picture, settings=FindSettings(passes=24, batch=3, min_gain=0.0))
    assert set(everything.objects.above(0.3).labels.tolist()) == {1, 3}
    assert everything.target is None
    assert everything.passes <= 24
    assert agent.find_all(picture, "blue", FindSettings(min_gain=1e9)).passes == 1


def test_a_path_tells_why_it_ended(agent, picture):
    found = agent.search(picture, "red")
    assert (found.ending, found.decision.outcome) == ("decision", "found")
    # The last pass decides, too.
    again = agent.search(picture, "red", SearchSettings(passes=found.passes))
    assert (again.ending, again.why_it_ended()) == ("decision", found.why_it_ended())
    early = agent.search(picture, "red", SearchSettings(passes=found.passes - 1))
    assert early.decision.outcome == "undecided"
    assert (early.ending, early.why_it_ended()) == ("passes", f"All {early.passes} passes were used.")
    hopeless = agent.search(picture, "green", SearchSettings(stop_below=1.0))
    assert (hopeless.passes, hopeless.ending) == (1, "decision")
    # Without a limit to what is worth a look, a search looks at everything.
    everything = agent.search(picture, "green", SearchSettings(passes=10_000, confirm=1.0, stop_below=0.0))
    assert (everything.ending, everything.decision.outcome) == ("windows", "undecided")
    assert everything.why_it_ended() == "No window is left that can show more."
    assert agent.explore(picture, ExploreSettings(passes=1)).why_it_ended() == "The only pass was used."
    assert agent.find_all(picture, "blue", FindSettings(min_gain=1e9)).ending == "min_gain"
    assert agent.find_all(picture, "blue", FindSettings(passes=3, min_gain=0.0)).ending == "passes"
    assert replace(found, ending=None).why_it_ended() == ""


def test_zooming_pays_only_for_large_pictures(agent, picture):
    kinds = [
        OpenedPicture.of(each).kind("auto", agent.eye.detector.input_size) for each in (picture, picture[:, :200, :300])
    ]
    assert kinds == ["windows", "fovea"]


def test_invalid_arguments_are_refused(agent, picture, detector):
    refused("did you mean 'red'", agent.search, picture, "rad")
    refused("shifts: expected none for .* by windows", agent.search, picture, "red", SearchSettings(shifts=3))
    refused("duration: expected none for .* by windows", agent.find_all, picture, "red", FindSettings(duration=1.0))
    refused("policy: expected none for .* by windows", agent.explore, picture, ExploreSettings(policy="people"))
    for target in (0, 4, 1.0, True, [], [1, 4]):
        with pytest.raises(
            InputError, match=r"target: expected a (name, or a whole number from 1 to 3|class, several)"
        ):
            agent.find_all(picture, target)
    for image, message in (
        (picture * 255, "picture: expected RGB in .*; divide by"),
        (picture * torch.nan, "picture: expected RGB in .*NaN"),
        (picture.long(), "picture: expected bytes, 16-bit numbers or floats"),
        (picture[:2], "picture: expected a picture of shape"),
        (picture[:, :0], "picture: expected at least one pixel"),
        (7, "picture: expected a path"),
    ):
        refused(message, agent.explore, image)
    with pytest.raises(InputError, match="evidence: expected one for the detector's 3 classes, got 5"):
        ZoomAgent(WindowEye(detector), GlimpseEvidence(5))
    for wrong, message in (({"foresight": 2}, "foresight"), ({"classes": 0}, "classes")):
        refused(message, GlimpseEvidence, **wrong)


def make_look(level, column, row, boxes, scores, cut):
    lattice = Lattice.over((1024, 768), (128, 128))
    vectors = torch.zeros(1, len(boxes), 3)
    vectors[0, :, 1] = torch.tensor(scores)
    vectors[0, :, 0] = 1 - vectors[0, :, 1]
    detections = Detections(torch.tensor(boxes)[None], vectors, torch.ones(1, len(boxes), dtype=torch.bool))
    return WindowLook(Window.on(lattice, (level, column, row)), detections, torch.tensor(cut), torch.zeros(2), None)


def test_merging_keeps_small_objects_in_front_of_large_ones():
    look = make_look(1, 0, 0, [[0.0, 0, 200, 200], [50.0, 50, 90, 90]], [0.9, 0.8], [False, False])
    assert len(merge([look])) == 2
    assert len(merge([look], score=0.85)) == 1
    assert len(merge([])) == 0


def test_the_score_of_an_object_is_the_highest_of_its_looks():
    """As where slices are merged by suppression; its box is that of the sharpest look."""

    def look(magnification, box, score):
        vector = torch.tensor([[[1 - score, score, 0.0]]])
        seen = Detections(torch.tensor([[box]]), vector, torch.ones(1, 1).bool())
        return WindowLook(
            Window((50.0, 50.0, magnification), 0, (0, 0, 8, 8)), seen, torch.zeros(1).bool(), torch.zeros(2), None
        )

    whole, closer = look(0.2, [10.0, 10, 50, 50], 0.75), look(0.8, [11.0, 12, 51, 50], 0.5)
    elsewhere = look(0.8, [70.0, 10, 90, 50], 0.625)
    objects = merge([whole, closer, elsewhere])
    assert objects.scores.tolist() == [0.75, 0.625]
    assert objects.boxes.tolist() == [[11.0, 12, 51, 50], [70.0, 10, 90, 50]]


def test_looks_treat_cut_boxes_as_their_eye_does(detector, picture):
    found = {}
    for cut in ("keep", "drop", "background"):
        eye = WindowEye(detector, cut=cut)
        view = eye.open(picture)
        window = Window.on(view.lattice, (view.lattice.levels - 1, 33, 15))  # its border lies in the red square
        other = Window.on(view.lattice, (view.lattice.levels - 1, 34, 15))
        found[cut], whole = LiveWindowLooks(eye, view).see([window, other])
        assert whole.detections.mask.shape == (1, len(whole.cut))
    keep, drop, background = found.values()
    assert bool(keep.cut.any())
    assert not bool(drop.cut.any())
    assert torch.equal(background.cut, keep.cut)
    torch.testing.assert_close(drop.detections.boxes, keep.detections.boxes[:, ~keep.cut])
    assert float(background.detections.confidence[0, background.cut].max()) == 0


@pytest.mark.parametrize("learned", [True, False])
def test_a_second_thread_only_prepares_what_the_first_would_do(agent, picture, monkeypatch, learned):
    """The next windows are guessed and resampled while the detector works; records and files are those of one."""
    agent = agent if learned else ZoomAgent(agent.eye).eval()
    prepared, prepare = [], LiveWindowLooks.prepare
    monkeypatch.setattr(
        LiveWindowLooks, "prepare", lambda self, window: (prepared.append(window), prepare(self, window))
    )
    paths = {}
    for cores in (torch.get_num_threads(), torch.get_num_threads() + 1):
        monkeypatch.setattr("semfov.threads.available_cores", lambda cores=cores: cores)
        assert not prepared
        paths[cores] = (
            agent.search(picture, "green", SearchSettings(passes=6)),
            agent.explore(picture, ExploreSettings(passes=6, min_gain=0.0)),
        )
    for alone, helped in zip(*paths.values(), strict=True):
        assert [look.window for look in alone.window_looks] == [look.window for look in helped.window_looks]
        assert alone.values == helped.values
        assert torch.equal(alone.photograph, helped.photograph)
        for name in ("boxes", "scores", "labels", "passes"):
            assert torch.equal(getattr(alone.candidates, name), getattr(helped.candidates, name))
    looked = {look.window for path in paths[cores] for look in path.window_looks}
    assert looked & set(prepared)


@pytest.mark.parametrize(
    ("task", "settings"),
    [
        ("search", SearchSettings(passes=16, confirm=1.0, stop_below=0.0)),
        ("find_all", FindSettings(passes=16, min_gain=0.0)),
    ],
)
def test_a_second_thread_knows_the_window_after_a_look_of_the_last_level(agent, picture, monkeypatch, task, settings):
    small, prepared = picture[:, :400, 300:800], []
    monkeypatch.setattr(LiveWindowLooks, "prepare", lambda self, window: prepared.append(window))
    monkeypatch.setattr("semfov.threads.available_cores", lambda: torch.get_num_threads() + 1)
    path = getattr(agent, task)(small, "green", settings)
    windows, last = [look.window for look in path.window_looks], path.lattice.levels - 1
    # Nothing is prepared during the overview.
    known = [window == prepared[n] for n, window in enumerate(windows[2:]) if windows[n + 1].level == last]
    assert known
    assert all(known)


def same_looks(moments, path):
    """Whether moments hold the looks of a path, to the bit."""
    last = moments[-1]
    assert [moment.window for moment in moments] == [window_look.window for window_look in path.window_looks]
    assert [moment.next_window for moment in moments[:-1]] == [moment.window for moment in moments[1:]]
    assert last.values == path.values
    for look, window_look in zip(last.window_looks, path.window_looks, strict=True):
        assert torch.equal(look.detections.boxes, window_look.detections.boxes)
        assert torch.equal(look.detections.scores, window_look.detections.scores)
    assert torch.equal(last.candidates.boxes, path.candidates.boxes)
    assert torch.equal(last.candidates.scores, path.candidates.scores)
    has_missed = path.decision is not None and path.decision.outcome != "found"
    assert path.object_rows() == ([] if has_missed else last.object_rows())


@pytest.mark.parametrize("target", [None, 3, [1, 3]])
def test_a_still_picture_at_rate_zero_gives_the_looks_of_an_exploration(agent, picture, target, one_thread):
    path = agent.find_all(picture, target, FindSettings(passes=9))
    targets = {None: (), 3: (3,)}.get(target) if not isinstance(target, list) else tuple(target)
    live = agent.stream(None, targets, StreamSettings(rate=0), follows=False)
    moments = [live.step(picture) for _ in path.window_looks]
    same_looks(moments, path)
    assert moments[-1].decision is None
    assert (moments[-1].target, moments[-1].targets) == (path.target, path.targets)
    assert moments[-1].describe() == moments[-1].words.objects == path.words.objects


@pytest.mark.parametrize("kind", ["closely", "plain", "slices"])
def test_a_still_picture_at_rate_zero_gives_the_looks_of_a_search(picture, kind, one_thread):
    """With closer looks, each of which takes a frame, without them, and without fitted models."""
    model = {"closely": evidence(), "plain": GlimpseEvidence(3), "slices": None}[kind]
    agent = ZoomAgent(WindowEye(Sized()), model).eval()
    path = agent.search(picture, "red")
    live = agent.stream(1, (), StreamSettings(rate=0), follows=False)
    moments = [live.step(picture) for _ in path.window_looks]
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
    agent = ZoomAgent(WindowEye(Fickle().eval()), evidence())
    path = agent.search(image, "red", SearchSettings(closer=1))
    live = agent.stream(1, (), StreamSettings(rate=0, closer=1), follows=False)
    moments = [live.step(image) for _ in path.window_looks]
    same_looks(moments, path)
    assert (path.decision.outcome, moments[-1].decision.outcome) == ("absent", "absent")
    assert len(path.closer) == len(moments[-1].closer) == 1


def test_looks_are_forgotten_by_the_seconds_that_passed(agent, picture):
    """A twin keeps the date of each look; the overview is kept until there is a new one."""
    live, dates, now = agent.stream(settings=StreamSettings(rate=math.log(2) / 4.5), follows=False), {}, 0.0
    for passed in (1, 1, 1, 1, 3, 0.5, 6, 1, 1, 1):
        moment = live.step(picture, passed)
        now += passed
        dates[moment.window] = now
        expected = {window for window, date in dates.items() if window.level == 0 or now - date <= 4.5}
        assert {look.window for look in moment.window_looks} == expected
        due = now + passed - next(date for window, date in dates.items() if window.level == 0) > 4.5
        assert due == (moment.next_window.level == 0)
    assert len(dates) > len(expected)


@pytest.mark.slow
def test_objects_that_move_or_leave_are_forgotten(agent):
    """A square jumps to another place: soon it is shown there, and nowhere else."""

    def frame(x):
        image = torch.zeros(3, 768, 1024)
        image[:, [0, 0, -1, -1], [0, -1, 0, -1]] = 0.02  # no blank ground
        image[0, 320:352, x : x + 32] = 1
        return image

    live = agent.stream(settings=StreamSettings(rate=1), follows=False)
    kept = agent.stream(settings=StreamSettings(rate=0), follows=False)
    for x in [160] * 24 + [800] * 20:
        moment, old = live.step(frame(x)), kept.step(frame(x))
        if x == 160:
            before = moment.objects
    assert ((before.boxes[:, 0] - 160).abs() < 17).all()
    assert ((moment.objects.boxes[:, 0] - 800).abs() < 17).all()
    assert len(before) > 0
    assert len(moment.objects) > 0
    assert (old.objects.boxes[:, 0] < 500).any(), "at rate 0 nothing is forgotten"


def test_a_found_target_is_lost_when_it_leaves(picture):
    agent = ZoomAgent(WindowEye(Sized()), evidence())
    live = agent.stream(1, (), StreamSettings(rate=1), follows=False)
    found = [live.step(picture).decision.outcome for _ in range(16)]
    gone = [live.step(torch.zeros_like(picture)).decision for _ in range(50)]
    assert "found" in found
    assert [decision.outcome for decision in gone[-5:]] != ["found"] * 5
    assert gone[-1].outcome != "found"


def test_a_later_look_as_close_replaces_what_earlier_ones_showed():
    """Brute force over every pair of a box and a later window."""
    lattice, generator = Lattice.over((1024, 768), (128, 128)), torch.Generator().manual_seed(0)
    windows = [(0, 0, 0), (1, 4, 4), (2, 8, 8), (1, 0, 0), (2, 20, 20), (0, 0, 0), (2, 10, 9)]
    looks = []
    for action in windows:
        low = torch.rand(6, 2, generator=generator) * 700
        boxes = torch.cat([low, low + 40], -1)[None]
        detections = Detections(boxes, torch.full((1, 6, 3), 0.5), torch.ones(1, 6, dtype=torch.bool))
        looks.append(WindowLook(Window.on(lattice, action), detections, torch.arange(6) % 2 == 0, torch.zeros(2), None))
    kept = without_replaced(looks, lattice)
    for number, (window_look, left) in enumerate(zip(looks, kept, strict=True)):
        expected = []
        for place, (x1, y1, x2, y2) in enumerate(window_look.detections.boxes[0].tolist()):
            hidden = False
            for later in looks[number + 1 :]:
                a, b, c, d = later.window.region(lattice)
                w, h = (x2 - x1) / 2, (y2 - y1) / 2
                inside = (
                    a <= max(x1 - w, 0) and b <= max(y1 - h, 0) and min(x2 + w, 1024) <= c and min(y2 + h, 768) <= d
                )
                hidden |= inside and later.window.level >= window_look.window.level
            if not hidden:
                expected.append(place)
        assert torch.equal(left.detections.boxes[0], window_look.detections.boxes[0, expected])
        assert torch.equal(left.cut, window_look.cut[expected])
    assert sum(len(look.cut) for look in kept) < sum(len(look.cut) for look in looks)


@pytest.fixture
def raw(detector):
    agent = ActivePerception.raw(detector)
    return agent


def test_the_first_frame_decides_how_a_stream_is_looked_at(detector, picture):
    foveal = foveal_agent(detector)
    for size, how, kind in ((128, "fovea", "FoveaMoment"), (1024, "windows", "WindowMoment")):
        live = foveal.live("red")
        assert live.how == "auto"
        moment = live.step(picture[:, :size, :size])
        assert (live.how, type(moment).__name__) == (how, kind)
        assert moment.describe().startswith("red: ") or "p(red)" in moment.describe()
    assert type(foveal.live("red", how="fovea").step(picture)).__name__ == "FoveaMoment"
    small = foveal.live(["red", "blue"]).step(picture[:, :128, :128])
    assert (type(small).__name__, small.targets) == ("WindowMoment", (1, 3))
    assert foveal.live(["red"]).describe() == "finding all “red”"


def test_an_agent_with_raw_scores_looks_at_photographs_by_windows(raw, picture):
    photograph = picture[:, :128, :128]
    assert [raw.search(photograph, "red", **how).how for how in ({}, {"how": "fovea"})] == ["windows", "fovea"]
    assert raw.search(photograph, "red", start=3).how == "fovea"
    assert raw.explore(photograph).how == "windows"
    live = raw.live("red")
    live.step(photograph)
    assert live.how == "windows"


def test_arguments_that_do_not_suit_the_kind_of_look_are_refused(raw, picture):
    refused(r"how: expected 'fovea', 'windows' or 'auto' for a stream; .* got head", raw.live, "red", how="head")
    refused(
        r"target: expected one class by its name, .* how='windows', .* got a list",
        raw.live,
        ["red", "blue"],
        how="fovea",
    )
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


def told(record):
    """All that a record tells, but the time that its looks took."""
    values = record.to_dict()
    for row in values["looks"]:
        del row["seconds"]
    unseen = record.unseen
    objects = [getattr(record.candidates, name).tolist() for name in ("boxes", "scores", "labels", "passes")]
    return record.found, record.describe(), values, unseen, objects, record.photograph.tolist()


@pytest.mark.parametrize("learned", [True, False])
@pytest.mark.parametrize("target", [None, 1, [1, 3]])
def test_a_moment_that_is_read_later_is_the_one_that_is_read_at_once(agent, picture, learned, target, one_thread):
    """A camera moves, looks fade, and each frame is written over the one before."""
    agent = agent if learned else ZoomAgent(agent.eye).eval()
    targets = tuple(target) if isinstance(target, list) else ()

    def moments():
        live = agent.stream(None if targets else target, targets, StreamSettings(rate=0.5))
        buffer = np.empty((600, 800, 3), np.uint8)
        pixels = to_bytes(picture)
        for number in range(8):
            buffer[:] = pixels[number : number + 600, 9 * number : 9 * number + 800]
            yield live.step(buffer, 0.2, pose=[[1, 0, -9 * number], [0, 1, -number]])

    at_once = [told(moment) for moment in moments()]
    kept = list(moments())
    copies = pickle.loads(pickle.dumps(kept))
    assert [told(moment) for moment in kept] == at_once
    assert [told(moment) for moment in copies] == at_once
    assert any(objects[0] for *_, objects, _ in at_once)


def test_a_record_of_a_look_that_is_read_later_is_the_one_that_is_read_at_once(agent, picture, one_thread):
    for look, settings in (
        (partial(agent.search, picture, "red"), SearchSettings(passes=4)),
        (partial(agent.explore, picture), ExploreSettings(passes=4, min_gain=0.0)),
    ):
        at_once = []
        kept = []
        look(replace(settings, on_look=lambda record, told_so_far=at_once: told_so_far.append(told(record))))
        look(replace(settings, on_look=kept.append))
        assert [told(record) for record in kept] == at_once
