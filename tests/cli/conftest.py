"""The command `semfov` with the agent of a test."""

import pytest
import torch
from PIL import Image

from semfov.cli import app, jobs, live, main, search
from semfov.data import Scene
from semfov.zoom import GlimpseEvidence
from tests import small
from tests.small import rand


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
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return GlimpseEvidence(2)


def red_scene(name, classes):
    """An example: a red square on grey noise, which is blurred or sharp."""
    image = rand(1, 120, 160).expand(3, -1, -1).clone()
    image[:, 8:28, 8:28] = torch.tensor([0.9, 0.1, 0.1])[:, None, None]
    return Scene(name, name, image, torch.tensor([[8.0, 8, 28, 28]]), torch.tensor([1]))


@pytest.fixture
def opened(agent, tmp_path, monkeypatch):
    """Serves the page of the agent of squares, with a token or None; returns its address."""
    pytest.importorskip("gradio", reason='needs Gradio (pip install "semfov[app]")')
    monkeypatch.setenv("GRADIO_TEMP_DIR", str(tmp_path / "kept"))
    monkeypatch.setattr(app, "example_scene", red_scene)
    page = app._make_page(agent)
    yield lambda token: app._launched(page, tmp_path / "kept", "127.0.0.1", None, token)
    page.close()
