"""The common style of all figures: colours for colour-blind readers, lines, fonts and sizes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import cache, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypedDict
from weakref import WeakSet

from semfov.errors import check
from semfov.io.files import MADE_HERE, replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, whose colours differ under every common form of colour blindness."""

GAZE = COLOURS[0]
TARGET = COLOURS[1]  # detections of the target
FOUND = COLOURS[2]  # the found target
TRUTH = COLOURS[4]  # annotated boxes
OTHER = COLOURS[5]  # other detections

_LINES = ("-", "--", "-.", ":")

PROBABILITY = "viridis"
UNCERTAINTY = "cividis"
TIME = "viridis"
_OVERLAY = "plasma"
"""Colour maps, whose lightness increases steadily, so that they work in grey print too."""

_OPACITY = 0.85  # opacity of an overlay where the probability is 1

LARGEST_SHARE = 0.9
"""Share of all fixations in the largest area that is coloured."""

STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
}

_FILES: Any = {"pdf.fonttype": 42, "ps.fonttype": 42, "svg.fonttype": "path"}
"""Text in vector files looks the same everywhere: PDFs embed the font, and SVGs its outlines."""

_Arguments = ParamSpec("_Arguments")

_PLACES = ("ax", "axes", "figure")
_laid_out: WeakSet[Figure] = WeakSet()


def styled(plot: Callable[_Arguments, Figure]) -> Callable[_Arguments, Figure]:
    """Decorate a plot function to draw with `STYLE`, whatever the caller's settings of matplotlib are."""

    @wraps(plot)
    def draw(*arguments: _Arguments.args, **options: _Arguments.kwargs) -> Figure:
        from matplotlib import rc_context

        with rc_context(STYLE):
            figure = plot(*arguments, **options)
            # Matplotlib makes the labels of ticks when it draws, and would then use the caller's fonts. A figure that
            # the caller has given is left for the caller to draw.
            if all(options.get(name) is None for name in _PLACES):
                if figure not in _laid_out:
                    figure.draw_without_rendering()
                _show_in_notebook(figure)
            return figure

    return draw


_waiting: list[Figure] = []


def _show_in_notebook(figure: Figure) -> None:
    """Let a notebook show a figure: as the last value of its cell, or else at the end of the cell, as pyplot does."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    if shell is None:
        return
    from matplotlib.figure import Figure

    shows_pictures = hasattr(shell, "kernel")  # a terminal has none, and can show none
    pictures = shell.display_formatter.formatters["image/png"]
    if Figure not in pictures.type_printers:
        pictures.for_type(Figure, _print_once)
        if shows_pictures:
            shell.events.register("post_execute", _end_cell)
    if shows_pictures:
        _waiting.append(figure)


def _print_once(figure: Figure) -> object:
    """Print a figure that is the last value of the cell, which then need not wait for the end."""
    from IPython.core.pylabtools import print_figure

    _waiting[:] = [waiting for waiting in _waiting if waiting is not figure]
    return print_figure(figure)


def _end_cell() -> None:
    """Show the figures that the cell has made and not returned."""
    from IPython.display import display

    while _waiting:
        display(_waiting.pop(0))


def lay_out(figure: Figure) -> None:
    """Compute the layout of a figure, for parts whose position depends on it."""
    figure.draw_without_rendering()
    _laid_out.add(figure)


def make_figure(
    rows: int,
    columns: int,
    width: float,
    height: float,
    ratios: Sequence[float] | None = None,
    layout: Literal["constrained", "compressed"] = "constrained",
    axes: Sequence[Axes] | None = None,
) -> tuple[Figure, list[Axes]]:
    """Make a figure without a window, or use the given axes.

    Args:
        rows: rows of axes.
        columns: columns of axes.
        width: of the figure, in inches.
        height: of the figure, in inches.
        ratios: heights of the rows, relative to each other; None for equal ones.
        layout: Matplotlib's layout.
        axes: axes to use; None makes them.

    Returns:
        The figure, and its axes row by row.

    Raises:
        InputError: there are too few or too many axes.
    """
    from matplotlib.figure import Figure

    if axes is not None:
        check(len(axes) == rows * columns, "axes", f"{rows * columns} axes", len(axes))
        return root(axes[0]), list(axes)
    figure = Figure(figsize=(width, height), layout=layout)
    return figure, list(figure.subplots(rows, columns, squeeze=False, height_ratios=ratios).flat)


def only(ax: Axes | None) -> list[Axes] | None:
    """Wrap a single `ax` in the list that `make_figure` takes; refuse others, such as the name of a file."""
    from matplotlib.axes import Axes

    remedy = "a figure is written by semfov.viz.save_figure(record.plot(), path)"
    check(ax is None or isinstance(ax, Axes), "ax", "axes of Matplotlib, or None", f"{ax!r}; {remedy}")
    return None if ax is None else [ax]


def root(axes: Axes) -> Figure:
    """Return the figure that contains axes, also where they are in a subfigure."""
    part: Any = axes.figure
    # For a subfigure this is the whole figure, and for a figure it is the figure itself.
    return part.figure


def save_figure(figure: Figure, path: str | Path, *, dpi: float = 150) -> Path:
    """Save a figure in the format of the suffix, such as `.png`, `.pdf` or `.svg`; the file is written atomically.

    Args:
        figure: from any function of `semfov.viz`.
        path: of the file.
        dpi: pixels per inch, for pictures inside the figure.

    Returns:
        The path.

    Raises:
        InputError: the format is unknown.
        DataError: the file cannot be written.

    >>> import tempfile
    >>> from matplotlib.figure import Figure
    >>> save_figure(Figure(), Path(tempfile.mkdtemp()) / "empty.pdf").name
    'empty.pdf'
    """
    from matplotlib import rc_context

    path = Path(path)
    kinds = figure.canvas.get_supported_filetypes()
    kind = path.suffix[1:].lower() or "png"
    check(kind in kinds, "path", f"a file that ends in {', '.join(f'.{kind}' for kind in kinds)}", path.name)
    metadata = {"Software": MADE_HERE} if kind == "png" else None
    with rc_context(_FILES), replacing(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format=kind, metadata=metadata)
    return path


@cache
def overlay_colours() -> Colormap:
    r"""Make the colour map of probabilities over a photograph, whose opacity is :math:`\alpha = 0.85 \sqrt{p}`."""
    import numpy as np
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    share = np.linspace(0, 1, 256)
    colours = colormaps[_OVERLAY](share)
    colours[:, 3] = _OPACITY * np.sqrt(share)
    return ListedColormap(colours, name="overlay")


@cache
def share_colours() -> Colormap:
    """Make the colour map of shares from 0 to 1 over a photograph, whose own colours stay visible.

    The smallest areas are the most opaque, and what only the whole picture holds is clear.
    """
    import numpy as np
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    share = np.linspace(0, 1, 256)
    weight = (1 - share / LARGEST_SHARE).clip(0, 1)
    colours = colormaps[_OVERLAY](0.4 + 0.55 * weight)
    colours[:, 3] = np.where(share <= LARGEST_SHARE, 0.05 + 0.45 * weight, 0)
    return ListedColormap(colours, name="shares")


class LineStyle(TypedDict):
    """Colour and dashes of a line, as matplotlib names them."""

    color: str
    linestyle: str


def line_style(order: int, count: int) -> LineStyle:
    """Choose colour and dashes of line `order` of `count`; no two are alike, and few lines differ in dashes too."""
    group = len(COLOURS) if count > len(COLOURS) else 2
    return {"color": COLOURS[order % len(COLOURS)], "linestyle": _LINES[order // group % len(_LINES)]}
