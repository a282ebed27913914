"""The page of `semfov demo`: a picture and a result for each task, above the looks that a reader steps through."""

from __future__ import annotations

import io
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, NamedTuple

from semfov.report.episode import Data
from semfov.report.markup import data_uri
from semfov.report.page import page_html
from semfov.viz.animation import write_webp

if TYPE_CHECKING:
    from PIL.Image import Image as PillowImage

_HOLD = 3.0  # seconds for which a film shows its last frame
_QUALITY = 85  # of a film


class DemoPart(NamedTuple):
    """The part of the page for one task.

    Attributes:
        heading: the task, as a question or a few words.
        picture: HTML of a picture or a film.
        result: what was found, in one or two sentences.
        command: command line that does the same with the reader's own picture.
        episode: data of the looks that the reader can step through (`semfov.report.zoom.zoom_data`); None for none.
    """

    heading: str
    picture: str
    result: str
    command: str
    episode: Data | None = None


def demo_page_html(title: str, introduction: str, parts: Sequence[DemoPart]) -> str:
    """Make the page.

    Args:
        title: plain text.
        introduction: plain text below the title.
        parts: the tasks in their order.

    Returns:
        The HTML of the page.
    """
    cards = "".join(_card(part, f"part-{number}") for number, part in enumerate(parts))
    sections = f'<p>{escape(introduction)}</p><div class="parts">{cards}</div>'
    return page_html(title, [part.episode for part in parts if part.episode is not None], sections=sections)


def _card(part: DemoPart, place: str) -> str:
    """Make the section of a task, with a place for its id."""
    # A line of a command ends between its words, not after the dashes of an option.
    command = " ".join(f"<span>{escape(word)}</span>" for word in part.command.split())
    return (
        f'<section aria-labelledby="{place}"><h2 id="{place}">{escape(part.heading)}</h2>'
        f"<figure><figcaption>{escape(part.result)}</figcaption>{part.picture}</figure>"
        f'<p class="hint">On your own: <code>{command}</code></p></section>'
    )


def picture_html(uri: str, label: str) -> str:
    """Show a picture, with a label in its place for those who do not see it."""
    return f'<img src="{uri}" alt="{escape(label)}">'


def film_html(frames: Sequence[PillowImage], seconds: float, label: str) -> str:
    """Show frames one after the other; a browser that is to move little shows the last one alone.

    Args:
        frames: the frames, of one size.
        seconds: duration of a frame; the last one is shown for longer.
        label: what is said in its place to those who do not see it.

    Returns:
        HTML.
    """
    film = io.BytesIO()
    write_webp(frames, film, [seconds] * (len(frames) - 1) + [_HOLD], _QUALITY)
    still = io.BytesIO()
    frames[-1].save(still, "JPEG", quality=80)
    moving = picture_html(data_uri("webp", film.getvalue()), label)
    still_uri = data_uri("jpeg", still.getvalue())
    source = f'<source media="(prefers-reduced-motion: reduce)" srcset="{still_uri}">'
    return f"<picture>{source}{moving}</picture>"
