"""One look for all figures: colours that everyone can tell apart, lines, fonts, sizes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import cache, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, ParamSpec
from weakref import WeakSet

from semfov.errors import check
from semfov.io.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette: told apart with every common form of colour blindness."""

GAZE, TARGET, FOUND, TRUTH, OTHER = COLOURS[0], COLOURS[1], COLOURS[2], COLOURS[4], COLOURS[5]
"""Colours with a meaning: the gaze, the target's detections, its end, annotated boxes, other detections."""

LINES = ("-", "--", "-.", ":")

PROBABILITY = "viridis"
UNCERTAINTY = "cividis"
TIME = "viridis"
OVERLAY = "plasma"
"""Colour maps; all grow steadily in lightness, in grey print too."""

OPACITY = 0.85
"""How much of the photograph an overlay of 1 hides."""

STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
}

FILES: Any = {"pdf.fonttype": 42, "ps.fonttype": 42, "svg.fonttype": "path"}
"""Text in vector files stays sharp and looks the same everywhere: PDFs embed the font, SVGs its outlines."""

Arguments = ParamSpec("Arguments")

_PLACES = ("ax", "axes", "figure")
_laid_out: WeakSet[Figure] = WeakSet()


def styled(plot: Callable[Arguments, Figure]) -> Callable[Arguments, Figure]:
    """Draw a figure with `STYLE`, whatever the caller's settings of matplotlib are."""

    @wraps(plot)
    def draw(*arguments: Arguments.args, **options: Arguments.kwargs) -> Figure:
        from matplotlib import rc_context

        with rc_context(STYLE):
            figure = plot(*arguments, **options)
            # Matplotlib makes the labels of ticks when it draws: they would come in the caller's fonts. A figure of the
            # caller's own is left for him to draw.
            if all(options.get(name) is None for name in _PLACES) and figure not in _laid_out:
                figure.draw_without_rendering()
            teach_notebook()
            return figure

    return draw


def teach_notebook() -> None:
    """Let a notebook show a figure that is a cell's last value: it learns to only when pyplot makes one."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    if shell is None:
        return
    from IPython.core.pylabtools import print_figure
    from matplotlib.figure import Figure

    pictures = shell.display_formatter.formatters["image/png"]
    if Figure not in pictures.type_printers:
        pictures.for_type(Figure, print_figure)


def lay_out(figure: Figure) -> None:
    """Find where everything is, for what is placed by it."""
    figure.draw_without_rendering()
    _laid_out.add(figure)


def make_figure(
    rows: int,
    columns: int,
    width: float,
    height: float,
    ratios: Sequence[float] | None = None,
    layout: Literal["constrained", "compressed"] = "constrained",
    given: Sequence[Axes] | None = None,
) -> tuple[Figure, list[Axes]]:
    """A figure of `width` × `height` inches that needs no window, and its axes, row by row; or the axes that are given.

    The layout is `compressed` for pictures, which keep their proportions: they move together.
    """
    from matplotlib.figure import Figure

    if given is not None:
        every = list(given)
        check(len(every) == rows * columns, "axes", f"{rows * columns} of them", len(every))
        return root(every[0]), every
    figure = Figure(figsize=(width, height), layout=layout)
    return figure, list(figure.subplots(rows, columns, squeeze=False, height_ratios=ratios).flat)


def only(ax: Axes | None) -> list[Axes] | None:
    """One axes as the list that `make_figure` takes."""
    return None if ax is None else [ax]


def root(axes: Axes) -> Figure:
    """The figure that axes are in, whatever part of it they are in."""
    part: Any = axes.figure
    # Of a part of a figure this is the whole figure, and of a figure itself.
    whole: Figure = part.figure
    return whole


def save_figure(figure: Figure, path: str | Path, *, dpi: float = 150) -> Path:
    """Save a figure by the ending of the path, `.png`, `.pdf` or `.svg` among others, whole or not at all.

    Args:
        figure: from any function of `semfov.viz`.
        path: of the file.
        dpi: pixels per inch, for what is made of pixels.

    >>> import tempfile
    >>> from matplotlib.figure import Figure
    >>> save_figure(Figure(), Path(tempfile.mkdtemp()) / "empty.pdf").name
    'empty.pdf'
    """
    from matplotlib import rc_context

    path = Path(path)
    with rc_context(FILES), replacing(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format=path.suffix[1:].lower() or "png")
    return path


@cache
def overlay_colours() -> Colormap:
    r"""Colours of a probability over a photograph: nothing at 0, then ever more of it, :math:`\alpha = 0.85 \sqrt{p}`.

    The root lets small probabilities be seen on a scale that ends at 1.
    """
    import numpy as np
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    share = np.linspace(0, 1, 256)
    colours = colormaps[OVERLAY](share)
    colours[:, 3] = OPACITY * np.sqrt(share)
    return ListedColormap(colours, name="overlay")


def line_style(order: int, count: int) -> dict[str, Any]:
    """Colour and dashes of one of `count` lines; no two are alike, and few lines also differ in dashes."""
    group = len(COLOURS) if count > len(COLOURS) else 2
    return {"color": COLOURS[order % len(COLOURS)], "linestyle": LINES[order // group % len(LINES)]}
