"""The page of a comparison: in a sentence how ways of looking compare, their figure and their table."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

from semfov.report.markup import figure_html, table_html
from semfov.report.page import page_html

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FIGURE = "AP50 over seconds; the numbers at the points are passes of the detector"
_COLUMNS = (
    "Passes and seconds are means over the pictures. AP50 counts all boxes by their scores. Listed are those that "
    "semfov's score threshold keeps. Right are the listed ones that the reference has, too; the last column counts all "
    "objects of the reference."
)


def comparison_page(about: str, sentences: Sequence[str], table: Sequence[Sequence[str]], figure: Figure) -> str:
    """Make the page.

    Args:
        about: the pictures and the classes, in words.
        sentences: what follows from the comparison, the result first.
        table: rows of cells, the first one the headings.
        figure: the figure.

    Returns:
        The HTML of the page.
    """
    result, *remarks = sentences
    sections = (
        f'<p class="outcome">{escape(result)}</p><p>{escape(about)}</p>'
        f'<div class="curves">{figure_html(_FIGURE, figure)}</div>'
        f"{''.join(f'<p>{escape(sentence)}</p>' for sentence in remarks)}"
        f"{table_html(table, _COLUMNS)}"
    )
    return page_html("semfov beside slices", [], sections=sections)
