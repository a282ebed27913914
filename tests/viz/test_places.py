"""Every figure can be drawn into given axes, and written as PNG, PDF and SVG."""

import re
from xml.etree import ElementTree as ET

import numpy as np
import pypdf
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from semfov import DataError, InputError, viz

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
        with pytest.raises(InputError, match=f"axes: expected {place} axes"):
            function(*arguments, **options, axes=given[:-1])


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
