"""Hard pairs of frames: what is known of their motion is true, and a wrong one is not believed."""

import numpy as np
import pytest
import torch

from eval.poses import main
from eval.poses.pairs import KINDS, Stage
from eval.poses.run import error, judge
from semfov.data.examples import example
from semfov.motion import Motion

PICTURES = [(example(name) * 255).byte().permute(1, 2, 0).numpy().copy() for name in ("beach", "market", "farm")]


@pytest.mark.parametrize("kind", ["fast shift", "rotation", "zoom"])
def test_views_show_the_same_pixels_at_the_places_that_poses_tell(kind):
    first, second = KINDS[kind](Stage(PICTURES, 3))
    motion = first.pose.inverse().then(second.pose)
    height, width = first.pixels.shape[:2]
    columns, rows = np.meshgrid(np.arange(20, width - 20), np.arange(20, height - 20))
    places = torch.from_numpy(np.stack([columns.ravel(), rows.ravel()], -1)).double()
    there = motion.points(places).round().long()
    inside = ((there >= 0) & (there < torch.tensor([width, height]))).all(-1)
    before = first.pixels[places[inside][:, 1].long(), places[inside][:, 0].long()].astype(float)
    after = second.pixels[there[inside][:, 1], there[inside][:, 0]].astype(float)
    assert np.corrcoef(before.ravel(), after.ravel())[0, 1] > 0.85
    assert error(motion, first, second) < 1e-6
    assert error(Motion.still(), first, second) > 5


@pytest.mark.parametrize(
    "kind",
    [
        "cut to another photograph", "dissolve", "mirrored", "row of repeats", "darkness", "sky", "noise", "wall",
        "lorry in both frames", "lorry from nowhere",
    ],
)  # fmt: skip
def test_a_wrong_motion_is_not_believed(kind):
    assert judge(KINDS[kind](Stage(PICTURES, 1))) != "wrong"


@pytest.mark.parametrize("number", [0, 1, 3])
def test_a_lorry_that_passes_is_not_taken_for_a_camera_that_moves(number):
    assert judge(KINDS["lorry that comes"](Stage(PICTURES, number))) == "right"


def test_an_easy_pair_is_believed_and_a_false_pose_is_found_out():
    film = KINDS["cut to another photograph"](Stage(PICTURES, 0))[:2]
    assert judge(film) == "right"
    moved = film[1]._replace(pose=film[1].pose.then(Motion.similarity(shift=(9, 0))))
    assert judge([film[0], moved]) == "wrong"


def test_the_command_counts_every_film(tmp_path, monkeypatch):
    few = {name: KINDS[name] for name in ("wall", "mirrored")}
    monkeypatch.setattr("eval.poses.run.KINDS", few)
    assert main(["--count", "2", "--out", str(tmp_path)]) == 0
    assert "| all" in (tmp_path / "poses.md").read_text(encoding="utf-8")
    assert len((tmp_path / "records.jsonl").read_text(encoding="utf-8").splitlines()) == 4


def test_a_folder_without_photographs_is_refused(tmp_path, capsys):
    assert main(["--pictures", f"[{tmp_path}]", "--out", str(tmp_path)]) == 1
    assert "expected photographs" in capsys.readouterr().err
