"""The part of a page in which two drafts are beside each other."""

from __future__ import annotations

from html import escape

from semfov.paths.areas import AreasLike, percent, percentage_points
from semfov.paths.drafts import Drafts
from semfov.report.markup import figure_html, scrollable
from semfov.viz.drafts import plot_difference
from semfov.viz.gaze import BORDERS, plot_gaze


def drafts_section(drafts: Drafts, areas: AreasLike | None = None) -> str:
    """Make the part of a page with both maps on one scale, what differs, and the shares of areas.

    Args:
        drafts: the drafts.
        areas: areas of interest, as for `Drafts.shares`.

    Returns:
        HTML.
    """
    boxes = (None, None) if areas is None else drafts.areas(areas)
    panels = [
        figure_html(name, plot_gaze(prediction, areas=these, title=False))
        for name, prediction, these in zip(drafts.names, (drafts.first, drafts.second), boxes, strict=True)
    ]
    if drafts.difference is not None:
        first, second = drafts.names
        caption = f"Purple: more fixations in {first}; orange: more in {second}; grey: both drafts"
        panels.append(figure_html(caption, plot_difference(drafts, title=False)))
    return (
        f'<section aria-labelledby="drafts-title"><h2 id="drafts-title">{escape(_headline(drafts))}</h2>'
        f"{_table(drafts, areas)}{_same_place(drafts, areas)}"
        f'<p class="hint">In both pictures, {BORDERS}. 1 to 3 are the first fixations.</p>'
        f'<div class="pictures">{"".join(panels)}</div></section>'
    )


def _headline(drafts: Drafts) -> str:
    """Say in a few words how the drafts differ."""
    if drafts.moved is None:
        return "The two drafts"
    return f"{percent(drafts.moved)} of the fixations move between the drafts"


def _same_place(drafts: Drafts, areas: AreasLike | None) -> str:
    """Say in a line that the areas are at the same place in both drafts, if they are."""
    place = None if areas is None else drafts.same_place(areas)
    return "" if place is None else f'<p class="hint">{escape(place)}</p>'


def _table(drafts: Drafts, areas: AreasLike | None) -> str:
    """Make the table of the shares of areas; nothing without areas."""
    if areas is None:
        return ""
    rows = ""
    for name, shares in drafts.shares(areas).items():
        cells = (percent(shares.first), percent(shares.second), percentage_points(shares.difference))
        numbers = "".join(f"<td>{cell}</td>" for cell in cells)
        rows += f'<tr><th scope="row">{escape(name)}</th>{numbers}</tr>'
    headings = "".join(f'<th scope="col">{escape(text)}</th>' for text in ("Area", *drafts.names, "Change"))
    caption = "Share of all fixations in each area; the change is in percentage points"
    table = (
        f'<table class="wraps"><caption>{caption}</caption>'
        f"<thead><tr>{headings}</tr></thead><tbody>{rows}</tbody></table>"
    )
    return scrollable(table, "Areas")
