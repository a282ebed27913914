"""Animations hold every frame, and play it as long as asked."""

import shutil
import subprocess

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from semfov.viz.animation import render, save_animation


@pytest.fixture
def frames():
    return [np.full((31, 41, 3), shade, np.uint8) for shade in (0, 100, 200)]


def test_gif(frames, tmp_path):
    save_animation(frames, tmp_path / "a.gif", seconds=0.5, hold=1.5)
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 3
        for number, (shade, duration) in enumerate([(0, 500), (100, 500), (200, 2000)]):
            film.seek(number)
            assert film.info["duration"] == duration
            np.testing.assert_allclose(np.asarray(film.convert("RGB")), shade, atol=2)


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_mp4(frames, tmp_path):
    _, path = save_animation(frames, tmp_path / "a.gif", seconds=0.5, hold=1.5)
    command = ["ffmpeg", "-loglevel", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    pixels = np.frombuffer(subprocess.run(command, capture_output=True, check=True).stdout, np.uint8)
    shown = pixels.reshape(-1, 32, 42, 3)[:, 10, 10, 0]
    assert len(shown) == pytest.approx(30, abs=5)  # three seconds of ten frames
    np.testing.assert_allclose([shown[2], shown[7], shown[-2]], [0, 100, 200], atol=6)


def test_without_ffmpeg(frames, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert save_animation(frames, tmp_path / "a.gif") == [tmp_path / "a.gif"]


def test_render_is_the_figure():
    figure = Figure(figsize=(1, 0.5), facecolor="#336699")
    (frame,) = render([figure], dpi=100)
    assert frame.shape == (50, 100, 3)
    assert (frame == [0x33, 0x66, 0x99]).all()
