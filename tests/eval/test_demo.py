"""The demonstration as a user runs it, with a detector that sees coloured squares."""

import json
import re

import pytest
import torch
from PIL import Image

import eval.demo as program
from eval.stages import STAGES, Stages
from semfov import ActivePerception, Foveation, search_policy
from semfov.detection import Candidates, Detector


class Squares(Detector):
    """Detects the bounding box of what is red; its score is how saturated it is."""

    def __init__(self) -> None:
        super().__init__("squares", ("red", "wine glass"), (160, 120))

    def propose(self, canvas):
        colour = canvas[0, 0] - canvas[0, 1]
        ys, xs = (colour > 0.1).nonzero(as_tuple=True)
        if not len(xs):
            return Candidates(canvas.new_zeros(1, 0, 4), canvas.new_zeros(1, 0, 2))
        box = torch.stack([xs.min(), ys.min(), xs.max() + 1, ys.max() + 1]).to(canvas)
        return Candidates(box[None, None], torch.stack([colour.max().clamp(0, 1), colour.new_tensor(0)])[None, None])


@pytest.fixture
def agent():
    searching, exploring = search_policy("non-predictive"), search_policy("random")
    return ActivePerception(
        Foveation(40.0), Squares(), None, (8, 6), searching, exploration=exploring, reference=160.0
    ).eval()


@pytest.fixture
def photo(tmp_path):
    picture = Image.new("RGB", (160, 120), (100, 100, 100))
    picture.paste((230, 20, 20), (8, 8, 28, 28))
    path = tmp_path / "my photo.png"
    picture.save(path)
    return path


@pytest.fixture
def run(agent, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(program, "make_agent", lambda config: agent)

    def call(*arguments):
        code = program.main([*map(str, arguments), "--out", str(tmp_path / "out")])
        return code, capsys.readouterr()

    return call


def test_search(run, photo, tmp_path):
    code, printed = run(photo, "--target", "red", "--start", 47, "--report", tmp_path / "page.html")
    assert code == 0
    assert "my photo.png: “red” found after 1 gaze shift" in printed.out
    rows = [line.split() for line in printed.out.splitlines() if line[:1] in "01"]
    assert rows[0][:3] == ["0", "(7,", "5)"]
    for name in ("scanpath.png", "views.png", "belief.png", "belief_bars.png", "animation.gif"):
        with Image.open(tmp_path / "out" / name) as picture:
            picture.verify()
        assert f"out/{name}" in printed.out
    assert "<!DOCTYPE html>" in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert str(tmp_path / "page.html") in printed.out


def test_explore_a_folder(run, photo, tmp_path):
    Image.open(photo).save(photo.with_name("other.png"))
    code, printed = run(photo.parent, "--explore", "--shifts", 2, "--report", tmp_path / "page.html")
    assert code == 0
    assert printed.out.count("explored with 2 gaze shifts") == 2
    for folder in ("000-my-photo.png", "001-other.png"):
        assert {file.suffix for file in (tmp_path / "out" / folder).iterdir()} >= {".png", ".gif"}
        assert (tmp_path / "out" / folder / "map.png").is_file()


def test_file_names_are_not_taken_for_markup(run, photo, tmp_path):
    photo = photo.rename(photo.with_name("<img src=x onerror=alert(1)>'\"&$x$.png"))
    code, _ = run(photo, "--target", "red", "--start", 47, "--report", tmp_path / "page.html")
    assert code == 0
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<img" not in page
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1])
    assert data["episodes"][0]["name"] == photo.name


def test_no_target_lists_the_classes(run, photo, tmp_path):
    code, printed = run(photo)
    assert code == 0
    assert "wine glass" in printed.out
    assert not (tmp_path / "out").exists()


def test_mistakes_are_told_in_one_line(run, photo, tmp_path):
    for arguments, told in [
        ((photo, "--target", "wineglass"), "did you mean 'wine glass'"),
        ((tmp_path / "none.jpg", "--target", "red"), "no such file"),
        ((photo, "--target", "red", "--explore"), "none with --explore"),
        ((photo, "--target", "red", "--start", 48), "a cell from 0 to 47"),
        ((photo, "--camera", 0, "--target", "red"), "got both"),
    ]:
        code, printed = run(*arguments)
        assert code == 1
        assert told in printed.err
        assert len(printed.err.strip().splitlines()) == 1


def test_help(capsys):
    with pytest.raises(SystemExit) as stopped:
        program.main(["--help"])
    assert stopped.value.code == 0
    printed = capsys.readouterr().out
    assert "[photo]" in printed
    assert "--camera" in printed


def test_stages_measure_and_change_nothing(agent, photo):
    from semfov import read_image

    image = read_image(photo)
    before = dict(vars(agent.eye)), dict(vars(agent.observer)), agent.policy
    plain = agent.search(image, "red", start=40)
    stages = Stages()
    with torch.inference_mode(), stages.watch(agent):
        watched = agent.search(image, "red", start=40)
    assert torch.equal(plain.cells, watched.cells)
    assert torch.equal(plain.values, watched.values)
    assert len(stages.looks) == len(watched)
    assert all(set(look) == set(STAGES) and min(look.values()) > 0 for look in stages.looks)
    assert (dict(vars(agent.eye)), dict(vars(agent.observer)), agent.policy) == before
