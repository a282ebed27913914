"""A page as one file: markup, style, program and data, and nothing fetched from anywhere."""

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
"""Of colours that are no probabilities, over the photograph."""

ABOUT = {"name": "Photograph", "detector": "Detector", "sensor": "Sensor", "decision": "Decision"}
"""What stands at the head of a page, by its key in an episode's data."""


def write_page(path: Path, title: str, episodes: Sequence[Data], pool: Pool, *, sections: str = "") -> Path:
    """Write a page with episodes to step through, and return its path; arguments as for `page_html`."""
    write_text(path, page_html(title, episodes, pool, sections=sections))
    return path


def page_html(title: str, episodes: Sequence[Data], pool: Pool, *, sections: str = "") -> str:
    """A page with episodes to step through.

    Args:
        title: plain text.
        episodes: from `episode_data`.
        pool: the pictures of the episodes.
        sections: HTML that stands above the episodes, escaped already.
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
    # In one pass, so that nothing in a part is taken for a place to fill in.
    return re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], template)


def about_html(episode: Data | None) -> str:
    """What was looked at, by what, and what came of it; the program changes it when it opens another episode."""
    if episode is None:
        return ""
    told = "".join(
        f'<div><dt>{label}</dt><dd data-about="{key}">{escape(episode[key] or "not recorded")}</dd></div>'
        for key, label in ABOUT.items()
    )
    return f'<dl id="about">{told}</dl>'


def json_script(data: Any) -> str:
    """JSON that can stand in a script element, whatever its texts contain.

    >>> json_script({"class": "</script>"})
    '{"class":"\\\\u003c/script\\\\u003e"}'
    """
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def colour_steps(colours: str | Colormap, opacity: float = 1.0, steps: int = 33) -> list[list[float]]:
    """Red, green and blue of a colour map at equal steps, 0 to 255, and the opacity, 0 to 1."""
    from matplotlib import colormaps

    colours = colormaps[colours] if isinstance(colours, str) else colours
    shades = [colours(step / (steps - 1)) for step in range(steps)]
    return [
        [*(round(255 * float(value)) for value in shade[:3]), round(float(shade[3]) * opacity, 3)] for shade in shades
    ]
