"""A page as one file: markup, style, program and data, and nothing fetched from anywhere."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from semfov.io.files import write_text
from semfov.report.episode import Data, Pool
from semfov.viz.style import PROBABILITY, UNCERTAINTY

FOLDER = Path(__file__).parent


def write_page(path: Path, title: str, episodes: Sequence[Data], pool: Pool, *, sections: str = "") -> Path:
    """Write a page with episodes to step through, and return its path.

    Args:
        path: of the page.
        title: plain text.
        episodes: from `episode_data`.
        pool: the pictures of the episodes.
        sections: HTML that stands above the episodes, escaped already.
    """
    data = {
        "episodes": list(episodes),
        "pictures": pool.pictures,
        "colours": {"probability": colour_steps(PROBABILITY), "uncertainty": colour_steps(UNCERTAINTY)},
    }
    parts = {
        "title": escape(title),
        "style": (FOLDER / "page.css").read_text(encoding="utf-8"),
        "program": (FOLDER / "page.js").read_text(encoding="utf-8"),
        "data": json_script(data),
        "sections": sections,
    }
    template = (FOLDER / "page.html").read_text(encoding="utf-8")
    # In one pass, so that nothing in a part is taken for a place to fill in.
    write_text(path, re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], template))
    return path


def json_script(data: Any) -> str:
    """JSON that can stand in a script element, whatever its texts contain.

    >>> json_script({"class": "</script>"})
    '{"class":"\\\\u003c/script\\\\u003e"}'
    """
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def colour_steps(name: str, steps: int = 33) -> list[list[int]]:
    """Red, green and blue of a colour map at equal steps, 0 to 255."""
    from matplotlib import colormaps

    return [[round(255 * value) for value in colormaps[name](step / (steps - 1))[:3]] for step in range(steps)]
