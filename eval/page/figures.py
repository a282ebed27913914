"""Figures of the pages of results: the paper's four, for both detectors and foveas, and one of score thresholds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from eval.page.curves import averaged, records_of
from eval.page.experiments import AT_THRESHOLDS, DETECTORS, SCORE_THRESHOLDS
from eval.page.findings import LAST, TESTED
from eval.page.origin import missing
from eval.page.tables import Runs, published, published_columns
from eval.page.thresholds import CONTRASTS, Contrast
from semfov.metrics.episodes import FloatArray
from semfov.viz.curves import plot_curves
from semfov.viz.style import make_figure, save_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class _PaperFigure:
    """A figure of the paper."""

    kind: str
    policies: tuple[str, ...]


PAGE_FIGURES = {
    "prediction_and_calibration": _PaperFigure(
        "search", ("predictive-raw", "predictive-calibrated", "non-predictive-raw", "non-predictive-calibrated")
    ),
    "search_baselines": _PaperFigure(
        "search", ("random", "vocus2", "predictive-calibrated", "non-predictive-calibrated")
    ),
    "acquisition_functions": _PaperFigure(
        "explore", ("kl-calibrated", "negative-entropy-calibrated", "two-peaks-calibrated")
    ),
    "exploration_baselines": _PaperFigure(
        "explore", ("kl-raw", "kl-calibrated", "random-raw", "random-calibrated", "vocus2-calibrated")
    ),
}
"""The figures by the names of their files."""

Panel = tuple[dict[str, FloatArray], dict[str, FloatArray]]
"""Curves in [0, 1] by their names, and their standard errors."""

_LABELS = {"search": "targets found (%)", "explore": "cells with the right class (%)"}


THRESHOLD_FIGURE = "thresholds"
"""File of the figure of differences at all score thresholds."""


def draw_figures(folder: Path, runs: Runs) -> list[Path]:
    """Draw the figures whose experiments are all finished; returns their files."""
    written = []
    if not missing(AT_THRESHOLDS, runs):
        drawn = plot_curve_panels(_threshold_panels(runs), label="difference (points)")
        written.append(save_figure(drawn, folder / f"{THRESHOLD_FIGURE}.png"))
    for name, figure in PAGE_FIGURES.items():
        if not missing(published(figure.kind).values(), runs):
            runs_by_title = published_columns(figure.kind, runs)
            panels = {title: panel(run, figure) for title, run in runs_by_title.items()}
            drawn = plot_curve_panels(panels, label=_LABELS[figure.kind])
            written.append(save_figure(drawn, folder / f"{name}.png"))
    return written


def _threshold_panels(runs: Runs) -> dict[str, Panel]:
    """Make the panels of the differences at all score thresholds, for both headlines and both detectors."""
    panels = {}
    for contrast in CONTRASTS:
        if contrast.finding in (TESTED[0], TESTED[7]):
            for name, title in DETECTORS.items():
                panels[f"{title}\n{contrast.text}"] = _threshold_panel(contrast, name, runs)
    return panels


@styled
def plot_curve_panels(panels: Mapping[str, Panel], *, label: str) -> Figure:
    """Curves of several experiments with the same policies side by side, two in a row, with one legend."""
    rows = -(-len(panels) // 2)
    figure, all_axes = make_figure(rows, 2, width=8.8, height=2.9 * rows + 0.5)
    for axes, (title, (curves, errors)) in zip(all_axes, panels.items(), strict=False):
        plot_curves(curves, errors, label=label, title=title, ax=axes)
        legend = axes.get_legend()
        assert legend is not None
        legend.remove()
    for axes in all_axes[len(panels) :]:
        axes.remove()
    figure.legend(*all_axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def panel(folder: Path, figure: _PaperFigure) -> Panel:
    """Curves of the policies of a run, and their standard errors over the repetitions, as in the paper."""
    last = LAST[figure.kind]
    means = {}
    errors = {}
    for policy in figure.policies:
        curve = averaged(records_of(folder, policy, commonest=figure.kind == "search"), last)
        means[policy] = curve.mean
        errors[policy] = curve.over_repetitions
    return means, errors


def _threshold_panel(contrast: Contrast, name: str, runs: Runs) -> Panel:
    """Curves of a difference at each score threshold with one of `DETECTORS`, and their standard errors over images."""
    means = {}
    errors = {}
    for threshold in SCORE_THRESHOLDS:
        label = f"threshold {threshold:g}"
        means[label], errors[label] = contrast.difference(threshold, name, runs)
    return means, errors
