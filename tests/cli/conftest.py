"""The command `semfov` with the agent of a test."""

import pytest
from PIL import Image

from semfov.cli import jobs, live, main, search
from semfov.zoom import GlimpseEvidence
from tests import small


@pytest.fixture
def agent():
    return small.agent(small.Coloured(("red", "wine glass")))


@pytest.fixture
def run(agent, monkeypatch, capsys):
    """Runs the command in this process; returns its exit code and what it printed."""
    for module in (jobs, live):
        monkeypatch.setattr(module, "make_agent", lambda options: agent)
    for module in (jobs, live, search):
        monkeypatch.setattr(module, "detector_classes", lambda options: None)

    def run_command(*arguments):
        code = main.main(list(map(str, arguments)))
        return code, capsys.readouterr()

    return run_command


@pytest.fixture
def photo(tmp_path):
    picture = Image.new("RGB", (160, 120), (100, 100, 100))
    picture.paste((230, 20, 20), (8, 8, 28, 28))
    path = tmp_path / "my photo.png"
    picture.save(path)
    return path


@pytest.fixture
def folder(photo, tmp_path):
    """Three pictures, each with a red square at another place."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, name in enumerate("abc"):
        picture = Image.new("RGB", (160, 120), (100, 100, 100))
        picture.paste((230, 20, 20), (8 + 40 * number, 8, 28 + 40 * number, 28))
        picture.save(folder / f"{name}.png")
    return folder


@pytest.fixture
def large(tmp_path):
    ground = Image.linear_gradient("L").point(lambda value: 90 + value // 8)  # not blank, so that it is searched
    picture = ground.resize((1280, 960)).convert("RGB")
    picture.paste((230, 20, 20), (1000, 700, 1040, 740))
    path = tmp_path / "large" / "field.png"
    path.parent.mkdir()
    picture.save(path)
    return path


@pytest.fixture
def evidence():
    """Untrained evidence for large pictures for the detector of squares."""
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return GlimpseEvidence(2)
