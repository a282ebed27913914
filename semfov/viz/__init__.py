"""Figures of search and belief, drawn to be read in print; each function returns a matplotlib figure.

Save one with `figure.savefig("name.png", dpi=150)`; in a notebook, let it be the last value of a cell.
"""

from semfov.viz.belief import (
    class_posterior,
    entropy,
    named_regions,
    plot_belief,
    plot_belief_bars,
    plot_belief_strip,
    plot_semantic_map,
)
from semfov.viz.curves import plot_cumulative_performance, plot_curve_panels, plot_success_rate
from semfov.viz.drawing import CONFIDENT
from semfov.viz.reliability import plot_cell_reliability, plot_reliability
from semfov.viz.saliency import plot_saliency
from semfov.viz.scanpath import describe, plot_episode, plot_fixation, plot_foveated_strip, plot_scanpath, why_it_ended
from semfov.viz.style import COLOURS

__all__ = [
    "COLOURS",
    "CONFIDENT",
    "class_posterior",
    "describe",
    "entropy",
    "named_regions",
    "plot_belief",
    "plot_belief_bars",
    "plot_belief_strip",
    "plot_cell_reliability",
    "plot_cumulative_performance",
    "plot_curve_panels",
    "plot_episode",
    "plot_fixation",
    "plot_foveated_strip",
    "plot_reliability",
    "plot_saliency",
    "plot_scanpath",
    "plot_semantic_map",
    "plot_success_rate",
    "why_it_ended",
]
