"""The beginning of a page of several pictures: what was found in each, those with a find first, and links to them."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape

from semfov.data.classes import counted
from semfov.io.files import MADE_HERE
from semfov.report.episode import Data

_SIDE = 160  # longest side in pixels of a small picture, twice that on the screen
_ORDER = ("found", "undecided", "absent")  # verdicts, those that a reader looks for first


def overview_html(episodes: Sequence[Data], places: Sequence[str]) -> str:
    """Make a table of the pictures of a page, each with its result, a small picture and a link.

    Args:
        episodes: data of the records, each with its `verdict` (`semfov.report.episode.object_data`).
        places: ids of their parts of the page.

    Returns:
        HTML.
    """
    verdicts = [episode["verdict"] for episode in episodes]
    # The sort is stable, so that equal verdicts keep the order of the pictures.
    order = sorted(range(len(episodes)), key=lambda number: _ORDER.index(verdicts[number]))
    rows = "".join(_row(episodes[number], places[number]) for number in order)
    heads = "".join(
        f'<th scope="col" class="{kind}"><button type="button" class="sort">{head}</button></th>'
        for head, kind in (("picture", ""), ("result", ""), ("objects", "count"))
    )
    return (
        f'<section id="overview" aria-labelledby="overview-title"><h2 id="overview-title">{_headline(verdicts)}</h2>'
        f'<div class="wide" tabindex="0" role="region" aria-label="All pictures"><table class="objects">'
        f"<thead><tr><td></td>{heads}</tr></thead><tbody>{rows}</tbody></table></div></section>\n"
    )


def _headline(verdicts: Sequence[str]) -> str:
    """Count the pictures with a find, and those that are undecided."""
    found = verdicts.count("found")
    undecided = verdicts.count("undecided")
    doubt = f", {undecided} undecided" if undecided else ""
    return f"Found in {found} of {counted(len(verdicts), 'picture')}{doubt}"


def _row(episode: Data, place: str) -> str:
    """Make the row of a picture, whose link leads to its part of the page."""
    small = "" if episode["image"] is None else _small_picture(episode["image"])
    return (
        f'<tr class="{episode["verdict"]}"><td>{small}</td>'
        f'<th scope="row"><a href="#{place}">{escape(episode["name"])}</a></th>'
        f'<td>{escape(episode["summary"])}</td><td class="number count">{episode["count"]}</td></tr>'
    )


def _small_picture(uri: str) -> str:
    """Draw a picture that is given as the data URI of a JPEG, reduced, since the page may have hundreds."""
    from PIL import Image

    content = io.BytesIO(base64.b64decode(uri.partition(",")[2]))  # which the page has encoded itself
    with Image.open(content, formats=("JPEG",)) as picture:
        picture.thumbnail((_SIDE, _SIDE))
        width, height = picture.size
        file = io.BytesIO()
        picture.save(file, "JPEG", quality=70, comment=MADE_HERE)
    source = f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"
    image = f'<image href="{source}" width="{width}" height="{height}"/>'
    return f'<svg class="small" viewBox="0 0 {width} {height}" aria-hidden="true">{image}</svg>'
