"""The beginning of a page of several pictures: a row for each, with a small picture, its result, and a link."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

from semfov.data.classes import counted
from semfov.io.files import MADE_HERE
from semfov.report.episode import Data
from semfov.report.markup import data_uri, scrollable

_SIDE = 160  # longest side in pixels of a small picture, twice that on the screen
_ORDER = ("found", "undecided", "absent")  # verdicts, those that a reader looks for first


class OverviewColumn(NamedTuple):
    """Column of an overview, by which a reader can sort.

    Attributes:
        head: its name.
        kind: CSS class of its cells; empty for words.
    """

    head: str
    kind: str = ""


class OverviewRow(NamedTuple):
    """Row of an overview.

    Attributes:
        name: name of the picture.
        place: id of its part of the page.
        small_picture: SVG, from `small_picture`; empty for a picture that was not kept.
        cells: text of the other columns.
        kind: CSS class of the row.
    """

    name: str
    place: str
    small_picture: str
    cells: Sequence[str]
    kind: str = ""


def overview_section(
    headline: str, columns: Sequence[OverviewColumn], rows: Sequence[OverviewRow], total: str = ""
) -> str:
    """Make the section of a page that lists its pictures.

    Args:
        headline: what came of all of them.
        columns: those after the name of the picture.
        rows: the pictures, in the order in which they are listed.
        total: numbers of all of them together; empty for none.

    Returns:
        HTML.
    """
    heads = "".join(map(_head_html, (OverviewColumn("picture"), *columns)))
    lines = "".join(_row_html(row, columns) for row in rows)
    # The first column, of small pictures, has no head and cannot be sorted by.
    head = f"<thead><tr><td></td>{heads}</tr></thead>"
    table = scrollable(f'<table class="objects">{head}<tbody>{lines}</tbody></table>', "All pictures")
    title = f'<h2 id="overview-title">{escape(headline)}</h2>'
    numbers = f"<p>In all: {escape(total)}.</p>" if total else ""
    return f'<section id="overview" aria-labelledby="overview-title">{title}{numbers}{table}</section>\n'


def _head_html(column: OverviewColumn) -> str:
    """Make the head of a column, a button that sorts the rows by it."""
    button = f'<button type="button" class="sort">{escape(column.head)}</button>'
    return f'<th scope="col" class="{column.kind}">{button}</th>'


def overview_html(episodes: Sequence[Data], places: Sequence[str], total: str = "") -> str:
    """Make the overview of searches and explorations, those with a find first.

    Args:
        episodes: data of the records, each with its `verdict` (`semfov.report.episode.object_data`).
        places: ids of their parts of the page.
        total: numbers of all of them together; empty for none.

    Returns:
        HTML.
    """
    verdicts = [episode["verdict"] for episode in episodes]
    # The sort is stable, so that equal verdicts keep the order of the pictures.
    order = sorted(range(len(episodes)), key=lambda number: _ORDER.index(verdicts[number]))
    rows = [_row_of_episode(episodes[number], places[number]) for number in order]
    columns = (OverviewColumn("result"), OverviewColumn("objects", "number count"))
    return overview_section(_headline(verdicts), columns, rows, total)


def small_picture(uri: str | None, marks: str = "") -> str:
    """Draw a picture small, since a page may have hundreds.

    Args:
        uri: the picture as the data URI of a JPEG; None for one that was not kept.
        marks: SVG over it, in shares of its width and height.

    Returns:
        SVG; empty without a picture.
    """
    if uri is None:
        return ""
    from PIL import Image

    content = io.BytesIO(base64.b64decode(uri.partition(",")[2]))  # which the page has encoded itself
    with Image.open(content, formats=("JPEG",)) as picture:
        picture.thumbnail((_SIDE, _SIDE))
        width, height = picture.size
        file = io.BytesIO()
        picture.save(file, "JPEG", quality=70, comment=MADE_HERE)
    image = f'<image href="{data_uri("jpeg", file.getvalue())}" width="{width}" height="{height}"/>'
    over = f'<g transform="scale({width} {height})">{marks}</g>' if marks else ""
    return f'<svg class="small" viewBox="0 0 {width} {height}" aria-hidden="true">{image}{over}</svg>'


def _row_of_episode(episode: Data, place: str) -> OverviewRow:
    """List what came of a search or an exploration."""
    cells = (episode["summary"], str(episode["count"]))
    return OverviewRow(episode["name"], place, small_picture(episode["image"]), cells, episode["verdict"])


def _row_html(row: OverviewRow, columns: Sequence[OverviewColumn]) -> str:
    """Make a row, whose link leads to the part of the picture."""
    cells = ""
    for text, column in zip(row.cells, columns, strict=True):
        css_class = f' class="{column.kind}"' if column.kind else ""
        cells += f"<td{css_class}>{escape(text)}</td>"
    return (
        f'<tr class="{row.kind}"><td>{row.small_picture}</td>'
        f'<th scope="row"><a href="#{row.place}">{escape(row.name)}</a></th>{cells}</tr>'
    )


def _headline(verdicts: Sequence[str]) -> str:
    """Count the pictures with a find, and those that are undecided."""
    found = verdicts.count("found")
    undecided = verdicts.count("undecided")
    doubt = f", {undecided} undecided" if undecided else ""
    return f"Found in {found} of {counted(len(verdicts), 'picture')}{doubt}"
