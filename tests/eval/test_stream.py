"""Flights over pictures, ways of looking at their frames, and the tables about them."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
import torch

from eval.stream import main
from eval.stream.drift import Drift
from eval.stream.flights import COURSES, Course, Frame, flight, mot_film, poses
from eval.stream.misses import CAUSES, LISTED, Misses, miss_rows
from eval.stream.plain import PlainRule
from eval.stream.report import (
    by_way,
    course_tables,
    listed_cell,
    plot_passes,
    precision_figures,
    precision_over_passes,
    reliability_cells,
)
from eval.stream.run import FILM, Cost, StreamConfig, StreamOutcome, judged_objects
from eval.stream.ways import AllSlices, Oracle, RoundRobin, WholeFrame, whole_and_slices
from semfov import WindowEye
from semfov.data.scene import Annotation, Scene
from semfov.detection.objects import Objects
from semfov.tracking import Tracks
from semfov.tracking.kalman import Kinematics
from semfov.tracking.tracks import no_trail
from semfov.zoom.lattice import Lattice
from tests.small import Coloured, iou

pytestmark = pytest.mark.usefixtures("few_samples")

PICTURE, FRAME = (1200, 900), (640, 480)
SQUARE = (560, 430, 600, 470)


def scene():
    """Grey patches, and one red square in the middle."""
    random = np.random.default_rng(0)
    pixels = np.full((PICTURE[1], PICTURE[0], 3), 120, np.uint8)
    for size in (160, 80, 40, 20):
        for _ in range((PICTURE[0] // size) ** 2 // 2):
            x, y = (int(random.integers(0, length)) for length in PICTURE)
            cv2.rectangle(pixels, (x, y), (x + size, y + size // 2), [int(random.integers(60, 200))] * 3, -1)
    x1, y1, x2, y2 = SQUARE
    pixels[y1:y2, x1:x2] = (250, 20, 20)
    image = torch.from_numpy(pixels).permute(2, 0, 1).float() / 255
    return Scene(1, "patches", image, torch.tensor([SQUARE]).float(), torch.tensor([1]))


@pytest.mark.parametrize("name", COURSES)
def test_a_course_moves_the_frame_by_its_speed_and_stays_in_the_picture(name):
    course = COURSES[name]
    maps = [*poses(course, PICTURE, FRAME, 200, 3)]
    middle = torch.tensor([FRAME]).double() / 2
    centres = torch.cat([each.inverse().points(middle) for each in maps])
    steps = (centres[1:] - centres[:-1]).norm(dim=-1)
    if not course.shake:
        torch.testing.assert_close(steps, torch.full_like(steps, course.speed), atol=1e-9, rtol=0)
        low, high = middle[0], torch.tensor(PICTURE) - middle[0]
        assert bool(((centres >= low - 1e-9) & (centres <= high + 1e-9)).all())
    scales = torch.stack([each.scale_at(middle)[0] for each in maps])
    turns = [np.degrees(np.arctan2(each.matrix[1, 0], each.matrix[0, 0])) for each in maps]
    assert np.ptp(np.unwrap(turns, period=360)) == pytest.approx(199 * course.turn, abs=1e-6)
    factor = max(float(scales.max()), 1 / float(scales.min()))
    assert factor == pytest.approx((1 + course.zoom) ** 100, rel=1e-9)


def test_a_shaking_camera_is_off_its_line_by_the_deviation():
    steady, shaking = ([*poses(Course(shake=shake), PICTURE, FRAME, 2000, 1)] for shake in (0, 5))
    off = np.array([b.matrix[:2, 2] - a.matrix[:2, 2] for a, b in zip(steady, shaking, strict=True)])
    assert off.std(0) == pytest.approx([5, 5], rel=0.1)


@pytest.mark.parametrize("name", ["still", "fast", "turning"])
def test_boxes_of_a_flight_lie_on_the_objects_of_its_frames(name):
    """The box around the red pixels of each frame, which a turn widens."""
    seen = 0
    for frame in flight(scene(), COURSES[name], FRAME, 30, 5):
        ys, xs = (frame.pixels[..., 0].astype(int) - frame.pixels[..., 1] > 100).nonzero()
        if not len(frame.annotation.boxes) or not 4 < xs.min() < xs.max() < FRAME[0] - 4:
            continue
        seen += 1
        around = (xs.min(), ys.min(), xs.max() + 1, ys.max() + 1)
        assert iou(frame.annotation.boxes[0].tolist(), around) > (0.6 if name == "turning" else 0.9)
    assert seen > 5


def test_a_frame_larger_than_the_picture_is_refused(capsys):
    assert main(["--data.limit", "1", "--courses", "[still]", "--width", "4000"]) == 1
    assert "frame: expected no longer than the picture" in capsys.readouterr().err


def test_a_film_of_motchallenge_has_boxes_from_one_and_leaves_out_what_does_not_count(tmp_path):
    (tmp_path / "img1").mkdir()
    (tmp_path / "gt").mkdir()
    for number in (1, 2):
        cv2.imwrite(str(tmp_path / "img1" / f"{number:06d}.jpg"), np.full((60, 80, 3), 90, np.uint8))
    lines = ["1,7,11,21,10,20,1,1,0.8", "2,7,13,21,10,20,1,1,1", "2,8,1,1,30,30,0,1,1", "2,9,71,31,20,40,1,8,1"]
    (tmp_path / "gt" / "gt.txt").write_text("\n".join(lines))
    first, second = mot_film(tmp_path, 3)
    assert first.annotation.boxes.tolist() == [[10, 20, 20, 40]]
    assert first.annotation.labels.tolist() == [3]
    assert second.annotation.boxes.tolist() == [[12, 20, 22, 40], [0, 0, 30, 30], [70, 30, 80, 60]]
    assert second.annotation.crowd.tolist() == [False, True, True]
    assert first.pixels.shape == (60, 80, 3)


def test_drift_is_small_on_a_flight_and_begins_anew_after_a_cut():
    drift, frames = Drift(), [*flight(scene(), Course(speed=6, turn=0.3), FRAME, 12, 2)]
    for frame in frames:
        drift.step(frame)
    assert len(drift.pixels) == 11
    assert max(drift.pixels) < 1.5
    assert drift.lost == 0
    black = Frame(np.zeros_like(frames[0].pixels), frames[0].annotation, frames[0].pose)
    drift.step(black)
    assert (drift.lost, drift.frames, len(drift.pixels)) == (1, 13, 11)


def eye():
    return WindowEye(Coloured(size=(160, 160)))


def test_the_frame_and_its_slices_cover_it_at_native_size():
    whole, *parts = whole_and_slices(Lattice.over(FRAME, (160, 160)))
    assert whole.level == 0
    shown = np.zeros(FRAME[::-1], bool)
    for part in parts:
        x1, y1, x2, y2 = map(int, part.within)
        assert (x2 - x1, y2 - y1, part.fixation[2]) == (160, 160, 1)
        shown[y1:y2, x1:x2] = True
    assert shown.all()


CARRIED = partial(RoundRobin, carries=True)


@pytest.mark.parametrize("make", [AllSlices, WholeFrame, PlainRule, Oracle, CARRIED])
def test_ways_know_where_the_square_is_while_the_camera_moves(make):
    """After one round, in each frame that shows it."""
    way, right, shown = make(eye(), 1), 0, 0
    for number, frame in enumerate(flight(scene(), Course(speed=5), FRAME, 40, 4)):
        *_, objects = way.step(frame).values()
        assert way.remembers or way.passes in (1, 21)
        if number > 24 and len(frame.annotation.boxes):
            shown += 1
            boxes = [iou(box, frame.annotation.boxes[0].tolist()) for box in objects.boxes.tolist()]
            right += max(boxes, default=0) > 0.5
    assert shown > 8
    assert right >= 0.8 * shown


def test_memory_that_stays_where_it_was_is_wrong_once_the_camera_has_moved():
    way, wrong, shown = RoundRobin(eye(), 1, carries=False), 0, 0
    for number, frame in enumerate(flight(scene(), Course(speed=12), FRAME, 40, 4)):
        (objects,) = way.step(frame).values()
        if number > 24 and len(objects):
            shown += 1
            truth = frame.annotation.boxes.tolist()
            wrong += all(iou(box, each) < 0.5 for box in objects.boxes.tolist() for each in truth)
    assert wrong > 0.5 * shown > 0


def test_objects_of_a_frame_are_judged_as_by_hand():
    boxes = torch.tensor([[0.0, 0, 10, 10], [50, 50, 70, 70], [80, 80, 95, 95]])
    annotation = Annotation(boxes, torch.tensor([1, 1, 1]), torch.tensor([False, False, True]), (100, 100))
    found = torch.tensor([[-5.0, -5, 10, 10], [50, 50, 70, 75], [20, 20, 30, 30], [81, 81, 90, 90]])
    objects = Objects(found, torch.tensor([0.9, 0.4, 0.6, 0.8]), torch.ones(4).long(), torch.zeros(4).long())
    record = judged_objects(objects, Frame(np.zeros((100, 100, 3), np.uint8), annotation), 1)
    assert record["right"] == [True, True, False]
    assert (record["objects"], record["listed"], record["listed right"]) == (2, 2, 1)
    assert listed_cell([record]) == "0.50 / 0.50"
    assert listed_cell([{**record, "listed": 0, "listed right": 0}]) == "- / 0.00"


def test_reliability_counts_what_is_right_by_ranges_of_the_probability():
    """By hand; a probability of one belongs to the last range."""
    first = {"scores": [1.0, 0.95, 0.5, 0.05], "right": [True, False, True, True]}
    second = {"scores": [0.69, 0.3], "right": [False, False]}
    assert reliability_cells([first, second]) == ["-", "0.00 (1)", "0.50 (2)", "-", "0.50 (2)"]


def test_average_precision_of_all_frames_leaves_out_the_first_ones():
    """Two streams; the second one's boxes are right from frame 16 on."""
    streams = [[(8, False), (16, True)], [(8, False), (16, True)]]
    records = [
        {"way": "live", "frame": frame, "objects": 1, "scores": [0.9], "right": [right]}
        for frames in streams
        for frame, right in frames
    ]
    by = by_way(records)
    assert sorted(by["live"]) == [8, 16]
    assert precision_figures(by, 8)(torch.tensor([0, 1])).tolist() == [1.0]
    assert precision_figures(by, 0)(torch.tensor([0, 1])).item() == pytest.approx(0.5 * 51 / 101, abs=1e-9)


def outcome(course, right, ways):
    """A stream with one object, in frame 16; some ways are right. The passes of each are given."""
    records = []
    for way in ways:
        is_right = way in right
        listed = {"listed": int(is_right), "listed right": int(is_right)}
        judged = {"objects": 1, "scores": [0.9 if is_right else 0.4], "right": [is_right], **listed}
        records.append({"way": way, "frame": 16, **judged})
    return StreamOutcome(course, records, {way: Cost(passes, 1.0) for way, passes in ways.items()}, Drift(), {})


def test_precision_is_told_by_way_in_the_order_of_passes():
    """The better of two streams has the object by one pass, and both by two; AP50 of one of two right is half."""
    ways = {"live, 2 passes": 2, "live": 1, "all slices": 19}
    outcomes = [outcome("still", {"live", "live, 2 passes"}, ways), outcome("still", {"live, 2 passes"}, ways)]
    lines = precision_over_passes(outcomes, after=8)
    assert {way: [(point.passes, round(point.value, 2)) for point in line] for way, line in lines.items()} == {
        "live": [(1, 0.5), (2, 1.0)],
        "all slices": [(19, 0.0)],
    }
    assert lines["live"][0].error > 0 == lines["live"][1].error
    assert precision_over_passes(outcomes[:1], after=8)["live"][0].error == 0
    figure = plot_passes([*outcomes, outcome("fast", {"live"}, {"live": 1})], after=8)
    assert [axes.get_title() for axes in figure.axes] == ["still", "30 px a frame"]
    drawn = figure.axes[0].containers[0].lines[0]
    assert [*drawn.get_xdata()] == [1, 2]
    assert [*drawn.get_ydata()] == pytest.approx([0.5, 1], abs=0.01)


def test_precision_is_told_as_a_share_of_that_of_all_slices():
    """The agent has the object of each of two streams, the slices that of the first one; by hand 1 and 51 / 101."""
    ways = {"whole frame and 18 slices": 19, "live": 1, "whole frame": 1}
    streams = [outcome("still", {"whole frame and 18 slices", "live"}, ways), outcome("still", {"live"}, ways)]
    shares = {}
    for line in course_tables("still", streams, StreamConfig())[2:]:
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) > 7 and cells[1] in ways:
            shares[cells[1]] = cells[4]
    assert shares == {"whole frame and 18 slices": "1.00", "live": "1.98", "whole frame": "0.00"}
    alone = course_tables("still", [outcome("still", {"live"}, {"live": 1})], StreamConfig())
    assert any(" - " in line for line in alone if line.startswith("| live"))


def test_a_course_is_told_by_what_the_camera_does():
    """Each course of the study in other words, with its numbers."""
    words = {name: outcome(name, (), {}).title for name in (*COURSES, FILM)}
    assert len(set(words.values())) == len(words)
    assert words["usual"] == "12 px a frame"
    assert words["turning"] == "12 px a frame, turning, zooming"
    assert words["shaking"] == "4 px a frame, a shake of 3 px"
    assert words["moving-slow"] == "4 px a frame, 24 objects more that move"
    assert words["film"] == FILM


def test_a_small_run_writes_its_tables(tmp_path, capsys):
    """As a user runs it: on an embedded photograph, with the real detector."""
    small = ["--width", "416", "--height", "320", "--frames", "4", "--every", "2", "--after", "0"]
    small += ["--passes", "[1,2]"]
    assert main(["--data.limit", "1", "--courses", "[usual]", *small, "--out", str(tmp_path)]) == 0
    text = (tmp_path / "stream.md").read_text()
    assert text in capsys.readouterr().out
    for row in ("whole frame ", "slices in turn, carried along", "plain rule", "live ", "live, all candidates, 2"):
        assert f"| {row}" in text
    assert "nan" not in text
    assert len((tmp_path / "records.jsonl").read_text().splitlines()) == 2 * 9
    assert cv2.imread(str(tmp_path / "passes.png")) is not None


def test_a_film_that_ends_before_a_judged_frame_is_refused(tmp_path, capsys):
    assert main(["--data.limit", "2", "--successive", "--ways", "[whole]", "--out", str(tmp_path)]) == 1
    assert "lower every and after" in capsys.readouterr().err


def tracks_at(*boxes, odds=2.0, variance=1.0):
    """Objects that move, at boxes that are right within a pixel, with log odds."""
    corners = np.array(boxes, float).reshape(-1, 4)
    count = len(corners)
    fixed = Kinematics.at((corners[:, :2] + corners[:, 2:]) / 2, np.full(count, variance), np.full(count, 5.0))
    moving = replace(fixed, velocity=np.full((count, 2), 90.0))
    columns = {name: np.zeros(count) for name in ("size_variance", "missed_odds", "unseen", "magnification")}
    return Tracks(
        track_ids=1 + np.arange(count),
        labels=np.ones(count, int),
        kinematics=moving,
        rest_place=moving.place,
        speed=np.full(count, 50.0),
        log_size=np.log(corners[:, 2:] - corners[:, :2]),
        shown_odds=np.full(count, odds),
        passes=np.zeros(count, int),
        trail=no_trail(count),
        **columns,
    )


@pytest.mark.parametrize(
    ("tracks", "fate", "errors"),
    [
        (tracks_at((100, 100, 140, 140), (102, 100, 142, 140)), LISTED, {"double": 1}),
        (tracks_at((100, 100, 140, 140), odds=-4.0), "improbable", {}),  # also as it moves
        (tracks_at((100, 100, 140, 140), variance=1e4), "place uncertain", {}),
        (tracks_at((125, 100, 165, 140)), "wrong place", {"beside an object": 1}),
        (tracks_at((300, 300, 340, 340))[1:], "forgotten", {}),
        (tracks_at((900, 300, 940, 340)), "wrong place", {}),  # its track has left the frame
    ],
)
def test_why_an_object_is_missed_after_it_was_found(tracks, fate, errors):
    """The object is found in one frame, and each cause is made in the next one."""
    misses, number, box = Misses(), torch.tensor([7]), torch.tensor([[100.0, 100, 140, 140]])
    misses.step(number, box, tracks_at((100, 100, 140, 140)), [], FRAME, counts=False)
    misses.step(number, box, tracks, [], FRAME, moving=torch.tensor([True]))
    assert misses.counts.objects == misses.counts.moving == {fate: 1}
    assert +misses.counts.errors == errors
    rows = {row[0]: row[1:] for row in miss_rows(misses.counts)}
    assert rows[fate] == ["1.000", "1.000"]
    assert [*rows] == [LISTED, *CAUSES]


def test_a_track_that_leaves_the_frame_lists_no_object():
    """Its box, cut to the frame, fits the object, but it is not listed."""
    misses, box = Misses(), torch.tensor([[600.0, 100, 640, 140]])
    misses.step(torch.tensor([7]), box, tracks_at((610, 100, 690, 140)), [], (640, 480))
    assert misses.counts.objects == {"not looked at": 1}
    assert not +misses.counts.errors
    # No object moves on its own, so that there is nothing to have a share of.
    assert [row[1:] for row in miss_rows(misses.counts) if row[0] == "not looked at"] == [["1.000", "-"]]


def test_an_object_is_not_detected_once_a_look_has_shown_all_of_it():
    misses, number, box = Misses(), torch.tensor([7]), torch.tensor([[100.0, 100, 140, 140]])
    misses.step(number, box, tracks_at(), [(0.0, 0.0, 120.0, 480.0)], FRAME)
    misses.step(number, box, tracks_at((300, 300, 340, 340)), [(90.0, 90.0, 150.0, 150.0)], FRAME)
    assert misses.counts.objects == {"not looked at": 1, "not detected": 1}
    assert +misses.counts.errors == {"nothing there": 1}
