"""Animations contain every frame, for the requested time."""

import base64
import re
import shutil
import subprocess
from itertools import pairwise

import numpy as np
import pytest
import torch
from PIL import Image

from semfov import Detections, Grid
from semfov.viz import animate, plot_fixation
from semfov.viz.animation import Film, _in_one_palette, render
from semfov.viz.scanpath import LookFigure, views_of
from tests import small
from tests.refusals import refused


@pytest.fixture(params=["search", "exploration"])
def searched(request):
    """A scanpath of three fixations, the photograph, and a view for each fixation."""
    generator = torch.Generator().manual_seed(0)
    scores = torch.tensor([[0.1, 0.8, 0.1], [0.3, 0.1, 0.6]])
    corner = torch.rand(3, 2, 2, generator=generator) * 40
    boxes = torch.cat([corner, corner + 18], -1)
    scanpath = small.scanpath(
        Grid(4, 3, (80, 60)),
        torch.tensor([0, 6, 11]),
        target=2 if request.param == "search" else None,
        detections=tuple(Detections(each[None], scores[None], torch.ones(1, 2, dtype=torch.bool)) for each in boxes),
        probabilities=torch.rand(3, 12, 3, generator=generator).pow(3),
    )
    image = torch.rand(3, 60, 80, generator=generator)
    return scanpath, image, [image * share for share in (0.3, 0.6, 0.9)]


@pytest.fixture
def frames():
    return [np.full((31, 41, 3), shade, np.uint8) for shade in (0, 100, 200)]


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_an_mp4_contains_all_frames_and_durations(frames, tmp_path):
    _, path = Film(frames, 0.5, 1.5).save(tmp_path / "a.gif")
    command = ["ffmpeg", "-loglevel", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    pixels = np.frombuffer(subprocess.run(command, capture_output=True, check=True).stdout, np.uint8)
    shown = pixels.reshape(-1, 32, 42, 3)[:, 10, 10, 0]
    assert len(shown) == pytest.approx(30, abs=5)  # three seconds with ten frames each
    np.testing.assert_allclose([shown[2], shown[7], shown[-2]], [0, 100, 200], atol=6)


def test_without_ffmpeg_only_a_gif_is_written(frames, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert Film(frames).save(tmp_path / "a.gif") == [tmp_path / "a.gif"]


def test_frames_equal_figures_drawn_one_by_one(searched):
    """All frames are drawn with one figure, but each equals the figure of `plot_fixation`."""
    scanpath, image, views = searched
    frames = animate(scanpath, image=image, views=views).frames
    assert len(frames) == len(scanpath)
    for fixation, (frame, view) in enumerate(zip(frames, views, strict=True)):
        (alone,) = render([plot_fixation(scanpath, fixation, image, view)])
        assert frame.shape == alone.shape
        # The layout of a separate figure is computed again, and may be shifted by a fraction of a pixel.
        off = np.abs(frame.astype(int) - alone) > 48
        assert off.mean() < 2e-3, fixation
    assert all((a != b).mean() > 1e-3 for a, b in pairwise(frames))


def test_a_film_is_shown_in_notebooks_as_the_gif_that_it_writes(searched, tmp_path):
    scanpath, image, views = searched
    film = animate(scanpath, image=image, views=views, seconds=0.5, hold=1)
    assert len(film) == len(film.frames) == 3
    assert repr(film).startswith(f"Film: {scanpath.describe()}, 3 frames of ")
    inside = re.fullmatch(r'<img [^>]*src="data:image/gif;base64,([^"]+)">', film._repr_html_())
    path = animate(scanpath, tmp_path / "film.gif", image=image, views=views, seconds=0.5, hold=1)
    assert path.read_bytes() == base64.b64decode(inside[1])
    with Image.open(path) as read:
        for number, frame in enumerate(film.frames):
            read.seek(number)
            assert read.info["duration"] == (500, 500, 1500)[number]
            shown = np.asarray(read.convert("RGB")).astype(int)
            assert (shown[0] == 255).all()
            # The photograph is noise, which has more colours than a GIF.
            assert np.abs(shown - frame).mean() < 9
    refused(r"path: expected a file that ends in \.gif .*film\.mp4", film.save, tmp_path / "film.mp4")
    for bad in ({"seconds": 0.0}, {"hold": -1.0}):
        refused(next(iter(bad)), animate, scanpath, image=image, views=views, **bad)


def test_frames_share_their_colours_and_do_not_depend_on_earlier_ones(searched):
    scanpath, image, views = searched
    seen = views_of(scanpath, image, views)
    figure = LookFigure(scanpath, image, seen[0])
    (last,) = render([figure.show(2, seen[2])])
    for number in (0, 1):
        figure.show(number, seen[number])
    (again,) = render([figure.show(2, seen[2])])
    np.testing.assert_array_equal(last, again)
    # Parts that do not change must not flicker.
    first, *others = _in_one_palette(animate(scanpath, image=image, views=views).frames)
    assert all(frame.getpalette() == first.getpalette() for frame in others)
