"""Figures of searches, explorations and beliefs, made for print; each function returns a matplotlib figure.

Save a figure with `save_figure(figure, "name.pdf")` (PNG and SVG too). In a notebook, a figure is shown if it is the
last value of a cell. To draw in an existing figure, give its axes as `ax=` or `axes=`.
"""

from semfov.paths.look import CONFIDENT
from semfov.viz.animation import animate
from semfov.viz.belief import plot_belief, plot_belief_bars
from semfov.viz.curves import plot_curves, plot_reliability
from semfov.viz.look import plot_fixation
from semfov.viz.scanpath import plot_episode, plot_foveated_strip, plot_scanpath
from semfov.viz.semantic import plot_semantic_map
from semfov.viz.style import COLOURS, save_figure

__all__ = [
    "COLOURS",
    "CONFIDENT",
    "animate",
    "plot_belief",
    "plot_belief_bars",
    "plot_curves",
    "plot_episode",
    "plot_fixation",
    "plot_foveated_strip",
    "plot_reliability",
    "plot_scanpath",
    "plot_semantic_map",
    "save_figure",
]
