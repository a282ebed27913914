"""Tracks of an agent's stream: numbers, files of MOTChallenge, Supervision, and drawings."""

import cv2
import numpy as np
import pytest
import torch

from semfov import InputError, WindowEye, ZoomAgent
from semfov.motion import Motion
from semfov.observation.matching import box_iou
from semfov.paths import WindowMoment
from semfov.settings import StreamSettings
from semfov.viz.live import draw_moment
from semfov.zoom.evidence import GlimpseEvidence
from tests.motion.test_camera import scene
from tests.zoom.test_carrying import RED, Patches

COVERED = range(14, 20)  # frames in which the square is behind something


def frames(count=40):
    """A still camera, and a red square that moves by 5 px a frame over a ground with texture."""
    ground = scene(2, side=1100)[:768, :1024] // 2 + 40
    for number in range(count):
        frame = ground.copy()
        x, y = 100 + 5 * number, 300 + 2 * number
        if number not in COVERED:
            cv2.rectangle(frame, (x, y), (x + 39, y + 39), (255, 0, 0), -1)
        yield frame, torch.tensor([[x, y, x + 40.0, y + 40.0]])


@pytest.fixture(scope="module")
def moments():
    agent = ZoomAgent(WindowEye(Patches()), GlimpseEvidence(2)).eval()
    episode = agent.stream(None, (RED,), StreamSettings(rate=0.75, score_threshold=0.1))
    return [(episode.step(frame), frame, box) for frame, box in frames()]


def test_a_moving_object_keeps_one_number_through_an_occlusion(moments):
    last, _, box = moments[-1]
    fits = box_iou(last.tracks.boxes, box)[:, 0]
    number = int(last.tracks.track_ids[fits.argmax()])
    assert float(fits.max()) > 0.5
    numbers = [set(moment.tracks.track_ids.tolist()) for moment, _, _ in moments]
    first = next(frame for frame, there in enumerate(numbers) if number in there)
    assert first < COVERED.start
    assert all(number in there for there in numbers[first:])


def test_objects_have_the_numbers_of_their_tracks(moments):
    for moment, _, _ in moments:
        objects = moment.objects
        assert set(objects.track_ids.tolist()) <= set(moment.tracks.track_ids.tolist())
        assert bool((objects.passes < len(moment)).all())


def test_a_file_of_motchallenge_has_the_objects_counted_from_one(moments):
    moment = next(each for each, _, _ in reversed(moments) if len(each.objects))
    rows = [[float(value) for value in line.split(",")] for line in moment.to_mot().splitlines()]
    assert len(rows) == len(moment.objects)
    for row, number, box, score in zip(
        rows, moment.objects.track_ids, moment.objects.boxes, moment.objects.scores, strict=True
    ):
        frame, identity, left, top, wide, high, confidence, *rest = row
        assert (frame, identity, rest) == (moment.number + 1, int(number), [-1, -1, -1])
        back = torch.tensor([left - 1, top - 1, left - 1 + wide, top - 1 + high])
        torch.testing.assert_close(back, box, atol=0.011, rtol=0)
        assert confidence == pytest.approx(float(score), abs=1e-4)


def test_supervision_has_the_numbers_as_its_own(moments):
    pytest.importorskip("supervision")
    moment = next(each for each, _, _ in reversed(moments) if len(each.objects))
    assert moment.to_supervision().tracker_id.tolist() == moment.objects.track_ids.tolist()


def test_a_moment_is_saved_and_loaded_with_its_tracks(moments, tmp_path):
    moment = moments[-1][0]
    moment.save(tmp_path / "moment.safetensors")
    loaded = WindowMoment.load(tmp_path / "moment.safetensors")
    assert torch.equal(loaded.objects.track_ids, moment.objects.track_ids)
    assert torch.equal(loaded.tracks.boxes, moment.tracks.boxes)
    assert loaded.ways == moment.ways


def test_the_way_of_an_object_is_drawn_where_it_was(moments):
    moment, frame, _ = next(each for each in reversed(moments) if each[0].ways and len(each[0].objects))
    image = torch.from_numpy(frame).permute(2, 0, 1)
    way = next(way for way in moment.ways.values() if len(way) > 4)
    drawn = draw_moment(image, moment, "red", moment.size).astype(int)
    x, y = way[len(way) // 2]
    around = slice(int(y) - 2, int(y) + 3), slice(int(x) - 2, int(x) + 3)
    assert abs(drawn[around] - frame[around]).max() > 20


def test_several_passes_at_a_frame_are_looks_without_time_between_them():
    agent = ZoomAgent(WindowEye(Patches()), GlimpseEvidence(2)).eval()
    twice, once = (agent.stream(None, (RED,), StreamSettings(passes=passes)) for passes in (2, 1))
    for frame, _ in frames(6):
        moment = twice.step(frame)
        first = once.step(frame)
        second = once.step(frame, passed=0.0)
        for mine, its in ((moment.looks[-2], first.looks[-1]), (moment.looks[-1], second.looks[-1])):
            assert mine.shown.window == its.shown.window
        assert moment.tracks.track_ids.tolist() == second.tracks.track_ids.tolist()
        torch.testing.assert_close(moment.tracks.boxes, second.tracks.boxes)
        torch.testing.assert_close(moment.candidates.scores, second.candidates.scores)
    assert (moment.number, twice.passes) == (5, 12)
    # A trail has one place of each frame.
    known = (~torch.from_numpy(moment.tracks.trail[..., 0]).isnan()).sum(-1)
    assert int(known.max()) <= 6


def textured_frames(count, camera_step):
    """A red square with texture that moves by 5 and 3 px a frame in a scene over which the camera moves."""
    ground = scene(2, side=1100) // 2 + 40
    square = np.zeros((48, 48, 3), np.uint8)
    square[..., 0] = np.kron(np.random.default_rng(3).integers(190, 256, (6, 6)), np.ones((8, 8)))
    for number in range(count):
        view = ground.copy()
        x, y = 400 + 5 * number, 420 + 3 * number
        view[y : y + 48, x : x + 48] = square
        left, top = 20 + number * camera_step[0], 20 + number * camera_step[1]
        yield view[top : top + 768, left : left + 1024], Motion.similarity(shift=(20 - left, 20 - top))


def test_a_pose_that_is_refused_does_not_move_the_flow_on():
    """The same frame may be given again, with another pose."""
    velocities = []
    agent = ZoomAgent(WindowEye(Patches()), GlimpseEvidence(2)).eval()  # one, as its evidence is drawn
    for refused_pose in (None, np.full((3, 3), np.nan)):
        episode = agent.stream(None, (RED,), StreamSettings(), follows=True)
        for number, (frame, pose) in enumerate(textured_frames(3, (4, 2))):
            if number == 2 and refused_pose is not None:
                with pytest.raises(InputError, match="3 × 3 matrix"):
                    episode.step(frame, pose=refused_pose)
            moment = episode.step(frame, pose=pose)
        velocities.append(moment.tracks.velocities)
    torch.testing.assert_close(velocities[0], velocities[1])


@pytest.mark.parametrize("is_pose_given", [False, True])
def test_an_object_is_followed_by_flow_with_known_poses_too(is_pose_given):
    """After two frames its velocity is known as well as flow tells it: two detections tell it half as well."""
    agent = ZoomAgent(WindowEye(Patches()), GlimpseEvidence(2)).eval()
    episode = agent.stream(None, (RED,), StreamSettings(), follows=True)
    for frame, pose in textured_frames(2, (4, 2)):
        moment = episode.step(frame, pose=pose if is_pose_given else None)
    (velocity,) = moment.tracks.velocities.tolist()
    assert velocity == pytest.approx([5 / 0.04, 3 / 0.04], abs=40)
    assert moment.tracks.kinematics.covariance[0, 1, 1] ** 0.5 < 30
