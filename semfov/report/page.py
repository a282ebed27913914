"""A page on which a reader steps through records, as a single file that loads nothing from elsewhere.

Looks at windows are complete without the script (`semfov.report.parts`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from semfov.paths.look import CONFIDENT
from semfov.report.episode import Data
from semfov.report.markup import hidden_unless
from semfov.report.overview import overview_html
from semfov.report.parts import ABOUT, Part, part_of
from semfov.report.template import colour_steps, filled, write_html
from semfov.viz.style import PROBABILITY, TIME, UNCERTAINTY, overlay_colours

_OPACITY = 0.82  # opacity over the photograph of colours that do not stand for probabilities


def write_page(path: Path, title: str, episodes: Sequence[Data], *, sections: str = "", total: str = "") -> Path:
    """Write a page on which a reader steps through episodes.

    Args:
        path: the HTML file.
        title: plain text.
        episodes: data of the episodes, from `episode_data` and `zoom_data`, in any order.
        sections: HTML to insert above the episodes, with special characters already escaped.
        total: what came of all episodes together, for the overview.

    Returns:
        The path of the file.

    Raises:
        InputError: the file does not end in `.html` or `.htm`.

    Example::

        path = agent.explore("harbour.tif", passes=16)
        write_page(Path("harbour.html"), "Harbour", [zoom_data(path, "harbour.tif", name="harbour")])
    """
    return write_html(path, page_html(title, episodes, sections=sections, total=total))


def page_html(title: str, episodes: Sequence[Data], *, sections: str = "", total: str = "") -> str:
    """Make a page on which a reader steps through episodes.

    Args:
        title: plain text.
        episodes: data of the episodes, from `episode_data` and `zoom_data`, in any order.
        sections: HTML to insert above the episodes, with special characters already escaped. Without it, several
            episodes have an overview (`semfov.report.overview`).
        total: what came of all episodes together, for the overview.

    Returns:
        The HTML of the page.

    >>> page = page_html("Cats & dogs", [])
    >>> page[:15], "<h1>Cats &amp; dogs</h1>" in page
    ('<!DOCTYPE html>', True)
    """
    parts = [part_of(episode, number) for number, episode in enumerate(episodes)]
    if len(episodes) > 1 and not sections:
        sections = overview_html(episodes, [part.article for part in parts], total)
    # A single episode begins with its outcome, and one of several has it where it is chosen.
    is_single = len(episodes) == 1 and not sections
    contents = _of_single(episodes[0]) if is_single else _of_several(episodes)
    has_fixations = not parts or any(part.is_drawn_by_script for part in parts)
    contents |= {
        "title": escape(title),
        "sections": sections,
        "looks": "".join(part.looks_html(is_named=not is_single) for part in parts),
        "objects": "".join(part.section_html for part in parts),
        "least": f"{CONFIDENT:g}",
        "fixations": hidden_unless(has_fixations),
    }
    return filled("page", _script_data(parts), contents)


def _script_data(parts: Sequence[Part]) -> Data:
    """Collect what the script of a page reads; each picture of the episodes that it draws is in it once.

    Articles of windows and of heads embed their pictures in the markup, each a copy, and have none here
    (`semfov.report.looks`).
    """
    numbers: dict[str, int] = {}
    for part in parts:
        for uri in part.pictures:
            numbers.setdefault(uri, len(numbers))
    return {
        "episodes": [part.script_data(numbers) for part in parts],
        "pictures": list(numbers),
        "colours": {
            "time": colour_steps(TIME),
            "overlay": colour_steps(overlay_colours()),
            "probability": colour_steps(PROBABILITY, _OPACITY),
            "uncertainty": colour_steps(UNCERTAINTY, _OPACITY),
        },
    }


def _of_single(episode: Data) -> dict[str, str]:
    """Fill the places of a page that depend on how many episodes there are, for one."""
    return {
        "outcome": _outcome_html(episode),
        "heading": ' class="unseen"',
        "of_episode": "",
        "details": _details_html(episode, _known_details(episode)),
    }


def _of_several(episodes: Sequence[Data]) -> dict[str, str]:
    """Fill them for several episodes, of which one is chosen; the script tells each place of that one."""
    of_episode = ""
    details = ""
    if episodes:
        of_episode = _outcome_html(episodes[0])
        details = _details_html(episodes[0], _DETAILS)
    return {"outcome": "", "heading": "", "of_episode": of_episode, "details": details}


def _outcome_html(episode: Data) -> str:
    """Say what came of a single episode, below the title."""
    fact = escape(episode["decision"] or "")
    return f'<div{hidden_unless(fact)}><p class="outcome" data-about="decision">{fact}</p></div>'


_DETAILS = tuple(fact for fact in ABOUT if fact != "decision")
"""Facts at the end of a page; the decision is at its beginning."""


def _known_details(episode: Data) -> list[str]:
    """Choose the details of a single episode; a picture without a file is named by its size, which is one of them."""
    is_named = episode["name"] != episode["pixels"]
    return [fact for fact in _DETAILS if is_named or fact != "name"]


def _details_html(episode: Data, facts: Iterable[str]) -> str:
    """List facts about the first episode, which the script updates; those that are not known of it are hidden."""
    rows = []
    for key in facts:
        fact = escape(episode[key] or "")
        definition = f'<dt>{ABOUT[key]}</dt><dd data-about="{key}">{fact}</dd>'
        rows.append(f"<div{hidden_unless(fact)}>{definition}</div>")
    return f'<h3>Details</h3><dl id="about" class="facts">{"".join(rows)}</dl>\n'
