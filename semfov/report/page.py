"""A page as a single file with markup, style, script and data, which loads nothing from elsewhere."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from semfov.io.files import write_text
from semfov.report.episode import Data, Pool
from semfov.viz.style import PROBABILITY, TIME, UNCERTAINTY, overlay_colours

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

FOLDER = Path(__file__).parent

OPACITY = 0.82
"""Opacity over the photograph of colours that do not stand for probabilities."""

ABOUT = {"name": "Photograph", "detector": "Detector", "sensor": "Sensor", "decision": "Decision"}
"""Entries at the head of a page, by their keys in the data of an episode."""


def write_page(path: Path, title: str, episodes: Sequence[Data], pool: Pool, *, sections: str = "") -> Path:
    """Write a page on which a reader steps through episodes, and return its path; arguments as for `page_html`."""
    write_text(path, page_html(title, episodes, pool, sections=sections))
    return path


def page_html(title: str, episodes: Sequence[Data], pool: Pool, *, sections: str = "") -> str:
    """Make a page on which a reader steps through episodes.

    Args:
        title: plain text.
        episodes: data of the episodes (`semfov.report.episode.episode_data`).
        pool: pictures of the episodes.
        sections: HTML to insert above the episodes, with special characters already escaped.

    Returns:
        The HTML of the page.
    """
    data = {
        "episodes": list(episodes),
        "pictures": pool.pictures,
        "colours": {
            "time": colour_steps(TIME),
            "overlay": colour_steps(overlay_colours()),
            "probability": colour_steps(PROBABILITY, OPACITY),
            "uncertainty": colour_steps(UNCERTAINTY, OPACITY),
        },
    }
    parts = {
        "title": escape(title),
        "style": (FOLDER / "page.css").read_text(encoding="utf-8"),
        "program": (FOLDER / "page.js").read_text(encoding="utf-8"),
        "data": json_script(data),
        "sections": sections,
        "about": about_html(episodes[0] if episodes else None),
    }
    template = (FOLDER / "page.html").read_text(encoding="utf-8")
    # All parts are inserted in one pass, so that braces inside a part are not taken for a placeholder.
    return re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], template)


def about_html(episode: Data | None) -> str:
    """The head of the page: photograph, detector, sensor and decision; the script updates it for other episodes."""
    if episode is None:
        return ""
    told = "".join(
        f'<div><dt>{label}</dt><dd data-about="{key}">{escape(episode[key] or "not recorded")}</dd></div>'
        for key, label in ABOUT.items()
    )
    return f'<dl id="about">{told}</dl>'


def json_script(data: Any) -> str:
    r"""JSON text that is safe inside a script element.

    Args:
        data: JSON values.

    Returns:
        The text, in which `&`, `<` and `>` are escaped.

    >>> json_script({"class": "</script>"})
    '{"class":"\\u003c/script\\u003e"}'
    """
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def colour_steps(colours: str | Colormap, opacity: float = 1.0, steps: int = 33) -> list[list[float]]:
    """Colours of a colour map at equal steps.

    Args:
        colours: matplotlib colour map, or its name.
        opacity: factor on the opacity.
        steps: number of colours.

    Returns:
        For each step red, green and blue from 0 to 255, and opacity from 0 to 1.
    """
    from matplotlib import colormaps

    colours = colormaps[colours] if isinstance(colours, str) else colours
    shades = [colours(step / (steps - 1)) for step in range(steps)]
    return [
        [*(round(255 * float(value)) for value in shade[:3]), round(float(shade[3]) * opacity, 3)] for shade in shades
    ]
