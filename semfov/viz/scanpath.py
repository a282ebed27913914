"""Where the gaze went, and what was seen from there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from semfov.errors import check
from semfov.scanpath import Scanpath
from semfov.viz.belief import draw_belief, draw_semantic_map
from semfov.viz.drawing import (
    check_fixation,
    choose_fixations,
    draw_boxes,
    draw_detections,
    draw_gaze,
    draw_grid,
    draw_image,
)
from semfov.viz.style import FOUND, GAZE, TRUTH, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@styled
def plot_scanpath(scanpath: Scanpath, image: Tensor, *, boxes: Tensor | None = None, detections: bool = True) -> Figure:
    """Numbered fixations on the photograph, the grid, and what was detected from the last fixation.

    Args:
        scanpath: the episode.
        image: `(3, H, W)`, RGB in [0, 1].
        boxes: `(M, 4)`, where the target really is (drawn dashed).
        detections: draw those of the last fixation.
    """
    figure, (axes,) = make_figure(
        1, 1, width=6.4, height=6.4 * image.shape[-2] / image.shape[-1] + 0.3, layout="compressed"
    )
    draw_scanpath(axes, scanpath, image, boxes)
    if detections:
        figure.draw_without_rendering()
        draw_detections(axes, scanpath, len(scanpath) - 1, kept_free=len(scanpath))
    return figure


@styled
def plot_foveated_strip(scanpath: Scanpath, views: Sequence[Tensor], *, most: int = 10, columns: int = 5) -> Figure:
    """What the eye was shown at each fixation, with what it detected there.

    Args:
        scanpath: the episode.
        views: for each fixation the foveated photograph `(3, h, w)`, of any size.
        most: at most so many fixations are shown: the first ones and the last.
        columns: pictures side by side.
    """
    _check_views(scanpath, views)
    check(columns >= 1, "columns", "at least 1", columns)
    shown = choose_fixations(scanpath, most)
    columns = min(columns, len(shown))
    rows = -(-len(shown) // columns)
    height = 2.6 * views[0].shape[-2] / views[0].shape[-1] + 0.3
    figure, panels = make_figure(rows, columns, width=2.6 * columns, height=rows * height, layout="compressed")
    for axes, fixation in zip(panels, shown, strict=False):
        _draw_view(axes, scanpath, fixation, views[fixation])
    for axes in panels[len(shown) :]:
        axes.remove()
    _label_views(figure, scanpath, zip(panels, shown, strict=False))
    return figure


@styled
def plot_episode(
    scanpath: Scanpath, image: Tensor, views: Sequence[Tensor], *, boxes: Tensor | None = None, most: int = 5
) -> Figure:
    """A whole search: the scanpath, and for its fixations the foveated view above the target's posterior.

    Args:
        scanpath: the episode.
        image: `(3, H, W)`, RGB in [0, 1].
        views: for each fixation the foveated photograph `(3, h, w)`, of any size.
        boxes: `(M, 4)`, where the target really is (drawn dashed).
        most: at most so many fixations are shown: the first ones and the last.
    """
    from matplotlib.figure import Figure

    _check_views(scanpath, views)
    shown = choose_fixations(scanpath, most)
    aspect = image.shape[-2] / image.shape[-1]
    width = 2.5 * len(shown) + 5.2
    figure = Figure(figsize=(width, 2 * 2.5 * aspect + 0.6), layout="constrained")
    sides: Any = figure.subfigures(1, 2, width_ratios=[5.2, width - 5.2])
    left, right = sides
    draw_scanpath(left.subplots(), scanpath, image, boxes)
    panels = right.subplots(2, len(shown), squeeze=False)
    for (above, below), fixation in zip(panels.T, shown, strict=True):
        _draw_view(above, scanpath, fixation, views[fixation])
        draw_belief(below, scanpath, fixation, None, image)
    _label_views(figure, scanpath, zip(panels[0], shown, strict=True))
    return figure


@styled
def plot_fixation(
    scanpath: Scanpath, fixation: int, image: Tensor, view: Tensor, *, boxes: Tensor | None = None
) -> Figure:
    """One fixation: the scanpath so far, what was seen, what was believed after it; a frame of an animation.

    The belief is the target's posterior, or what is where if nothing is searched for.

    Args:
        scanpath: the episode.
        fixation: its number; -1 is the last.
        image: `(3, H, W)`, RGB in [0, 1].
        view: the foveated photograph `(3, h, w)`, of any size.
        boxes: `(M, 4)`, where the target really is (drawn dashed).
    """
    fixation = check_fixation(scanpath, fixation)
    figure, (left, middle, right) = make_figure(
        1, 3, width=12, height=4 * image.shape[-2] / image.shape[-1] + 0.3, layout="compressed"
    )
    draw_scanpath(left, scanpath, image, boxes, last=fixation)
    _draw_view(middle, scanpath, fixation, view)
    middle.set_title("what the eye sees")
    if scanpath.target is None:
        draw_semantic_map(right, scanpath, fixation, image)
    else:
        draw_belief(right, scanpath, fixation, None, image)
    _label_views(figure, scanpath, [(middle, fixation)])
    return figure


def draw_scanpath(
    axes: Axes, scanpath: Scanpath, image: Tensor, boxes: Tensor | None = None, last: int | None = None
) -> None:
    """Numbered fixations on the photograph, up to the `last` one shown."""
    draw_image(axes, image, scanpath.grid)
    draw_grid(axes, scanpath.grid)
    if boxes is not None:
        draw_boxes(axes, boxes, TRUTH, "--", 1.8)
    end = len(scanpath) - 1 if last is None else last
    path = scanpath.fixations[: end + 1].cpu() + 0.5
    axes.plot(path[:, 0], path[:, 1], "-", color="white", linewidth=2.4)
    axes.plot(path[:, 0], path[:, 1], "-", color=GAZE, linewidth=1.4)
    for number, (x, y) in enumerate(path.tolist()):
        colour = FOUND if scanpath.found and number == len(scanpath) - 1 else GAZE
        axes.plot(x, y, "o", markersize=13, color=colour, markeredgecolor="white", zorder=6)
        axes.text(x, y, str(number), color="white", ha="center", va="center", fontsize=8, fontweight="bold", zorder=7)
    axes.set_title(describe(scanpath) if last is None else f"fixation {last}")


def why_it_ended(scanpath: Scanpath) -> str:
    """Why an episode ended, in a sentence; nothing where that is not known."""
    if scanpath.ending == "decision" and scanpath.decision is not None:
        return {
            "found": "The target is probable enough, and was looked at closely enough.",
            "absent": "No cell is left that is worth a look, and the target is rather not there.",
            "undecided": "No cell is left that is worth a look, but the target rather is there.",
        }[scanpath.decision.outcome]
    reasons = {
        "box": "The gaze is on a box of the target.",
        "price": "No look is expected to name enough more cells right.",
        "shifts": f"All {scanpath.shifts} gaze shifts were made.",
        "cells": "Every cell was fixated.",
    }
    return reasons.get(scanpath.ending or "", "")


def describe(scanpath: Scanpath) -> str:
    """What came of an episode, in a line."""
    shifts = f"{scanpath.shifts} gaze shift{'s' if scanpath.shifts != 1 else ''}"
    if scanpath.target is None:
        return f"explored with {shifts}"
    name, decision = scanpath.classes[scanpath.target], scanpath.decision
    if decision is None:
        return f"“{name}” {'found after' if scanpath.found else 'not found in'} {shifts}"
    sure = f"probability {decision.probability:.2f}"
    if decision.outcome == "found":
        return f"“{name}” found after {shifts} ({sure})"
    return f"“{name}” {'not there' if decision.outcome == 'absent' else 'undecided'} after {shifts} ({sure})"


def _draw_view(axes: Axes, scanpath: Scanpath, fixation: int, view: Tensor) -> None:
    draw_image(axes, view, scanpath.grid)
    draw_gaze(axes, scanpath, fixation)
    axes.set_title(f"fixation {fixation}")


def _label_views(figure: Figure, scanpath: Scanpath, views: Iterable[tuple[Axes, int]]) -> None:
    """Detections of views; where their labels fit is known only once the figure is laid out."""
    figure.draw_without_rendering()
    for axes, fixation in views:
        draw_detections(axes, scanpath, fixation)


def _check_views(scanpath: Scanpath, views: Sequence[Tensor]) -> None:
    check(len(views) == len(scanpath), "views", f"one for each of {len(scanpath)} fixations", len(views))
