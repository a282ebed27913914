"""The command on videos: the belief follows a moving photograph, and a video of it is written."""

import re

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn import functional as F

from semfov import Detections, Grid
from semfov.belief import DirichletBelief
from semfov.cli import live
from semfov.cli.main import main
from semfov.data.examples import example_scene
from semfov.data.sources import Picture, Stream
from semfov.decision import CloseUp, Decision
from semfov.observation.thresholds import Thresholds
from semfov.paths import FoveaMoment
from semfov.paths.fovea import moment_look
from semfov.viz.live import draw_moment, video, video_suffix
from tests import small
from tests.refusals import refused, unusable

cv2 = pytest.importorskip("cv2")


def write(path, frames):
    height, width = frames[0].shape[-2:]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (width, height))
    for frame in frames:
        writer.write(np.ascontiguousarray((frame * 255).byte().permute(1, 2, 0).numpy()[..., ::-1]))
    writer.release()
    return path


def read(path):
    recorder, frames = cv2.VideoCapture(str(path)), []
    while True:
        whole, frame = recorder.read()
        if not whole:
            return frames
        frames.append(frame[..., ::-1])


@pytest.mark.slow
def test_a_target_is_followed_in_a_panning_video_until_it_leaves_the_view(tmp_path, capsys):
    """The target is found, is followed to the edge, and is absent once it has left the view."""
    scene = example_scene("farm", ["horse"])
    wide = F.pad(scene.image[..., :196], (0, 604, 0, 0), mode="replicate")[:, :380]  # right of the horses is nothing
    places = [20] * 8 + [20 + 23 * shift for shift in range(1, 20)] + [480] * 12
    path = write(tmp_path / "pan.avi", [wide[..., x : x + 320] for x in places])
    assert main(["live", str(path), "--target", "Horses", "--how", "fovea", "--out", str(tmp_path / "out")]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "most likely at" in line]
    assert len(lines) == len(places)
    assert "horse: found" in lines[7]
    assert "horse: absent" in lines[-1]
    assert any("closely" in line for line in lines)
    (left, top), (right, bottom) = scene.boxes[:, :2].amin(0).tolist(), scene.boxes[:, 2:].amax(0).tolist()
    # As long as more than one column shows it; a closer look may be at where it was in the frame before.
    for before, x, line in zip([places[0], *places], places[:13], lines, strict=False):
        column, row = map(int, re.search(r"most likely at cell \((\d), (\d)\)", line).groups())
        # The most likely cell overlaps the annotated box, which moves with the view.
        assert left - x < 32 * (column + 1)
        assert right - before > 32 * column
        assert top < 38.1 * (row + 1)
        assert bottom > 38.1 * row
    chances = [float(re.search(r"p ([\d.]+)( \(there [\d.]+\))?, most", line)[1]) for line in lines]
    assert min(chances[1:14]) > 0.9
    assert chances[-1] < 0.3
    shown = read(tmp_path / "out" / f"live{video_suffix()}")
    assert len(shown) == len(places)
    assert shown[0].shape == (380, 320, 3)


@pytest.fixture
def agent():
    return small.agent(small.Coloured(score=0.9))


def frames(count=6):
    pictures = torch.full((count, 3, 120, 160), 0.4)
    for number, picture in enumerate(pictures):
        picture[0, 40:60, 10 * number : 10 * number + 20] = 0.9
    return list(pictures)


def test_a_video_is_searched_or_explored(run, tmp_path):
    path = write(tmp_path / "red.avi", frames())
    code, printed = run("live", path, "--target", "red", "--frames", 4, "--start", "7,5", "--out", tmp_path / "out")
    assert code == 0
    lines = printed.out.splitlines()
    assert lines[0] == "red.avi: searching for “red”"
    assert lines[1].startswith("  a line: frame, at cell (column, row) of the look: what it shows of red, ")
    assert re.match(r"     0  at cell \(7, 5\): red 0\.9\d +p\(red\) up to 0\.\d\d, most likely at cell \(", lines[2])
    assert re.search(r"\d frames/s$", lines[5])
    assert re.match(r"4 frames, [\d.]+ frames/s after the first 3", lines[6])
    assert len(read(tmp_path / "out" / f"live{video_suffix()}")) == 4
    code, printed = run("live", path, "--target", "green", "--frames", 2)
    # Only what is looked for is named.
    assert len(re.findall(r"\n +\d  at cell \(\d, \d\): nothing ", printed.out)) == 2
    run("live", path, "--frames", 2, "--out", tmp_path / "seen.avi")
    assert len(read(tmp_path / "seen.avi")) == 2
    code, printed = run("live", path)
    assert "red.avi: exploring" in printed.out
    assert "p(object) up to 0." in printed.out
    assert "written:" not in printed.out


@pytest.mark.filterwarnings("default:skipped")  # the command prints them
def test_a_frame_that_is_none_or_of_another_size_is_skipped(run, tmp_path):
    for name, size in (("b.png", (60, 40)), ("c.png", (40, 60)), ("e.png", (60, 40))):
        Image.new("RGB", size).save(tmp_path / name)
    for name in ("a.png", "d.png"):
        (tmp_path / name).write_bytes(b"no picture")
    code, printed = run("live", tmp_path, "--target", "red")
    assert code == 1
    assert "skipped c.png: c.png: expected 60 × 40 px, the size of the first frame, got 40 × 60; `sem" in printed.err
    assert re.findall(r"skipped ([ad])\.png", printed.err) == ["a", "d"]
    assert "2 frames, 3 skipped" in printed.out
    for name in "bce":
        (tmp_path / f"{name}.png").unlink()
    code, printed = run("live", tmp_path, "--target", "red")
    assert (code, "error: source: expected a frame that can be read, got 2 that cannot" in printed.err) == (1, True)


def test_large_frames_are_looked_at_by_windows(run, tmp_path, agent):
    large = torch.full((3, 768, 1024), 0.4)
    large[0, 320:352, 640:672] = 0.95
    path = write(tmp_path / "large.avi", [large] * 4)
    _, printed = run("live", path, "--find", "red,green", "--out", tmp_path / "out")
    lines = printed.out.splitlines()
    assert lines[0] == "large.avi: finding all “red”, “green”"
    assert lines[1].startswith("  a line: frame, at (x, y) × magnification of the look: ")
    assert re.match(r"     0  at \(\d+, \d+\) × 0\.\d\d: .* (\d|No) reds?, no green found", lines[2])
    assert [film.shape for film in read(tmp_path / "out" / f"live{video_suffix()}")] == [(768, 1024, 3)] * 4
    _, printed = run("live", path, "--target", "red", "--frames", 1)
    assert re.search(r"0  at .* red: (found|undecided), p 0\.\d\d", printed.out)
    code, printed = run("live", path, "--how", "head")
    assert code == 1
    assert printed.err.startswith("error: how: expected 'fovea', 'windows' or 'auto' for a stream")
    _, printed = run("live", path, "--target", "red", "--find", "red")
    assert "find: expected a target or classes to find, not both, got red" in printed.err


@pytest.fixture
def large_video(tmp_path):
    large = torch.full((3, 768, 1024), 0.4)
    large[0, 320:352, 640:672] = 0.95
    return write(tmp_path / "large.avi", [large] * 6)


def test_tracks_of_a_fovea_are_refused_before_the_first_frame(run, large_video, tmp_path):
    arguments = "live", large_video, "--how", "fovea", "--tracks", tmp_path / "tracks.txt", "--out", tmp_path / "a.avi"
    code, printed = run(*arguments)
    assert code == 1
    assert "tracks: expected looks at windows, as with --how windows" in printed.err
    assert not printed.out
    assert not list(tmp_path.glob("a.*"))


@pytest.mark.slow
def test_a_stream_ends_with_the_number_of_different_objects(tmp_path, capsys):
    """It is the number of different identities in the tracks that are written beside it, but of no other class."""
    path = write(tmp_path / "beach.avi", [example_scene("beach", ["person"]).image] * 4)
    assert main(["live", str(path), "--find", "person,cat", "--tracks", str(tmp_path / "people.txt")]) == 0
    rows = (tmp_path / "people.txt").read_text().splitlines()
    different = {row.split(",")[1] for row in rows}
    assert len(rows) > len(different) > 1
    sentence = f"different objects listed: {len(different)} people, no cat; one that was lost for long may count again"
    assert sentence in capsys.readouterr().out.splitlines()


def test_a_searched_stream_ends_with_the_frames_in_which_the_target_was_found(run, agent, large_video):
    agent.verification = small.Sure(thresholds=Thresholds(0.7, 0.01, 0.3))
    _, printed = run("live", large_video, "--target", "red", "--how", "fovea")
    found = printed.out.count("red: found")
    assert found > 0
    assert printed.out.splitlines()[-1] == f"red found in {found} of 6 frames"


def test_a_terminal_has_one_line_that_is_renewed(run, large_video, monkeypatch):
    monkeypatch.setattr(live.sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "70")
    _, printed = run("live", large_video, "--find", "red")
    (status,) = [line for line in printed.out.split("\n") if "\r" in line]
    states = status.split("\r")[1:]
    assert [int(state.split()[0]) for state in states] == list(range(6))
    assert {len(state) for state in states} == {69}


def test_windows_and_objects_are_drawn_into_a_frame(agent):
    """The present window has a wide frame, and the next one and each object a thin one."""
    large = torch.full((3, 768, 1024), 0.4)
    large[0, 320:352, 640:672] = 0.95
    live = agent.live(how="windows")
    moments = [live.step(large) for _ in range(6)]
    moment = next(each for each in reversed(moments) if each.window.level)
    plain = np.asarray((large * 255).round().byte().permute(1, 2, 0)).astype(int)
    changed = abs(draw_moment(large, moment, "red").astype(int) - plain).max(-1) > 8
    x1, y1, _, y2 = (round(n) for n in moment.window.region(moment.lattice))
    assert changed[max(y1, 22) : min(y2, 768) - 3, x1 : x1 + 3].all()
    for a, _, c, d in [*moment.objects.boxes.tolist(), moment.next_window.region(moment.lattice)]:
        left, right, row = max(int(a), 0), min(int(c), 1023), min(int(d), 767)
        assert changed[row - 2 : row + 1, left:right].any(0).all()
    assert np.array_equal(draw_moment((large * 255).round().byte(), moment, "red"), draw_moment(large, moment, "red"))


def test_closer_looks_at_a_video_are_printed_unless_they_are_switched_off(run, agent, tmp_path):
    agent.verification = small.Sure(thresholds=Thresholds(0.7, 0.01, 0.3))
    path = write(tmp_path / "red.avi", frames())
    _, printed = run("live", path, "--target", "red", "--start", 0)
    shown = re.findall(
        r"^ +(\d)  closely at cell \((\d), (\d)\): p 0\.98 there +red: found, p .* \(there 0\.98\)", printed.out, re.M
    )
    assert len(shown) == 1
    assert printed.out.splitlines()[2] == "  found: when a closer look gives p 0.7 there (--confirm)"
    assert "p: the probability that the frame shows the target; there: that it is at the place found" in printed.out
    number, column, row = map(int, shown[0])
    # Red covers rows 40 to 60 of 120, and starts at column 10 of 160 per frame.
    assert 20 * column < 10 * number + 20
    assert 20 * (column + 1) > 10 * (number - 1)
    assert row in (1, 2)
    _, printed = run("live", path, "--target", "red", "--start", 0, "--closer", 0)
    assert "closely" not in printed.out
    assert "there" not in printed.out


def test_a_camera_runs_until_it_is_stopped(run, tmp_path, monkeypatch):
    """Ctrl-C ends the run normally, and the frames until then are written."""

    def endless():
        yield from (Picture(f"frame {number}", frame) for number, frame in enumerate(frames(3)))
        raise KeyboardInterrupt

    asked = []
    monkeypatch.setattr(live, "open_stream", lambda *what: asked.append(what) or Stream("camera 0", None, endless()))
    run("live", "0")
    code, printed = run("live", "--camera", 0, "--target", "red", "--rate", 0.5, "--out", tmp_path / "out")
    assert asked == [(0, None, None)] * 2
    assert code == 0
    assert "stopped\n3 frames" in printed.out
    assert len(read(tmp_path / "out" / f"live{video_suffix()}")) == 3


def moment(cell=0, grid=Grid(4, 2, (40, 20)), **changes):  # noqa: B008 (it does not change)
    beta = torch.ones(1, 8, 2)
    beta[0, 6, 1] = 1e6
    beta[0, :6, 0] = beta[0, 7:, 0] = 1e6
    belief = DirichletBelief(beta)
    seen = Detections(torch.zeros(1, 0, 4), torch.zeros(1, 0, 2), torch.zeros(1, 0, dtype=torch.bool))
    made = {
        "classes": ("background", "cup"),
        "number": 0, "grid": grid, "target": 1,
        "looks": (moment_look(grid, 0, cell, seen, belief.probability(1)[0], {}),),
        "probability": belief.probability(1)[0], "decision": None, "visited": torch.zeros(8, dtype=torch.bool),
        "next_cell": 3,
    }  # fmt: skip
    return FoveaMoment(**{**made, **changes})


def test_belief_gaze_next_cell_and_decision_are_drawn_into_a_frame():
    """The belief colours the likely cell, the gaze is marked, and a box surrounds the found object."""
    grey = torch.full((3, 200, 400), 0.5)
    grid = Grid(4, 2, (400, 200))
    plain = moment(grid=grid)
    drawn = draw_moment(grey, plain, "cup").astype(int)
    assert drawn.shape == (200, 400, 3)
    coloured = abs(drawn - 127).max(-1) > 8
    assert coloured[101:199, 201:299].all()
    assert not coloured[101:199, 101:199].any()
    assert not coloured[130:199, :].any(0)[np.r_[0:200, 300:400]].any()
    assert coloured[40:61, 40:61].any()
    # The line leads from the gaze to the next cell.
    assert coloured[50, 100:300].all()
    box = torch.tensor([110.0, 110, 190, 190])
    found = draw_moment(grey, moment(grid=grid, decision=Decision("found", 0.9, 6, box)), "cup")
    changed = abs(found.astype(int) - drawn).max(-1) > 8
    assert changed[110, 110:190].all()
    assert changed[110:190, 110].all()
    assert not changed[115:185, 115:185].any()
    # A closer look is marked around its box instead of at the fixated point.
    closer = CloseUp(0, 1, 6, box, 0.9, 0.95, index=0)
    there = {"grid": grid, "cell": 6, "next_cell": 6}
    close = draw_moment(grey, moment(**there, closer=(closer,)), "cup").astype(int)
    changed = abs(close - draw_moment(grey, moment(**there), "cup")).max(-1) > 8
    assert changed[105, 110:190].all()
    assert changed[110:190, 105].all()
    assert changed[150, 230:270].any()
    assert not changed[:98].any()
    assert not changed[:, 202:238].any()
    assert not changed[:, 262:].any()
    large = draw_moment(torch.zeros(3, 1001, 1999), moment(grid=Grid(4, 2, (1999, 1001))), "cup")
    assert large.shape == (320, 640, 3)


def test_a_moment_draws_into_a_frame_of_opencv():
    known = moment(grid=Grid(4, 2, (400, 200)))
    image = torch.rand(3, 200, 400, generator=torch.Generator().manual_seed(0)).mul(255).round().byte()
    frame = image.permute(1, 2, 0).numpy()[..., ::-1]
    drawn = known.draw(frame)
    assert np.array_equal(drawn[..., ::-1], draw_moment(image, known, known.describe()))
    assert np.array_equal(known.draw(frame[..., ::-1], color="rgb"), drawn[..., ::-1])
    assert known.draw(frame, longest=100).shape == (50, 100, 3)
    for size in ((401, 203), (2001, 1001)):  # odd, and larger than a screen
        assert moment(grid=Grid(4, 2, size)).draw(np.zeros((*size[::-1], 3), np.uint8)).shape == (*size[::-1], 3)
    refused(r"frame: expected 400 × 200 px", known.draw, frame[:100])


def test_videos_are_written_completely_or_not_at_all(tmp_path):
    path = tmp_path / "film.avi"
    generator = np.random.default_rng(0)
    shown = [np.full((48, 64, 3), shade, np.uint8) for shade in generator.integers(0, 256, 5)]
    with video(path, 10.0) as add:
        for frame in shown:
            add(frame)
        assert not path.exists()
    for frame, back in zip(shown, read(path), strict=True):
        assert abs(back.astype(int) - frame).max() <= 4
    before = path.read_bytes()

    def fail():
        with video(path, 10.0) as add:
            add(shown[0])
            raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        fail()
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["film.avi"]


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
def test_a_film_that_does_not_fit_on_the_disk_is_not_written(tmp_path, suffix):
    """OpenCV says nothing of it. A limit of the size of files stands for the disk."""
    resource = pytest.importorskip("resource")
    rng = np.random.default_rng(0)
    path = tmp_path / f"film{suffix}"

    def write(frames):
        with video(path, 10) as add:
            for _ in range(frames):
                add(rng.integers(0, 255, (128, 128, 3), np.uint8))

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 17, hard))
    try:
        unusable("the disk may be full; make room", write, 100)
        assert not [*tmp_path.iterdir()]
        write(2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.stat().st_size > 1000
