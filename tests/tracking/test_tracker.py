"""Objects through a stream of looks: numbers, places, and the probability while they are not seen."""

import cv2
import numpy as np
import pytest
import torch

from semfov.motion import CameraStep, Motion
from semfov.motion.patches import FollowedPatches, PatchFlow
from semfov.tracking import Seen, Tracker, TrackingModel
from semfov.tracking.gain import value_of_windows
from semfov.zoom.lattice import Lattice
from tests.motion.test_camera import scene
from tests.motion.test_patches import HIGH, WIDE, paste, textured

WHOLE = (0.0, 0.0, 1000.0, 800.0)
FRAME = 0.04


def look(*boxes, score=0.8, region=WHOLE, magnification=1.0, cut=False, label=1, entering=False):
    count = len(boxes)
    return Seen(
        np.array(boxes, dtype=float).reshape(-1, 4), np.full(count, score), np.full(count, label),
        np.full(count, cut), region, magnification, entering=np.full(count, entering),
    )  # fmt: skip


def box_at(x, y, wide=40, high=60):
    return x, y, x + wide, y + high


def test_an_object_keeps_its_number_behind_something():
    """It moves by 6 px a frame, is looked at in each fourth frame, and is hidden for 20 frames."""
    tracker = Tracker()
    for frame in range(60):
        tracker.follow(FRAME)
        x = 100 + 6 * frame
        if frame % 4 == 0 and not 24 < frame < 45:
            tracker.see(look(box_at(x, 300)))
    (number,) = tracker.tracks.track_ids.tolist()
    assert number == 1
    # The last look was at frame 56.
    assert tracker.tracks.boxes[0].tolist() == pytest.approx(box_at(x, 300), abs=4)
    assert tracker.tracks.velocities[0].tolist() == pytest.approx([6 / FRAME, 0], abs=10)


def test_two_objects_that_cross_keep_their_numbers():
    tracker = Tracker()
    for frame in range(40):
        tracker.follow(FRAME)
        tracker.see(look(box_at(100 + 8 * frame, 300), box_at(412 - 8 * frame, 330)))
    ends = dict(zip(tracker.tracks.track_ids.tolist(), tracker.tracks.boxes[:, 0].tolist(), strict=True))
    assert ends == pytest.approx({1: 412, 2: 100}, abs=3)


def test_looking_where_it_should_be_and_not_finding_it_is_evidence_against_it():
    tracker = Tracker()
    tracker.see(look(box_at(100, 100)))
    (before,) = tracker.tracks.existence
    tracker.see(look(region=(500, 500, 900, 700)))
    assert tracker.tracks.existence.tolist() == [before]  # the look was elsewhere
    tracker.see(look(region=(0, 0, 400, 400), magnification=0.05))
    (faint,) = tracker.tracks.existence
    tracker.see(look(region=(0, 0, 400, 400)))
    (close,) = tracker.tracks.existence
    # A look from far away says less than one from nearby.
    assert before > faint > close
    assert before - faint < faint - close
    detected_from_afar = TrackingModel().detects(np.sqrt(40 * 60) * 0.05)
    expected = np.log(before / (1 - before)) + 0.3 * np.log(1 - detected_from_afar) + np.log(1 - 0.9 * before)
    assert np.log(close / (1 - close)) == pytest.approx(expected, abs=1e-6)
    for _ in range(40):
        tracker.see(look(region=(0, 0, 400, 400)))
        tracker.follow(FRAME)
    assert not len(tracker.tracks)  # it is forgotten


def test_an_object_that_stands_still_does_not_drift_by_the_noise_of_its_places():
    tracker, random = Tracker(), np.random.default_rng(0)
    for _ in range(12):
        for _ in range(10):
            tracker.follow(FRAME)
        x, y = 300 + 3 * random.normal(size=2)
        tracker.see(look(box_at(x, y)))
    seen = tracker.tracks.boxes
    assert not tracker.tracks.moves.any()
    for _ in range(25):
        tracker.follow(FRAME)
    torch.testing.assert_close(tracker.tracks.boxes, seen)


def followed(shift, frames=12):
    """Track a textured box that moves by a shift a frame over a ground that moves, looked at in the first frame."""
    tracker, flow, ground_shift = Tracker(), PatchFlow(), np.array([3, 2])
    ground = cv2.cvtColor(scene(0, side=700), cv2.COLOR_RGB2GRAY)
    for number in range(frames):
        x, y = 100 - number * ground_shift
        frame = ground[y : y + 400, x : x + 600].copy()
        place = np.array([120, 120]) + number * (ground_shift + shift)
        paste(frame, textured(1), *place)
        flow.step(frame)
        if number:
            tracker.follow(FRAME, CameraStep(Motion.similarity(shift=tuple(ground_shift))), flow)
        else:
            tracker.see(look(box_at(*place, WIDE, HIGH)))
    return tracker.tracks, place


@pytest.mark.parametrize("shift", [(0, 0), (6, 0), (-3, 7)])
def test_an_object_is_followed_between_looks(shift):
    tracks, place = followed(np.array(shift))
    assert tracks.boxes[0, :2].tolist() == pytest.approx(place.tolist(), abs=2)
    assert tracks.velocities[0].tolist() == pytest.approx([part / FRAME for part in shift], abs=8)


def test_an_object_that_is_seen_to_move_is_more_probable():
    standing, moving = (followed(np.array(shift))[0] for shift in ((0, 0), (6, 0)))
    assert not standing.moves.any()
    assert moving.moves.all()
    assert standing.log_odds[0] == pytest.approx(standing.shown_odds[0])
    assert moving.log_odds[0] == pytest.approx(moving.shown_odds[0] + 1.5, abs=0.01)


def passed(places, walls=()):
    """Track a textured box at the places `x` of frames, behind walls `(x1, x2)`; it is looked at in the first frame."""
    tracker, flow = Tracker(), PatchFlow()
    ground = cv2.cvtColor(scene(0, side=700), cv2.COLOR_RGB2GRAY)[:400, :600]
    for number, x in enumerate(places):
        frame = ground.copy()
        paste_between_pixels(frame, textured(1), x, 120)
        for x1, x2 in walls:
            frame[:, x1:x2] = ground[:, x1:x2]
        flow.step(frame)
        if number:
            tracker.follow(FRAME, flow=flow)
        else:
            tracker.see(look(box_at(x, 120, WIDE, HIGH)))
    return tracker.tracks.boxes[0, :2].tolist()


def paste_between_pixels(frame, patch, x, y):
    """Paste a patch at a place that need not be a whole pixel."""
    to_place = np.array([[1.0, 0, x], [0, 1, y]])
    size = frame.shape[::-1]
    moved = cv2.warpAffine(patch, to_place, size)
    covers = cv2.warpAffine(np.full_like(patch, 255), to_place, size) > 127
    frame[covers] = moved[covers]


def test_an_object_that_is_hidden_goes_on():
    """It moves over a ground that stands, is followed for ten frames, and is not in the next ten."""
    places = 120 + 6 * np.arange(20)
    assert passed(np.where(np.arange(20) < 10, places, -100))[0] == pytest.approx(places[-1], abs=5)


@pytest.mark.parametrize("speed", [3, 6])
def test_an_object_that_goes_behind_a_wall_bit_by_bit_goes_on(speed):
    places = 120 + speed * np.arange(40)
    edge = int(places[15]) + WIDE
    end, _ = passed(places, walls=[(edge, edge + 90)])
    assert end == pytest.approx(places[-1], abs=WIDE)
    assert end > edge


@pytest.mark.parametrize(("speed", "slower"), [(1.5, 1), (2, 1), (3, 1), (6, 1), (2, 12), (3, 12)])
def test_an_object_that_stops_is_not_left_behind(speed, slower):
    """It moves for fifteen frames, stops at once or within half a second, and stands to the end."""
    speeds = speed * (1 - (np.arange(60) - 15) / slower).clip(0, 1)
    places = 120 + np.cumsum(speeds)
    assert passed(places) == pytest.approx([places[-1], 120], abs=5)


def test_a_part_of_an_object_that_moves_is_not_more_probable():
    """A whole object, its upper half, which is shown faintly, and another object beside them move alike."""
    tracker = Tracker()
    for frame in range(6):
        tracker.follow(FRAME)
        x = 100 + 6 * frame
        tracker.see(look(box_at(x, 300), box_at(x + 80, 300)))
        tracker.see(look(box_at(x, 300, high=25), score=0.3, region=(x - 5.0, 295.0, x + 45.0, 330.0)))
    tracks = tracker.tracks
    assert len(tracks) == 3
    assert tracks.moves.all()
    assert tracks.moving_odds.tolist() == pytest.approx([1.5, 1.5, 0.0], abs=0.01)


def test_an_object_is_predicted_as_before_where_nothing_is_followed():
    """Before the first two frames a flow follows nothing."""
    tracks = []
    for flow in (None, PatchFlow()):
        tracker = Tracker()
        for frame in range(8):
            tracker.follow(FRAME, flow=flow)
            tracker.see(look(box_at(100 + 6 * frame, 300)))
        tracks.append(tracker.tracks)
    assert tracks[0].boxes.tolist() == tracks[1].boxes.tolist()
    assert tracks[0].probability.tolist() == tracks[1].probability.tolist()


def test_a_probability_falls_with_time_by_the_share_that_is_lost():
    tracker = Tracker()
    tracker.see(look(box_at(100, 100)))
    (before,) = tracker.tracks.existence
    for _ in range(50):
        tracker.follow(FRAME)
    assert tracker.tracks.existence[0] == pytest.approx(before * (1 - TrackingModel().loss) ** 2)


def test_a_later_detection_takes_back_what_misses_took():
    tracker = Tracker()
    tracker.see(look(box_at(100, 100)))
    (before,) = tracker.tracks.existence
    tracker.see(look(region=(0, 0, 400, 400)))
    tracker.see(look(box_at(100, 100), score=0.1))
    assert tracker.tracks.existence[0] == pytest.approx(before)


def test_what_the_border_of_a_window_cuts_begins_no_object_and_is_no_miss():
    tracker = Tracker()
    tracker.see(look(box_at(100, 100), cut=True))
    assert not len(tracker.tracks)
    tracker.see(look(box_at(100, 100)))
    before = tracker.tracks.log_odds.copy()
    tracker.see(look(box_at(100, 100, wide=35), cut=True))
    assert tracker.tracks.log_odds.tolist() == before.tolist()


def test_objects_move_with_the_camera():
    """A camera that turns and zooms over objects that stand still."""
    tracker, first = Tracker(), box_at(300, 200)
    tracker.see(look(first))
    step = Motion.similarity(shift=(4, -2), turn=0.5, scale=1.004)
    since = Motion.still()
    for _ in range(20):
        tracker.follow(FRAME, CameraStep(step))
        since = since.then(step)
    torch.testing.assert_close(tracker.tracks.boxes, since.boxes(torch.tensor([first]).float()), atol=0.01, rtol=0)


def test_objects_of_a_lost_scene_come_back_with_their_numbers():
    tracker = Tracker()
    tracker.see(look(box_at(300, 200)))
    tracker.follow(FRAME, CameraStep(None, waits=True))
    assert not len(tracker.tracks)
    tracker.see(look(box_at(700, 500)))
    tracker.follow(FRAME, CameraStep(Motion.still(), recovered=Motion.similarity(shift=(10, 0))))
    assert sorted(tracker.tracks.track_ids.tolist()) == [1, 2]
    assert tracker.tracks.boxes[0].tolist() == pytest.approx(box_at(310, 200))


def test_after_a_cut_nothing_of_the_old_scene_is_left():
    tracker = Tracker()
    tracker.see(look(box_at(300, 200)))
    tracker.follow(FRAME, CameraStep(None))
    tracker.follow(FRAME, CameraStep(Motion.still(), recovered=Motion.still()))
    assert not len(tracker.tracks)


def test_memory_stays_flat_on_a_flight_that_never_returns():
    """Six hundred frames with a new object in each tenth: what was left behind is forgotten."""
    tracker, counts = Tracker(), []
    for frame in range(600):
        tracker.follow(FRAME, CameraStep(Motion.similarity(shift=(-12, 0))))
        tracker.see(look(*([box_at(900, 300)] if frame % 10 == 0 else []), region=(600, 0, 1000, 800)))
        counts.append(len(tracker.tracks))
    assert max(counts[300:]) <= max(counts[:300]) < 30


def test_a_window_is_worth_the_objects_that_it_puts_right():
    """By the definition: each object whose box lies in a window, one by one."""
    lattice, tracker = Lattice.over((1600, 1200), (400, 400)), Tracker()
    tracker.see(look(box_at(100, 200), box_at(900, 640), box_at(1500, 1100), region=(0, 0, 1600, 1200)))
    tracker.follow(np.log(2) / TrackingModel().staleness)  # half of the evidence of the look is left
    tracks = tracker.tracks
    for level in range(1, lattice.levels):
        values = value_of_windows(tracks, tracker.model, lattice, level)
        shown = tracker.model.detects(tracks.sides * lattice.magnifications[level])
        gains = tracks.existence * shown * (1 - tracks.fits * 0.5)
        across, down = lattice.places(level)
        actions = torch.tensor([[level, x, y] for y in range(down) for x in range(across)])
        windows, boxes = lattice.boxes(actions)[:, None], tracks.boxes[None]
        holds = ((windows[..., :2] <= boxes[..., :2]) & (windows[..., 2:] >= boxes[..., 2:])).all(-1)
        expected = (holds * torch.from_numpy(gains)).sum(-1).view(down, across)
        np.testing.assert_allclose(values, expected.numpy(), atol=1e-5)
        assert values.max() > 0


def test_an_object_that_stands_is_looked_at_again_though_its_box_fits():
    """Flow keeps the boxes of two objects that stand, of which the second was shown last."""
    tracker, lattice = Tracker(), Lattice.over((1600, 1200), (400, 400))
    for x in (100, 1400):
        for _ in range(2):
            tracker.see(look(box_at(x, 200), region=(x - 100.0, 0.0, x + 200.0, 1200.0)))
            for _ in range(12):
                tracker.follow(FRAME, flow=Standing())
    assert tracker.tracks.fits.min() > 0.98
    values = value_of_windows(tracker.tracks, tracker.model, lattice, 1)
    assert values[:, 0].max() > 1.5 * values[:, -1].max() > 0.03


class Standing(PatchFlow):
    """A flow that follows each box to where it was."""

    def follow(self, boxes, expected):
        centres = (boxes[:, :2] + boxes[:, 2:]) / 2
        return FollowedPatches(centres, np.ones(len(boxes), bool), np.zeros(len(boxes)))


def test_an_object_that_stands_stays_where_it_was_seen_whatever_flow_says():
    """Flow is off by some tenths of a pixel in each frame, to and fro, for ten seconds without a look."""
    tracker, random = Tracker(), np.random.default_rng(1)

    class Trembling(Standing):
        def follow(self, boxes, expected):
            still = super().follow(boxes, expected)
            return still._replace(places=still.places + random.normal(0, 0.3, still.places.shape))

    tracker.see(look(box_at(300, 200)))
    for _ in range(25):
        tracker.follow(FRAME, flow=Standing())
    assert not tracker.tracks.moves.any()
    before = tracker.tracks.boxes
    for _ in range(250):
        tracker.follow(FRAME, flow=Trembling())
        torch.testing.assert_close(tracker.tracks.boxes, before, atol=1e-3, rtol=0)


def test_objects_of_a_disturbance_are_none_of_the_scene():
    """Nothing was known when the camera lost the scene, so nothing comes back with it."""
    tracker = Tracker()
    for _ in range(2):
        tracker.follow(0.1, CameraStep(None, waits=True))
        tracker.see(look(box_at(100, 100)))
    tracker.follow(0.1, CameraStep(None, Motion.similarity(shift=(50, 0)), waits=False))
    assert not len(tracker.tracks)


def test_classes_stay_apart_beyond_the_border_of_the_frame():
    tracker = Tracker()
    box = (-80.0, -60.0, -40.0, -1.0)
    wide = (-200.0, -200.0, 400.0, 400.0)
    tracker.see(look(box, region=wide, label=1))
    tracker.see(look(box, region=wide, label=2))
    assert sorted(tracker.tracks.labels.tolist()) == [1, 2]


def test_what_the_camera_has_turned_away_from_does_not_come_back_mirrored():
    """It turns by 180 degrees about an axis in the frame: then all that was in front of it is behind."""
    focal = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    angle = np.radians(10)
    turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    step = CameraStep(Motion(focal @ turn @ np.linalg.inv(focal)))
    tracker = Tracker()
    tracker.see(look(box_at(300, 200)))
    for _ in range(18):
        tracker.follow(FRAME, step)
    assert not len(tracker.tracks)


def test_a_fast_object_moves_for_certain_and_without_a_warning():
    tracker = Tracker()
    for frame in range(30):
        tracker.follow(1 / 30)
        tracker.see(look(box_at(100 + 20 * frame, 300)))
    assert tracker.tracks.standing.max() < 1e-6


def test_an_object_that_comes_into_the_frame_is_as_large_as_later_looks_show_it():
    """The camera turns, and more of the object comes in at the right border of the frame in each look."""
    tracker = Tracker()
    for step, wide in enumerate((12, 24, 40, 40)):
        if step:
            tracker.follow(0.1, CameraStep(Motion.similarity(shift=(-14, 0))))
        x = 988 - 14 * step
        tracker.see(look(box_at(x, 300, wide=wide), entering=wide < 40))
    (number,) = tracker.tracks.track_ids.tolist()
    assert number == 1
    assert tracker.tracks.boxes[0].tolist() == pytest.approx(box_at(x, 300), abs=3)
