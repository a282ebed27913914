"""Figures show the correct data: curves, fixations, beliefs, and one scale for an episode."""

import warnings
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgba
from mpl_toolkits.mplot3d import Axes3D

from semfov import Detections, Grid
from semfov.decision import CloseUp, Decision
from semfov.viz import (
    COLOURS,
    plot_belief,
    plot_belief_bars,
    plot_curves,
    plot_episode,
    plot_fixation,
    plot_foveated_strip,
    plot_reliability,
    plot_scanpath,
)
from tests import small
from tests.lightness import lab_of
from tests.refusals import refused


@pytest.fixture
def image():
    return torch.rand(3, 60, 80)


def draw(figure):
    """Render the figure; a warning, such as one of a failed layout, is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.draw_without_rendering()
    return figure


def test_plot_shows_curves_and_error_bands():
    curves = {"random": np.linspace(0, 0.8, 31), "predictive": np.linspace(0, 0.9, 31)}
    figure = draw(plot_curves(curves, {"random": np.full(31, 0.02)}, label="found (%)"))
    axes = figure.axes[0]
    assert [line.get_label() for line in axes.lines] == list(curves)
    np.testing.assert_allclose(axes.lines[1].get_ydata(), 100 * curves["predictive"])
    assert len(axes.collections) == 1


def test_the_legend_names_all_of_few_curves_and_the_highest_of_many():
    curves = {"random": np.zeros(21)} | {f"policy {number}": np.linspace(0, number / 20, 21) for number in range(16)}
    (axes,) = draw(plot_curves(curves, label="right (%)", title="exploration")).axes
    named = [text.get_text() for text in axes.get_legend().get_texts()]
    assert named == ["random", *(f"policy {number}" for number in range(10, 16)), "10 others"]
    shown = {line.get_label(): (line.get_color(), line.get_linestyle()) for line in axes.lines}
    assert len(axes.lines) == 17
    assert len({shown[name] for name in named}) == len(named)
    assert [entry.get_color() for entry in axes.get_legend().legend_handles] == [shown[name][0] for name in named]
    for count in [1, 7]:
        curves = {f"policy {number}": np.linspace(0, number / 20, 21) for number in range(count)}
        (axes,) = draw(plot_curves(curves, label="right (%)")).axes
        assert [text.get_text() for text in axes.get_legend().get_texts()] == list(curves)
        assert len({(line.get_color(), line.get_linestyle()) for line in axes.lines}) == count


def test_scanpath_shows_numbered_fixations(scanpath, image):
    figure = draw(plot_scanpath(scanpath, image, boxes=torch.tensor([[60.0, 45, 79, 59]])))
    axes = figure.axes[0]
    assert [text.get_text() for text in axes.texts] == ["1", "2", "3", "cup 0.60"]
    np.testing.assert_allclose([text.xy for text in axes.texts[:3]], scanpath.fixations + 0.5)
    np.testing.assert_allclose(axes.collections[-1].get_offsets(), scanpath.fixations + 0.5)
    framed = {patch.get_bbox().bounds: patch.get_linestyle() for patch in axes.patches}
    assert framed == {(60, 45, 19, 14): "--", (50, 40, 20, 15): "-"}
    bare = draw(plot_scanpath(scanpath, image, objects=False))
    assert len(bare.axes[0].texts) == 3
    assert axes.get_title() == "“cup” found after 2 gaze shifts"
    explored = draw(plot_scanpath(replace(scanpath, target=None, found=False), image))
    assert explored.axes[0].get_title() == "explored with 2 gaze shifts: 2 objects found"


def test_belief_is_laid_over_a_grey_photograph(scanpath, image):
    """The photograph is unchanged where the belief is 0, and hidden more where the belief is higher."""
    certain = replace(scanpath, posterior=torch.linspace(0, 1, 12).expand(3, 12))
    figure = draw(plot_belief(certain, image=image))
    photograph, overlay = figure.axes[0].images
    pixels = np.asarray(photograph.get_array())
    weights = np.array([0.299, 0.587, 0.114])
    np.testing.assert_allclose(
        pixels, np.repeat((image.permute(1, 2, 0).numpy() @ weights)[..., None], 3, -1), atol=1e-6
    )
    opacity = overlay.to_rgba(np.asarray(overlay.get_array()))[..., 3].ravel()
    assert opacity[0] == 0
    assert (np.diff(opacity) > 0).all()
    assert opacity[-1] == pytest.approx(0.85)
    # The colour bar has the same colours as the overlay.
    (scale,) = figure.axes[1:]
    assert scale.collections[-1].get_cmap() is overlay.get_cmap()
    assert overlay.get_alpha() is None


def test_figures_use_the_photograph_that_the_scanpath_kept(scanpath, image):
    from semfov.detection import Placement
    from semfov.paths.stimulus import Stimulus, in_bytes

    sensor = {"sigma": 20.0, "levels": 2, "growth": 2.0, "convention": "kornia", "reference": 640.0}
    placement = Placement((80, 60), (1.0, 1.0), (0, 0))
    settings = {"sensor": sensor, "detector": {"name": "none"}}
    stimulus = Stimulus(in_bytes(image), placement, settings)
    kept = replace(scanpath, photograph=in_bytes(image), stimulus=stimulus)
    drawn = np.asarray(draw(plot_scanpath(kept)).axes[0].images[0].get_array())
    np.testing.assert_allclose(drawn, image.permute(1, 2, 0), atol=0.5 / 255 + 1e-6)
    assert len(draw(plot_belief(kept)).axes[0].images) == 2
    assert len(draw(plot_foveated_strip(kept)).axes) == 3
    refused("image: expected the photograph", plot_scanpath, scanpath)
    refused("stimulus", plot_foveated_strip, scanpath)


def test_the_legend_names_the_source_of_each_kind_of_box(scanpath, image):
    decision = Decision("found", 0.9, 11, torch.tensor([50.0, 40, 70, 55]))
    other = Detections(torch.tensor([[[0.0, 0, 9, 9]]]), torch.tensor([[[0.5, 0.1, 0.4]]]), torch.ones(1, 1).bool())
    looks = (replace(scanpath.looks[0], detections=other), *scanpath.looks[1:])
    sought = replace(scanpath, decision=decision, ending="decision", looks=looks)
    (axes,) = draw(plot_scanpath(sought, image, boxes=torch.tensor([[60.0, 45, 79, 59]]))).axes
    entries = {
        text.get_text(): line
        for text, line in zip(axes.get_legend().get_texts(), axes.get_legend().get_lines(), strict=True)
    }
    assert list(entries) == ["annotated: cup", "confirmed: cup (1)", "not confirmed: cup from score 0.3 (1)"]
    for box in axes.patches:
        near = [line for line in entries.values() if to_rgba(line.get_color()) == box.get_edgecolor()]
        assert [line.get_linestyle() for line in near] == [box.get_linestyle()]
    (bare,) = draw(plot_scanpath(scanpath, image, objects=False)).axes
    assert bare.get_legend() is None


def test_the_best_place_of_an_undecided_search_is_told_apart_from_other_closer_looks(scanpath, image):
    places = ([50.0, 40, 70, 55], 0.26), ([5.0, 5, 20, 20], 0.2)
    closer = tuple(CloseUp(0, 1, 0, torch.tensor(box), place, 0.8) for box, place in places)
    path = replace(scanpath, decision=Decision("undecided", 0.8), ending="decision", closer=closer, score_threshold=0.9)
    for shown, expected in ((path, ["--", ":"]), (replace(path, closer=closer[:1]), ["--"])):
        (axes,) = draw(plot_scanpath(shown, image)).axes
        best = [box for box in axes.patches if box.get_linestyle() == "--"]
        assert [box.get_bbox().extents.tolist() for box in best] == [places[0][0]]
        assert "best place 0.26" in [text.get_text() for text in axes.texts]
        assert [line.get_linestyle() for line in axes.get_legend().get_lines()] == expected
    (early, *_) = draw(plot_fixation(path, 0, image, image)).axes
    assert not [box for box in early.patches if box.get_linestyle() == "--"]


def test_belief_shows_the_posterior_of_the_search_and_a_strip_every_fixation_on_one_scale(scanpath, image):
    searched = replace(scanpath, posterior=torch.rand(3, 12))
    shown = np.asarray(draw(plot_belief(searched)).axes[0].images[0].get_array())
    np.testing.assert_allclose(shown, searched.posterior[-1].reshape(3, 4))
    other = np.asarray(draw(plot_belief(searched, target=1)).axes[0].images[0].get_array())
    belief = scanpath.probabilities[-1]
    np.testing.assert_allclose(other, (belief[:, 1]).reshape(3, 4), rtol=1e-6)
    for arguments, named in [((3,), "fixation"), ((-4,), "fixation")]:
        refused(named, plot_belief, scanpath, *arguments)
    for path, target in ((scanpath, 3), (replace(scanpath, target=None), None)):
        refused("target", plot_belief, path, target=target)
    figure = draw(plot_belief(scanpath, None, image=image, columns=2))
    belief = scanpath.probabilities[..., 2]
    maps = [axes.images[-1] for axes in figure.axes if axes.get_title()]
    np.testing.assert_allclose([np.asarray(m.get_array()).ravel() for m in maps], belief, rtol=1e-6)
    assert {m.get_clim() for m in maps} == {(0, 1)}
    assert [axes.get_ylabel() for axes in figure.axes if not axes.get_title()] == ["probability of cup"]


@pytest.mark.parametrize("size", [(640, 425), (640, 300), (480, 640)])
@pytest.mark.parametrize("looks", [1, 2, 5])
def test_the_colour_bar_of_a_strip_lies_inside_the_figure(size, looks):
    grid, cells = Grid(4, 4, size), torch.arange(looks)
    belief = torch.full((looks, 16, 2), 0.5)
    classes = "background", "baseball glove"
    figure = draw(plot_belief(small.scanpath(grid, cells, classes, target=1, probabilities=belief), None))
    box, whole = figure.axes[-1].get_tightbbox(), figure.bbox
    assert whole.x0 <= box.x0 < box.x1 <= whole.x1
    assert whole.y0 <= box.y0 < box.y1 <= whole.y1


def test_bars_are_as_high_as_the_posterior(scanpath):
    with mock.patch.object(Axes3D, "bar3d", autospec=True, side_effect=Axes3D.bar3d) as drawn:
        draw(plot_belief_bars(scanpath, most=2))
    belief = scanpath.probabilities[..., 2]
    assert drawn.call_count == 2
    for call, fixation in zip(drawn.call_args_list, (0, 2), strict=True):
        axes, x, y, bottom, _, _, height = call.args
        assert bottom == 0
        np.testing.assert_allclose(height, belief[fixation], rtol=1e-6)
        np.testing.assert_allclose(x, np.tile(np.arange(4), 3) + 0.1)
        np.testing.assert_allclose(y, np.repeat([2, 1, 0], 4) + 0.1)
        assert axes.get_zlim()[1] >= float(belief.max())


def test_strip_shows_views_of_any_size_with_their_detections(scanpath, image):
    views = [image * share for share in (0.2, 0.5, 0.8)]
    figure = draw(plot_foveated_strip(scanpath, views, most=2))
    assert [axes.get_title() for axes in figure.axes] == ["fixation 1", "fixation 3"]
    for axes, view in zip(figure.axes, (views[0], views[2]), strict=True):
        np.testing.assert_allclose(np.asarray(axes.images[0].get_array()), view.permute(1, 2, 0))
        assert {text.get_text() for text in axes.texts} == {"cat 0.80", "cup 0.60"}
        colours = {patch.get_edgecolor() for patch in axes.patches}
        assert len(colours) == 2  # the target's and another
    figure = draw(plot_foveated_strip(scanpath, [image[:, ::2, ::2]] * 3))
    assert tuple(figure.axes[0].images[0].get_extent()) == (0, 80, 60, 0)


def test_plot_of_a_fixation_shows_scanpath_view_and_belief(scanpath, image):
    path, seen, believed, _ = draw(plot_fixation(scanpath, 1, image, image * 0.5)).axes
    assert [text.get_text() for text in path.texts if text.get_visible()] == ["1", "2"]
    np.testing.assert_allclose(np.asarray(seen.images[0].get_array()), (image * 0.5).permute(1, 2, 0))
    belief = scanpath.probabilities[1]
    shown = np.asarray(believed.images[-1].get_array()).ravel()
    np.testing.assert_allclose(shown, belief[:, 2], rtol=1e-6)
    explored = draw(plot_fixation(replace(scanpath, target=None), 1, image, image))
    assert explored.axes[2].get_title() == "semantic map after fixation 2"


def test_figures_do_not_depend_on_matplotlib_settings():
    import matplotlib as mpl

    curves = {"random": np.linspace(0, 1, 5)}
    with mpl.rc_context({"font.size": 30, "xtick.labelsize": 40, "axes.titlesize": 50}):
        axes = draw(plot_curves(curves, label="found (%)", title="t")).axes[0]
        sizes = axes.title.get_size(), axes.xaxis.label.get_size(), axes.get_xticklabels()[0].get_size()
    assert sizes == (9, 9, 8)


def test_colours_differ_in_lightness_or_hue_for_dichromats():
    """The smallest distance in CIELAB, with simulated red and green dichromacy (Viénot et al. 1999)."""
    from itertools import combinations

    codes = [[int(code[n : n + 2], 16) / 255 for n in (1, 3, 5)] for code in COLOURS]
    linear = np.array(codes) ** 2.2
    to_lms = np.array([[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]])
    protan = np.array([[0, 2.02344, -2.52581], [0, 1, 0], [0, 0, 1]])
    deutan = np.array([[1, 0, 0], [0.494207, 0, 1.24827], [0, 0, 1]])
    for lack in (np.eye(3), protan, deutan):
        seen = np.clip(linear @ (np.linalg.inv(to_lms) @ lack @ to_lms).T, 0, 1) ** (1 / 2.2)
        lab = lab_of(seen)
        assert min(np.linalg.norm(a - b) for a, b in combinations(lab, 2)) > 15


def test_episode_has_one_scale_and_a_limited_number_of_panels(scanpath, image):
    figure = draw(plot_episode(scanpath, image, [image] * 3, most=2))
    assert len(figure.axes) == 1 + 2 * 2 + 1  # the last is the scale
    maps = [axes.images[-1] for axes in figure.axes if axes.get_title().startswith("p(cup)")]
    assert {image.get_clim() for image in maps} == {(0, 1)}
    refused("views", plot_episode, scanpath, image, [image])


def test_reliability_of_a_calibrated_model_lies_on_the_diagonal():
    torch.manual_seed(0)
    p = torch.rand(50_000, 1)
    probabilities = torch.cat([p, 1 - p], 1)
    labels = (torch.rand(50_000) > p[:, 0]).long()
    axes = draw(plot_reliability({"perfect": (probabilities, labels)})).axes[0]
    x, y = axes.lines[1].get_data()
    np.testing.assert_allclose(x, y, atol=0.03)


def test_titles_and_labels_are_inside_the_figure(scanpath, image):
    """Also the label of a box at the border, and a title that is longer than the figure is wide."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    corner = Detections(
        torch.tensor([[[70.0, 50, 80, 60]]]), torch.tensor([[[0.1, 0.2, 0.7]]]), torch.ones(1, 1).bool()
    )
    looks = (replace(scanpath.looks[0], detections=corner), *scanpath.looks[1:])
    long = replace(scanpath, looks=looks, classes=("background", "cup", "traffic " * 12))
    figure = plot_scanpath(replace(long, target=2), image)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    (axes,), renderer = figure.axes, canvas.get_renderer()
    for text in (axes.title, *axes.texts):
        drawn = text if text.get_bbox_patch() is None else text.get_bbox_patch()
        inside = figure.bbox if text is axes.title else axes.get_window_extent(renderer)
        box = drawn.get_window_extent(renderer)
        assert box.x0 >= inside.x0
        assert box.x1 <= inside.x1
