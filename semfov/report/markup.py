"""HTML of boxes, pictures and tables, which the parts of pages share."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def rect(box: Sequence[float], kind: str) -> str:
    """Draw a box `(x1, y1, x2, y2)` of a CSS class in an SVG."""
    x1, y1, x2, y2 = box
    return f'<rect class="{kind}" x="{x1:g}" y="{y1:g}" width="{max(x2 - x1, 0):g}" height="{max(y2 - y1, 0):g}"/>'


def framed(box: Sequence[float]) -> str:
    """Draw a box twice: a light line under a coloured one."""
    return rect(box, "under") + rect(box, "over")


def picture(uri: str, size: Sequence[float], name: str) -> str:
    """Place a picture with an id in an SVG, stretched to `(width, height)`."""
    return f'<image id="{name}" href="{uri}" width="{size[0]}" height="{size[1]}" preserveAspectRatio="none"/>'


def data_uri(kind: str, content: bytes) -> str:
    """Encode the file of a picture, of a kind such as `png`, as a URI that a page holds in place of a link."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def scrollable(table: str, label: str) -> str:
    """Put a table into a region that scrolls on a narrow screen, also by keys; its label is plain text."""
    return f'<div class="wide" tabindex="0" role="region" aria-label="{escape(label)}">{table}</div>'


def facts_html(facts: Mapping[str, str]) -> str:
    """List facts by their names."""
    return "".join(f"<div><dt>{name}</dt><dd>{escape(fact)}</dd></div>" for name, fact in facts.items())


def hidden_unless(shown: object) -> str:
    """Write the attribute that hides an element, unless what it shows is there."""
    return "" if shown else " hidden"


def left_out(count: int, what: str) -> str:
    """Say how many objects or detections a list leaves out; empty for none."""
    if not count:
        return ""
    return f"<p>{count} less confident {what}{'s are' if count != 1 else ' is'} left out.</p>"


def table_html(rows: Sequence[Sequence[str]], caption: str) -> str:
    """Make a table whose first row is its head and whose first column names the rows.

    Args:
        rows: texts, not escaped.
        caption: what the table shows.

    Returns:
        HTML.
    """
    (first_heading, *headings), *body_rows = rows
    head = f'<th scope="col">{escape(first_heading)}</th>'
    head += "".join(f'<th scope="col" class="number">{escape(heading)}</th>' for heading in headings)
    body = "".join(f"<tr>{_row(name, numbers)}</tr>" for name, *numbers in body_rows)
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f"<p>{escape(caption)}</p>{scrollable(table, caption)}"


def figure_html(caption: str, figure: Figure) -> str:
    """Embed a figure of matplotlib with its caption, plain text."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=130, bbox_inches="tight", pad_inches=0.02)
    source = data_uri("png", content.getvalue())
    return f'<figure><figcaption>{escape(caption)}</figcaption><img src="{source}" alt="{escape(caption)}"></figure>'


def _row(name: str, numbers: Sequence[str]) -> str:
    """Make the cells of a row of a table."""
    cells = "".join(f'<td class="number">{escape(cell)}</td>' for cell in numbers)
    return f'<th scope="row">{escape(name)}</th>{cells}'
