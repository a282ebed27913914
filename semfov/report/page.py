"""A page as a single file with markup, style, script and data, which loads nothing from elsewhere."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from semfov.errors import check
from semfov.io.files import write_text
from semfov.report.episode import Data
from semfov.report.looks import ABOUT, looks_html
from semfov.viz.style import PROBABILITY, TIME, UNCERTAINTY, overlay_colours

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

_FOLDER = Path(__file__).parent

_OPACITY = 0.82
"""Opacity over the photograph of colours that do not stand for probabilities."""


def write_page(path: Path, title: str, episodes: Sequence[Data], *, sections: str = "") -> Path:
    """Write a page on which a reader steps through episodes.

    Args:
        path: the HTML file.
        title: plain text.
        episodes: data of the episodes, from `episode_data` and `zoom_data`, in any order.
        sections: HTML to insert above the episodes, with special characters already escaped.

    Returns:
        The path of the file.

    Raises:
        InputError: the file does not end in `.html` or `.htm`.

    Example::

        path = agent.explore("harbour.tif", passes=16)
        write_page(Path("harbour.html"), "Harbour", [zoom_data(path, "harbour.tif", name="harbour")])
    """
    write_text(page_path(path), page_html(title, episodes, sections=sections))
    return path


def page_path(path: Path) -> Path:
    """Return the path of a page if its suffix is that of a page; otherwise raise `InputError`.

    >>> page_path(Path("cup.pdf"))
    Traceback (most recent call last):
    semfov.errors.InputError: report: expected a file that ends in .html or .htm, got cup.pdf
    """
    check(path.suffix.lower() in (".html", ".htm"), "report", "a file that ends in .html or .htm", path)
    return path


def page_html(title: str, episodes: Sequence[Data], *, sections: str = "") -> str:
    """Make a page on which a reader steps through episodes.

    Args:
        title: plain text.
        episodes: data of the episodes, from `episode_data` and `zoom_data`, in any order.
        sections: HTML to insert above the episodes, with special characters already escaped.

    Returns:
        The HTML of the page.

    >>> page = page_html("Cats & dogs", [])
    >>> page[:15], "<h1>Cats &amp; dogs</h1>" in page
    ('<!DOCTYPE html>', True)
    """
    # Pictures of large pictures are in the markup, which is complete without the script.
    drawn = [picture for episode in episodes if "looks" not in episode for picture in pictures_of(episode)]
    numbers = {picture: number for number, picture in enumerate(dict.fromkeys(drawn))}
    data = {
        "episodes": [_scripted(episode, number, numbers) for number, episode in enumerate(episodes)],
        "pictures": list(numbers),
        "colours": {
            "time": colour_steps(TIME),
            "overlay": colour_steps(overlay_colours()),
            "probability": colour_steps(PROBABILITY, _OPACITY),
            "uncertainty": colour_steps(UNCERTAINTY, _OPACITY),
        },
    }
    contents = {
        "title": escape(title),
        "data": json_script(data),
        "sections": sections,
        "about": _about_html(episodes),
        "looks": "".join(
            looks_html(episode, f"large-{number}", headed=number == 0)
            for number, episode in enumerate(episodes)
            if "looks" in episode
        ),
        "fixations": " hidden" if episodes and all("looks" in episode for episode in episodes) else "",
    }
    return filled("page", contents)


def filled(name: str, contents: dict[str, str]) -> str:
    """The page of a template: head, controls, foot and script of all pages, its own, and contents of placeholders."""

    def text(*files: str) -> str:
        return "".join((_FOLDER / file).read_text(encoding="utf-8") for file in files)

    parts = {"style": text("page.css"), "steps": text("steps.html"), "program": text("steps.js", f"{name}.js")}
    parts |= contents
    # All parts are inserted in one pass, so that braces inside a part are not taken for a placeholder.
    template = text("head.html", f"{name}.html", "foot.html")
    return re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], template)


def _about_html(episodes: Sequence[Data]) -> str:
    """The head of the page: facts about the first episode, which the script updates for other episodes."""
    if not episodes:
        return ""
    rows = []
    for key, label in ABOUT.items():
        if any(key in episode for episode in episodes):
            hidden = "" if episodes[0].get(key) else " hidden"
            fact = escape(episodes[0].get(key) or "")
            rows.append(f'<div{hidden}><dt>{label}</dt><dd data-about="{key}">{fact}</dd></div>')
    return f'<dl id="about" class="facts">{"".join(rows)}</dl>'


def pictures_of(episode: Data) -> list[str]:
    """The pictures of an episode as data URIs, each as often as it is shown."""
    views = [each["view"] for each in episode["looks" if "looks" in episode else "fixations"]]
    return [picture for picture in (episode["image"], *views) if picture is not None]


def _scripted(episode: Data, number: int, pictures: Mapping[str, int]) -> Data:
    """The data of an episode that the page's script reads, as JSON values; each picture is on the page once."""
    if "looks" not in episode:
        fixations = [{**each, "view": pictures.get(each["view"])} for each in episode["fixations"]]
        return {**episode, "image": pictures.get(episode["image"]), "fixations": fixations}
    looks = [{"box": look["box"], "status": look["status"]} for look in episode["looks"]]
    about = {key: episode[key] for key in (*ABOUT, "summary")}
    return {**about, "article": f"large-{number}", "looks": looks}


def json_script(data: Any) -> str:
    r"""JSON text that is safe inside a script element.

    >>> json_script({"class": "</script>"})
    '{"class":"\\u003c/script\\u003e"}'
    """
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def colour_steps(colours: str | Colormap, opacity: float = 1.0, steps: int = 33) -> list[list[float]]:
    """Red, green and blue from 0 to 255 and opacity from 0 to 1 of a colour map of matplotlib, at equal steps."""
    from matplotlib import colormaps

    colours = colormaps[colours] if isinstance(colours, str) else colours
    shades = [colours(step / (steps - 1)) for step in range(steps)]
    return [
        [*(round(255 * float(value)) for value in shade[:3]), round(float(shade[3]) * opacity, 3)] for shade in shades
    ]
