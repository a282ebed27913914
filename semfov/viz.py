"""Figures of search and belief, drawn to be read in print; each function returns a matplotlib figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.belief.semantic_map import mean
from semfov.detection.detections import Detections
from semfov.errors import InputError, check
from semfov.scanpath import Scanpath

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette: told apart with every common form of colour blindness.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
LINES = ("-", "--", "-.", ":")
STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "font.family": "sans-serif",
}


def plot_cumulative_performance(
    curves: Mapping[str, NDArray[np.float64]],
    errors: Mapping[str, NDArray[np.float64]] | None = None,
    *,
    title: str = "",
) -> Figure:
    """Share of targets found after each gaze shift, one curve per policy, with bands of one standard error.

    Args:
        curves: for each policy its cumulative performance after 0, 1, 2, … gaze shifts, in [0, 1].
        errors: standard errors of the same shape.
        title: title of the figure.

    >>> figure = plot_cumulative_performance({"random": np.linspace(0, 0.8, 31)})
    """
    figure = _plot_curves(curves, errors, title, "targets found (%)")
    figure.axes[0].set_ylim(0, 102)
    return figure


def plot_success_rate(
    curves: Mapping[str, NDArray[np.float64]],
    errors: Mapping[str, NDArray[np.float64]] | None = None,
    *,
    title: str = "",
) -> Figure:
    """Share of the cells with objects whose class is right after each gaze shift.

    Arguments as for `plot_cumulative_performance`.
    """
    return _plot_curves(curves, errors, title, "cells with the right class (%)")


def _plot_curves(
    curves: Mapping[str, NDArray[np.float64]],
    errors: Mapping[str, NDArray[np.float64]] | None,
    title: str,
    label: str,
) -> Figure:
    """Shares after each gaze shift, one curve per policy, with bands of one standard error."""
    from matplotlib import rc_context
    from matplotlib.ticker import MaxNLocator

    many = len(curves) > len(COLOURS)
    figure, (axes,) = _figure(1, 1, width=8.0 if many else 6.2, height=4.0)
    for order, (name, curve) in enumerate(curves.items()):
        line = LINES[order // (len(COLOURS) if many else 2) % len(LINES)]
        colour = COLOURS[order % len(COLOURS)]
        shifts = np.arange(len(curve))
        axes.plot(shifts, 100 * curve, line, color=colour, label=name, linewidth=1.6)
        band = None if errors is None else errors.get(name)
        if band is not None and np.isfinite(band).all():
            alpha = 0.05 if many else 0.15
            axes.fill_between(shifts, 100 * (curve - band), 100 * (curve + band), color=colour, alpha=alpha, lw=0)
    axes.set_xlim(0, max(len(curve) for curve in curves.values()) - 1)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3, linewidth=0.5)
    with rc_context(STYLE):
        axes.set(xlabel="gaze shifts", ylabel=label, title=title)
        if many:
            figure.legend(loc="outside right upper")
        else:
            axes.legend(loc="lower right", framealpha=0.9)
    return figure


def plot_reliability(predictions: Mapping[str, tuple[Tensor, Tensor]], *, bins: int = 15) -> Figure:
    """How often the most probable class is right, against its probability; a calibrated model lies on the diagonal.

    Bins with fewer than 20 predictions are left out: their shares are mostly chance.

    Args:
        predictions: for each model its probabilities `(M, K+1)` and the true classes `(M,)`.
        bins: equally wide bins of probability.
    """
    figure, (axes, below) = _figure(2, 1, width=4.4, height=5.4, ratios=[3, 1])
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="perfectly calibrated")
    for order, (name, (probabilities, labels)) in enumerate(predictions.items()):
        confidence, predicted = probabilities.detach().cpu().max(-1)
        right = (predicted == labels.cpu()).numpy()
        index = np.clip(np.ceil(confidence.numpy() * bins).astype(int) - 1, 0, bins - 1)
        count = np.bincount(index, minlength=bins)
        filled = count >= 20
        mean_confidence = np.bincount(index, confidence.numpy(), bins)[filled] / count[filled]
        accuracy = np.bincount(index, right, bins)[filled] / count[filled]
        axes.plot(
            mean_confidence, accuracy, LINES[order % 4], marker="o", markersize=4, color=COLOURS[order], label=name
        )
        edges = np.linspace(0, 1, bins + 1)
        below.stairs(count / count.sum(), edges, color=COLOURS[order], linestyle=LINES[order % 4], linewidth=1.4)
    axes.set(xlim=(0, 1), ylim=(0, 1), ylabel="share that is right")
    axes.legend(loc="upper left")
    axes.grid(alpha=0.3, linewidth=0.5)
    below.set(xlim=(0, 1), xlabel="probability of the most probable class", ylabel="share")
    return figure


def plot_scanpath(scanpath: Scanpath, image: Tensor, *, boxes: Tensor | None = None) -> Figure:
    """Numbered fixations on the photograph, the grid, and what was detected at the last fixation.

    Args:
        scanpath: the episode.
        image: `(3, H, W)`, RGB in [0, 1].
        boxes: `(M, 4)`, where the target really is (drawn dashed).
    """
    figure, (axes,) = _figure(1, 1, width=6.4, height=6.4 * image.shape[-2] / image.shape[-1] + 0.3)
    _draw_scanpath(axes, scanpath, image, boxes)
    return figure


def plot_belief(
    scanpath: Scanpath, fixation: int = -1, *, target: int | None = None, image: Tensor | None = None
) -> Figure:
    """Probability of a class in every cell after a fixation, over the dimmed photograph where one is given."""
    figure, (axes,) = _figure(1, 1, width=5.6, height=4.6)
    _draw_belief(axes, scanpath, fixation, target, image)
    figure.colorbar(axes.images[-1], ax=axes, label="probability", shrink=0.85)
    return figure


def plot_episode(
    scanpath: Scanpath, image: Tensor, views: Sequence[Tensor], *, boxes: Tensor | None = None, most: int = 5
) -> Figure:
    """A whole search: the scanpath, and for its fixations the foveated view above the target's posterior.

    Args:
        scanpath: the episode.
        image: `(3, H, W)`, RGB in [0, 1].
        views: for each fixation the foveated image `(3, H, W)`, in the frame of `image`.
        boxes: `(M, 4)`, where the target really is (drawn dashed).
        most: at most so many fixations are shown: the first ones and the last.
    """
    check(len(views) == len(scanpath), "views", f"one for each of {len(scanpath)} fixations", len(views))
    shown = list(range(len(scanpath)))
    if len(shown) > most:
        shown = [*shown[: most - 1], shown[-1]]
    aspect = image.shape[-2] / image.shape[-1]
    width = 2.5 * len(shown) + 5.2
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=(width, 2 * 2.5 * aspect + 0.6), layout="constrained")
        sides: Any = figure.subfigures(1, 2, width_ratios=[5.2, width - 5.2])
        left, right = sides
        _draw_scanpath(left.subplots(), scanpath, image, boxes)
        panels = right.subplots(2, len(shown), squeeze=False)
        for (above, below), fixation in zip(panels.T, shown, strict=True):
            _draw_view(above, scanpath, fixation, views[fixation])
            _draw_belief(below, scanpath, fixation, None, image)
    return figure


def _figure(
    rows: int, columns: int, width: float, height: float, ratios: Sequence[float] | None = None
) -> tuple[Figure, list[Axes]]:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        return figure, list(figure.subplots(rows, columns, squeeze=False, height_ratios=ratios).flat)


def _draw_image(axes: Axes, scanpath: Scanpath, image: Tensor, dim: float = 0.0) -> None:
    height, width = image.shape[-2:]
    pixels = image.detach().cpu().clamp(0, 1).permute(1, 2, 0).numpy() * (1 - dim)
    # Pixel edges, not centres, at integers: the frame of boxes and of the grid.
    axes.imshow(pixels, extent=(0, width, height, 0), interpolation="bilinear")
    axes.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])


def _draw_grid(axes: Axes, scanpath: Scanpath) -> None:
    width, height = scanpath.grid.extent.tolist()
    style: dict[str, Any] = {"color": "white", "linewidth": 0.4, "alpha": 0.45}
    for column in range(1, scanpath.grid.columns):
        axes.axvline(column * width / scanpath.grid.columns, **style)
    for row in range(1, scanpath.grid.rows):
        axes.axhline(row * height / scanpath.grid.rows, **style)


def _draw_boxes(axes: Axes, boxes: Tensor, colour: str, line: str = "-", width: float = 1.2) -> None:
    from matplotlib.patches import Rectangle

    for x1, y1, x2, y2 in boxes.tolist():
        axes.add_patch(
            Rectangle((x1, y1), x2 - x1, y2 - y1, fill=False, edgecolor=colour, linestyle=line, linewidth=width)
        )


def _draw_detections(axes: Axes, scanpath: Scanpath, detections: Detections, most: int = 6) -> None:
    """The most confident detections, each labelled by its best class that is not background."""
    sure = detections.confidence[0] >= 0.1
    for box, label, score in zip(
        detections.boxes[0][sure][:most],
        detections.labels[0][sure][:most].tolist(),
        detections.confidence[0][sure][:most].tolist(),
        strict=True,
    ):
        colour = COLOURS[1] if label == scanpath.target else COLOURS[5]
        _draw_boxes(axes, box[None], colour)
        axes.text(
            float(box[0]) + 2,
            float(box[1]) + 2,
            f"{scanpath.classes[label]} {score:.2f}",
            color="white",
            fontsize=6.5,
            va="top",
            clip_on=True,
            bbox={"facecolor": colour, "edgecolor": "none", "pad": 0.8, "alpha": 0.85},
        )


def _draw_scanpath(axes: Axes, scanpath: Scanpath, image: Tensor, boxes: Tensor | None) -> None:
    _draw_image(axes, scanpath, image)
    _draw_grid(axes, scanpath)
    if boxes is not None:
        _draw_boxes(axes, boxes, COLOURS[4], "--", 1.8)
    path = scanpath.fixations.cpu() + 0.5
    axes.plot(path[:, 0], path[:, 1], "-", color="white", linewidth=2.4)
    axes.plot(path[:, 0], path[:, 1], "-", color=COLOURS[0], linewidth=1.4)
    for number, (x, y) in enumerate(path.tolist()):
        last = number == len(path) - 1 and scanpath.found
        axes.plot(x, y, "o", markersize=13, color=COLOURS[2] if last else COLOURS[0], markeredgecolor="white")
        axes.text(x, y, str(number), color="white", ha="center", va="center", fontsize=8, fontweight="bold")
    shifts = f"{scanpath.shifts} gaze shift{'s' if scanpath.shifts != 1 else ''}"
    if scanpath.target is None:
        axes.set_title(f"explored with {shifts}")
    else:
        found = "found after" if scanpath.found else "not found in"
        axes.set_title(f"“{scanpath.classes[scanpath.target]}” {found} {shifts}")


def _draw_view(axes: Axes, scanpath: Scanpath, fixation: int, view: Tensor) -> None:
    _draw_image(axes, scanpath, view)
    _draw_detections(axes, scanpath, scanpath.detections[fixation])
    x, y = (scanpath.fixations[fixation] + 0.5).tolist()
    axes.plot(x, y, "+", color="white", markersize=11, markeredgewidth=2.8, zorder=5)
    axes.plot(x, y, "+", color=COLOURS[0], markersize=10, markeredgewidth=1.4, zorder=5)
    axes.set_title(f"fixation {fixation}")


def _draw_belief(axes: Axes, scanpath: Scanpath, fixation: int, target: int | None, image: Tensor | None) -> None:
    index = scanpath.target if target is None else target
    if index is None:
        raise InputError("target: expected a class index, since the scanpath has none, got None")
    grid = scanpath.grid
    width, height = grid.extent.tolist()
    if image is not None:
        _draw_image(axes, scanpath, image, dim=0.3)
    posteriors = mean(scanpath.beliefs)[..., index].detach().cpu()
    if scanpath.posterior is not None and index == scanpath.target:
        posteriors = scanpath.posterior.detach().cpu()
    posterior = posteriors[fixation].reshape(grid.rows, grid.columns)
    # One scale for the whole episode, so that its pictures can be compared.
    axes.imshow(
        posterior.numpy(),
        extent=(0, width, height, 0),
        cmap="viridis",
        vmin=0,
        vmax=float(posteriors.max()),
        alpha=0.8 if image is not None else 1,
    )
    x, y = (scanpath.fixations[fixation].cpu() + 0.5).tolist()
    axes.plot(x, y, "+", color="white", markersize=9, markeredgewidth=1.8)
    axes.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    axes.set_title(f"p({scanpath.classes[index]}) up to {float(posterior.max()):.2f}")
