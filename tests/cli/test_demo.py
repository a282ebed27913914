"""The command `semfov demo`: a page of four tasks, computed without a network."""

import base64
import io
import json
import re
import socket
import sys
from pathlib import Path

import pytest
from PIL import Image

from semfov.agent import ActivePerception
from semfov.cli.main import main
from semfov.data.examples import example


def pictures_of(html: str) -> list[Image.Image]:
    """The pictures of the four parts in their order."""
    parts = html.partition('class="parts"')[2].partition('id="viewer"')[0]
    uris = re.findall(r'<img src="data:image/\w+;base64,([^"]+)"', parts)
    return [Image.open(io.BytesIO(base64.b64decode(uri))) for uri in uris]


@pytest.mark.slow
def test_the_page_holds_four_tasks_and_is_made_offline(monkeypatch, capsys, tmp_path):
    def refuse(*_, **__):
        raise AssertionError("a socket was opened")

    for name in ("create_connection", "getaddrinfo"):
        monkeypatch.setattr(socket, name, refuse)
    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setitem(sys.modules, "cv2", None)  # OpenCV is no dependency
    monkeypatch.setenv("SEMFOV_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "first.html"
    assert main(["demo", "--out", str(path)]) == 0
    printed = capsys.readouterr()
    assert printed.out.count("\n") == 1
    assert printed.out.startswith(f"wrote {path} (")
    assert printed.err == ""
    assert not (tmp_path / "cache").exists()
    html = path.read_text("utf-8")
    headings = re.findall(r"<h2[^>]*>(\w+):", html)
    assert headings == ["Search", "Find", "Gaze", "Stream"]
    assert not re.findall(r'(?:src|href|srcset)="(?!data:|#)', html)
    search, find, gaze, stream = pictures_of(html)
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', html)[1])
    looks = {episode["name"]: len(episode["looks"]) for episode in data["episodes"]}
    # The films have a frame for each look, and there was more than the look at the whole.
    assert {"beach": search.n_frames, "sheet": find.n_frames} == looks
    assert min(looks.values()) > 1
    assert gaze.format == "JPEG"
    assert (gaze.width / gaze.height) == pytest.approx(640 / 499, rel=0.01)
    assert stream.n_frames > 10
    people = re.search(r"(\d+) people found", html)
    alone = ActivePerception.recommended().find_all(example("sheet"), "person")
    assert int(people[1]) == len(alone.objects)


def test_a_file_that_is_no_page_is_refused_before_anything_is_loaded(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(ActivePerception, "recommended", lambda: pytest.fail("the detector was loaded"))
    path: Path = tmp_path / "first.pdf"
    assert main(["demo", "--out", str(path)]) == 1
    assert capsys.readouterr().err == f"error: out: expected a file that ends in .html or .htm, got {path}\n"
    assert not path.exists()
