"""The writer of all pages: a template, its style, script and data become a single file that loads nothing."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from semfov.errors import check
from semfov.io.files import write_text

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

_FOLDER = Path(__file__).parent

_STEPS = 33  # of a colour map


def page_path(path: Path, argument: str = "report") -> Path:
    """Return the path of a page if its suffix is that of a page; otherwise raise `InputError` for the argument."""
    check(path.suffix.lower() in (".html", ".htm"), argument, "a file that ends in .html or .htm", path)
    return path


def write_html(path: Path, html: str) -> Path:
    """Write a page, atomically.

    Args:
        path: the file.
        html: the HTML of the page.

    Returns:
        The path.

    Raises:
        InputError: the file does not end in `.html` or `.htm`.
        DataError: the file cannot be written.
    """
    write_text(page_path(path), html)
    return path


def filled(name: str, data: Mapping[str, object], contents: Mapping[str, str]) -> str:
    """Fill a template: head, controls, foot and script of all pages, its own, data, and contents.

    Args:
        name: name of the template, of which there is a `.html` and a `.js` file.
        data: JSON values for its script.
        contents: HTML by the name of the place.

    Returns:
        The HTML of the page.
    """
    script = json.dumps(data, separators=(",", ":"), allow_nan=False)
    parts = {
        "style": _text("page.css"),
        "steps": _text("steps.html"),
        "program": _text("steps.js", "tables.js", f"{name}.js"),
        # The data are inside an element, which no text in them may close.
        "data": script.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"),
        **contents,
    }
    # All parts are inserted in one pass, so that braces inside a part are not taken for a placeholder.
    return re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], _text("head.html", f"{name}.html", "foot.html"))


def _text(*files: str) -> str:
    """Read files of this folder, one after the other."""
    return "".join((_FOLDER / file).read_text(encoding="utf-8") for file in files)


def colour_steps(colours: str | Colormap, opacity: float = 1.0) -> list[list[float]]:
    """Sample a colour map of matplotlib at equal steps.

    Args:
        colours: the colour map, or its name.
        opacity: factor of the opacity.

    Returns:
        Red, green and blue from 0 to 255 and opacity from 0 to 1 of each of 33 steps.
    """
    from matplotlib import colormaps

    colours = colormaps[colours] if isinstance(colours, str) else colours
    steps = []
    for step in range(_STEPS):
        red, green, blue, alpha = (float(value) for value in colours(step / (_STEPS - 1)))
        steps.append([round(255 * red), round(255 * green), round(255 * blue), round(alpha * opacity, 3)])
    return steps
