"""Figures of where people look in two drafts."""

from __future__ import annotations

from textwrap import fill
from typing import TYPE_CHECKING

from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.errors import InputError
from semfov.paths.areas import AreasLike, percent
from semfov.paths.drafts import Drafts
from semfov.viz.drawing import draw_image
from semfov.viz.gaze import BORDERS, draw_areas, draw_first_fixations, draw_gaze
from semfov.viz.style import make_figure, only, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH = 5.0  # of a draft in inches
_TITLE_WIDTH = 64  # letters in a line above a draft
_DIVERGING = "PuOr_r"  # fewer fixations are purple, more are orange


@styled
def plot_drafts(drafts: Drafts, *, areas: AreasLike | None) -> Figure:
    """Draw where people look in two drafts on one scale, and what differs where proportions are the same.

    Args:
        drafts: the drafts.
        areas: areas to draw with their shares, as for `Drafts.shares`.

    Returns:
        The figure.
    """
    predictions = (drafts.first, drafts.second)
    panels = 2 if drafts.difference is None else 3
    heights = [_WIDTH * prediction.size[1] / prediction.size[0] for prediction in predictions]
    height = max(heights) + 0.9  # with the titles
    figure, axes = make_figure(1, panels, width=_WIDTH * panels, height=height, layout="compressed")
    areas_of_drafts = (None, None) if areas is None else drafts.areas(areas)
    for ax, prediction, name, areas_of_draft in zip(axes[:2], predictions, drafts.names, areas_of_drafts, strict=True):
        draw_gaze(ax, prediction, prediction.cells)
        if areas_of_draft is not None:
            draw_areas(ax, prediction, areas_of_draft)
        draw_first_fixations(ax, prediction)
        ax.set_title(_title(name, prediction.caution), parse_math=False)
    if drafts.difference is not None:
        plot_difference(drafts, ax=axes[2])
    figure.suptitle(f"Where people look: {BORDERS}; 1 to 3: the first fixations", fontsize=9)
    return figure


def _title(name: str, caution: str | None) -> str:
    """Break the name of a draft and what speaks against its prediction into lines."""
    title = name if caution is None else f"{name}\nCaution: {caution}"
    return "\n".join(fill(line, _TITLE_WIDTH) for line in title.split("\n"))


@styled
def plot_difference(drafts: Drafts, *, ax: Axes | None = None, title: bool = True) -> Figure:
    """Draw where the second draft has more and fewer fixations than the first, over the mean of both in grey.

    In the mean, what one draft alone has is half transparent, so that what lost its fixations is seen, too.

    Args:
        drafts: the drafts.
        ax: axes to draw in; None makes a figure.
        title: whether a line above the picture says what is drawn.

    Returns:
        The figure.

    Raises:
        InputError: the drafts have other proportions.
    """
    difference = drafts.difference
    moved = drafts.moved
    if difference is None or moved is None:
        raise InputError(f"drafts: expected two pictures of the same proportions, got {drafts.names}")
    width, height = drafts.second.size
    inches = _WIDTH * height / width + 0.6
    figure, (axes,) = make_figure(1, 1, width=_WIDTH, height=inches, layout="compressed", axes=only(ax))
    draw_image(axes, _mean_picture(drafts), Grid(1, 1, drafts.second.size), grey=True)
    # The scale is symmetric, so that its middle colour is no difference.
    most = max(float(difference.abs().max()), 1e-12)  # equal drafts have none
    axes.imshow(
        difference.numpy(),
        extent=(0, width, height, 0),
        cmap=_DIVERGING,
        vmin=-most,
        vmax=most,
        alpha=(difference.abs() / most).sqrt().numpy() * 0.85,
        interpolation="bilinear",
    )
    if title:
        first, second = drafts.names
        colours = f"purple has more in {first}, orange in {second}; grey: both drafts"
        words = f"{percent(moved)} of the fixations move: {colours}"
        axes.set_title(fill(words, _TITLE_WIDTH), parse_math=False)
    return figure


def _mean_picture(drafts: Drafts) -> Tensor:
    """Mean of both pictures, of the size of the second one's."""
    first = drafts.first.image  # (3, H, W)
    second = drafts.second.image  # (3, h, w)
    size = tuple(second.shape[-2:])
    return (F.interpolate(first[None], size, mode="bilinear", antialias=True)[0] + second) / 2
