"""Figures are drawn into given axes and files, paths of fixations as they are, and films look after look."""

import base64
import re
import shutil
import subprocess
from itertools import combinations, pairwise
from xml.etree import ElementTree as ET

import numpy as np
import pypdf
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from semfov import DataError, Detections, Grid, viz
from semfov.data.fixations import Fixations
from semfov.viz import animate, plot_fixation, plot_scanpath
from semfov.viz.animation import Film, _in_one_palette, render
from semfov.viz.look import LookFigure, views_of
from semfov.viz.style import TIME
from tests import small
from tests.refusals import refused

CURVES = {"random": np.linspace(0, 0.8, 31), "predictive": np.linspace(0, 0.9, 31)}


def calls(scanpath):
    """Arguments and options of each function, and the number of axes or the parameter that it draws into."""
    image = torch.rand(3, 60, 80)
    views = [image] * 3
    p = torch.rand(500, 1)
    return {
        "plot_belief": ((scanpath, None), {"image": image}, 3),
        "plot_belief_bars": ((scanpath,), {}, 3),
        "plot_curves": ((CURVES,), {"label": "targets found (%)"}, "ax"),
        "plot_episode": ((scanpath, image, views), {}, "figure"),
        "plot_fixation": ((scanpath, 1, image, image), {}, 3),
        "plot_foveated_strip": ((scanpath, views), {}, 3),
        "plot_reliability": (({"one": (torch.cat([p, 1 - p], 1), torch.zeros(500, dtype=torch.long))},), {}, 2),
        "plot_scanpath": ((scanpath, image), {}, "ax"),
        "plot_semantic_map": ((scanpath,), {"image": image}, 2),
    }


NAMES = [name for name in viz.__all__ if name.startswith("plot_")]


@pytest.mark.parametrize("name", NAMES)
def test_figures_are_drawn_into_given_axes(name, scanpath):
    """Their content equals that of a new figure, and other axes stay empty."""
    function, (arguments, options, place) = getattr(viz, name), calls(scanpath)[name]
    mine = Figure(figsize=(12, 8))
    left, right = mine.subfigures(1, 2, width_ratios=[1, 3])
    other = left.subplots()
    kind = {"projection": "3d"} if name == "plot_belief_bars" else {}
    if place == "figure":
        given, key = right, "figure"
    elif place == "ax":
        given, key = right.subplots(subplot_kw=kind), "ax"
    else:
        given, key = list(right.subplots(1, place, squeeze=False, subplot_kw=kind).flat), "axes"
    assert function(*arguments, **options, **{key: given}) is mine
    mine.draw_without_rendering()
    assert not any([other.lines, other.images, other.texts, other.patches, other.collections])
    own = function(*arguments, **options)
    drawn = [axes for axes in mine.axes if axes is not other]
    assert len(drawn) == len(own.axes)
    for a, b in zip(drawn, own.axes, strict=True):
        assert [len(x) for x in (a.lines, a.images, a.texts, a.patches)] == [
            len(x) for x in (b.lines, b.images, b.texts, b.patches)
        ]
        assert a.get_title() == b.get_title()
    if isinstance(place, int):
        refused(f"axes: expected {place} axes", function, *arguments, **options, axes=given[:-1])


def test_a_pdf_contains_its_fonts_and_text(scanpath, tmp_path):
    figure = viz.plot_scanpath(scanpath, torch.rand(3, 60, 80))
    path = viz.save_figure(figure, tmp_path / "a.pdf")
    (page,) = pypdf.PdfReader(path).pages
    text = page.extract_text()
    assert "found after 2 gaze shifts" in text
    assert "cup 0.60" in text
    fonts = [font.get_object() for font in page["/Resources"]["/Font"].get_object().values()]
    assert fonts
    for font in fonts:
        # TrueType inside a composite font, as publishers require.
        assert font["/Subtype"] == "/Type0"
        (inner,) = [each.get_object() for each in font["/DescendantFonts"]]
        assert "/FontFile2" in inner["/FontDescriptor"].get_object()
    assert len(page.images) == 1  # only the photograph is a pixel image


def test_an_svg_contains_its_text_as_outlines_and_a_png_has_its_resolution(scanpath, tmp_path):
    figure = viz.plot_curves(CURVES, label="targets found (%)")
    root = ET.parse(viz.save_figure(figure, tmp_path / "a.svg")).getroot()
    tags = [element.tag.rpartition("}")[2] for element in root.iter()]
    assert tags.count("path") > 20
    assert "image" not in tags
    assert "text" not in tags
    text = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert "targets found (%)" in re.sub(r"<!-- (.*?) -->", r"\1", text)
    figure = viz.plot_curves(CURVES, label="targets found (%)")
    with Image.open(viz.save_figure(figure, tmp_path / "a.png", dpi=50)) as picture:
        assert picture.size == (310, 200)


def test_a_failed_write_leaves_existing_files_unchanged(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(b"before")
    with pytest.raises(ValueError, match="nonsense"):
        viz.save_figure(viz.plot_curves(CURVES, label="targets found (%)"), path.with_suffix(".nonsense"))
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(DataError, match="cannot write"):
        viz.save_figure(viz.plot_curves(CURVES, label="targets found (%)"), tmp_path / "file" / "a.png")
    assert {file.name for file in tmp_path.iterdir()} == {"a.png", "file"}
    assert path.read_bytes() == b"before"


def test_settings_of_matplotlib_are_not_changed(scanpath, tmp_path):
    import matplotlib as mpl

    before = dict(mpl.rcParams)
    viz.save_figure(viz.plot_belief(scanpath), tmp_path / "a.pdf")
    assert dict(mpl.rcParams) == before


def path_of(cells, columns, rows):
    return small.scanpath(Grid(columns, rows, (640, 480)), cells, ("background", "cup"), target=1)


def drawn(scanpath):
    figure = plot_scanpath(scanpath, torch.rand(3, 48, 64))
    figure.draw_without_rendering()
    return figure.axes[0]


def crowded(columns, rows, near):
    """Cells of 31 fixations, anywhere in the image or close together."""
    generator = torch.Generator().manual_seed(columns)
    if near:
        return (torch.arange(31) % 6 + 3) + columns * (torch.arange(31) // 6 + 3)
    return torch.randperm(columns * rows, generator=generator)[:31]


@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize(("columns", "rows"), [(10, 10), (20, 20), (40, 30)])
def test_numbers_of_thirty_gaze_shifts_do_not_overlap(columns, rows, near):
    scanpath = path_of(crowded(columns, rows, near), columns, rows)
    axes = drawn(scanpath)
    numbers = [int(text.get_text()) - 1 for text in axes.texts]  # the first fixation has the number 1
    assert sorted(numbers) == list(range(31))
    boxes = [text.get_bbox_patch().get_window_extent() for text in axes.texts]
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    # No number covers another fixation.
    where = axes.transData.transform((scanpath.fixations + 0.5).numpy())
    for number, box in zip(numbers, boxes, strict=True):
        inside = [n for n, (x, y) in enumerate(where) if box.x0 < x < box.x1 and box.y0 < y < box.y1]
        assert inside in ([], [number])
        assert np.hypot(*(np.array([box.x0 + box.width / 2, box.y0 + box.height / 2]) - where[number])) < 140
    if (columns, rows) == (10, 10) and not near:
        np.testing.assert_allclose([text.xyann for text in axes.texts], scanpath.fixations + 0.5, atol=1e-3)


def test_colours_show_the_time_of_fixations():
    from matplotlib import colormaps

    axes = drawn(path_of(torch.arange(0, 90, 9), 10, 10))
    expected = colormaps[TIME](np.linspace(0, 1, 10))
    np.testing.assert_allclose(axes.collections[-1].get_facecolor(), expected)
    np.testing.assert_allclose([text.get_bbox_patch().get_facecolor() for text in axes.texts], expected)
    thin = axes.collections[-2]
    assert thin.get_linewidths() == [0.8]
    np.testing.assert_allclose(thin.get_colors(), expected[1:])
    np.testing.assert_allclose(thin.get_segments(), np.stack([axes.collections[-1].get_offsets()[:-1],
                                                              axes.collections[-1].get_offsets()[1:]], 1))  # fmt: skip


def test_fixations_of_people_are_drawn_as_those_of_an_agent():
    points = np.array([[10.0, 20.0], [300.0, 40.0], [200.5, 400.25]])
    person = Fixations("a.jpg", "7", points, (640, 480), target="cup", box=(180.0, 380.0, 230.0, 430.0), found=True)
    axes = plot_scanpath(person, torch.rand(3, 48, 64)).axes[0]
    np.testing.assert_allclose(axes.collections[-1].get_offsets(), points + 0.5)
    assert axes.get_title() == "a.jpg, 7: “cup”, found"
    assert [patch.get_bbox().bounds for patch in axes.patches] == [(180.0, 380.0, 50.0, 50.0)]
    refused(r"^image: expected the photograph", plot_scanpath, person)


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
