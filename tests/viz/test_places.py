"""Figures are drawn into given axes and files, and paths of fixations as they are."""

import re
from itertools import combinations
from xml.etree import ElementTree as ET

import numpy as np
import pypdf
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from semfov import DataError, Grid, viz
from semfov.data.fixations import Fixations
from semfov.viz import plot_scanpath
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


def test_an_svg_contains_its_text_as_outlines(scanpath, tmp_path):
    figure = viz.plot_curves(CURVES, label="targets found (%)")
    root = ET.parse(viz.save_figure(figure, tmp_path / "a.svg")).getroot()
    tags = [element.tag.rpartition("}")[2] for element in root.iter()]
    assert tags.count("path") > 20
    assert "image" not in tags
    assert "text" not in tags
    text = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert "targets found (%)" in re.sub(r"<!-- (.*?) -->", r"\1", text)


def test_a_png_has_the_requested_resolution(tmp_path):
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
    numbers = [int(text.get_text()) for text in axes.texts]
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
