"""What the README says works: its code runs, its links lead somewhere, its picture is small."""

import re
from pathlib import Path

import pytest
import torch
from PIL import Image

import semfov

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_links_lead_somewhere():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if not link.startswith("http")]
    assert len(links) > 5
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_pictures_are_small():
    for link in re.findall(r"!\[[^]]+\]\(([^)]+)\)", README):
        assert (ROOT / link).stat().st_size < 300_000
        with Image.open(ROOT / link) as picture:
            assert max(picture.size) <= 1000


@pytest.mark.weights
@pytest.mark.slow
def test_code_runs(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.S)
    assert len([line for line in code.splitlines() if line]) <= 10
    monkeypatch.chdir(tmp_path)
    image = semfov.EmbeddedScenes(["cup"])[0].image
    pixels = (image * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    Image.fromarray(pixels).save("kitchen.jpg")
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    assert names["scanpath"].classes[names["scanpath"].target] == "cup"
    assert names["explored"].shifts == 10
    assert Path("scanpath.png").is_file()
    assert Path("map.png").is_file()
