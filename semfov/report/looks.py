"""The looks at a large picture as HTML, which is complete without JavaScript."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from semfov.report.episode import Data
from semfov.report.zoom import LISTED
from semfov.viz.labels import place_labels

ABOUT = {
    "name": "Photograph",
    "pixels": "Size",
    "detector": "Detector",
    "sensor": "Sensor",
    "passes": "Passes of the detector",
    "decision": "Outcome",
}
"""Entries at the head of an episode, by their keys in its data."""


def looks_html(data: Data, place: str, *, headed: bool = True) -> str:
    """The picture with its windows and objects, all looks, and a table of the objects."""
    name, count = escape(data["name"]), data["count"]
    facts = "".join(f"<div><dt>{ABOUT[key]}</dt><dd>{escape(data[key] or 'not recorded')}</dd></div>" for key in ABOUT)
    head = "" if headed else f'<noscript><dl class="facts">{facts}</dl></noscript>'
    looks = "".join(_look(data, number, f"{place}-look-{number}") for number in range(len(data["looks"])))
    caption = "Windows, numbered in the order of the looks, and objects that were found"
    confirmed = " Green objects were confirmed by the decision or a closer look." if data["confirmable"] else ""
    return (
        f'<article class="large" id="{place}" aria-labelledby="{place}-name"><h3 id="{place}-name">{name}</h3>{head}'
        f'<p class="hint keys">The keys ← and → step through the looks. Home and End go to the first and the last one. '
        f"Click on the number or the border of a window to choose its look.{confirmed}</p>"
        f'<div class="panes"><figure class="overview"><figcaption>{caption}</figcaption>{_picture(data)}</figure>'
        f'{looks}</div><p class="hint">{data["values"]}A look brought the objects that it shows most sharply.</p>'
        f"<h3>Objects</h3>{_objects(data, count)}</article>"
    )


def _picture(data: Data) -> str:
    """The picture with numbered windows and objects."""
    width, height = data["size"]
    unit = max(width, height) / 640
    truth = "".join(_rect(box, "truth") for box in data["truth"])
    windows = [(number, look) for number, look in enumerate(data["looks"]) if not look["whole"]]
    sizes = [(unit * (8 * len(str(number)) + 8), unit * 17) for number, _ in windows]
    tags = place_labels([tuple(look["box"]) for _, look in windows], sizes, (width, height))
    shapes = []
    for each in data["objects"]:
        sure = ", confirmed" if each["confirmed"] else ""
        kind = "object confirmed" if sure else "object"
        title = f"<title>{escape(each['label'])} {each['score']:.2f}{sure}, look {each['look']}</title>"
        shapes.append(f'<g class="{kind}" data-look="{each["look"]}">{title}{_framed(each["box"])}</g>')
    for (number, look), tag in zip(windows, tags, strict=True):
        x, y = (tag[0] + tag[2]) / 2, (tag[1] + tag[3]) / 2
        text = f'<text x="{x:.1f}" y="{y:.1f}" font-size="{13 * unit:.1f}">{number}</text>'
        shapes.append(f'<g class="window" data-look="{number}">{_framed(look["box"])}{_rect(tag, "tag")}{text}</g>')
    several = "s" if data["count"] != 1 else ""
    label = f"The picture with {len(windows)} numbered windows and {data['count']} object{several}"
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(label)}">'
        f'{_image(data["image"], (width, height))}{truth}{"".join(shapes)}<g class="chosen"></g></svg>'
    )


def _look(data: Data, number: int, place: str) -> str:
    """A look: its pixels with its detections, its window and value, and a table of the detections."""
    look = data["looks"][number]
    x1, y1, x2, y2 = look["box"]
    size, unit = tuple(look["size"]), look["size"][0] / 640
    shapes, tags = [], []
    rows = [["#", "class", "score", "box"]]
    for order, each in enumerate(look["detections"], 1):
        kind = "detection target" if each["label"] == data["target"] else "detection"
        shapes.append(f'<g class="{kind}">{_framed(each["box"])}</g>')
        left, top, right, bottom = each["tag"]
        text = (
            f'<text x="{left + 4 * unit:.1f}" y="{(top + bottom) / 2:.1f}" font-size="{19 * unit:.1f}" '
            f'textLength="{max(right - left - 8 * unit, 0):.1f}" lengthAdjust="spacingAndGlyphs">'
            f"{order}</text>"
        )
        tags.append(f'<g class="{kind}">{_rect(each["tag"], "tag")}{text}</g>')
        rows.append([str(order), each["label"], f"{each['score']:.2f}", _corners(each["place"])])
    value = "none: the first look" if look["value"] is None else f"{look['value']:.2g}"
    facts = {
        "Window": f"x {x1} to {x2}, y {y1} to {y2} ({x2 - x1} × {y2 - y1} px)",
        "Magnification": f"{look['magnification']:.2g}",
        "Value when it was chosen": value,
        "Objects that it brought": look["brought"],
    }
    if look["value"] is None and number:
        del facts["Value when it was chosen"]
    if look["seconds"] is not None:
        facts["End"] = f"after {look['seconds']:.2f} s"
    if look["closer"] is not None:
        facts["Closer look"] = look["closer"]
    facts_html = "".join(f"<div><dt>{key}</dt><dd>{escape(fact)}</dd></div>" for key, fact in facts.items())
    table = "<p>No detections.</p>"
    if len(rows) > 1:
        table = table_html(rows, f"Detections of look {number}, with boxes (x1, y1, x2, y2) in picture pixels")
    left = look["count"] - len(look["detections"])
    label = f"The window of look {number} with {look['count']} detection{'s' if look['count'] != 1 else ''}"
    return (
        f'<section class="look" data-look="{number}" id="{place}" aria-labelledby="{place}-title">'
        f'<h4 id="{place}-title">Look {number}{": the whole picture" if look["whole"] else ""}</h4>'
        f'<svg viewBox="0 0 {size[0]} {size[1]}" role="img" aria-label="{label}">'
        f"{_image(look['view'], size)}{''.join(shapes)}{''.join(tags)}</svg>"
        f'<dl class="facts">{facts_html}</dl>{table}{_left_out(left, "detection")}</section>'
    )


def _objects(data: Data, count: int) -> str:
    """The table of the objects, most confident first."""
    if not count:
        return "<p>No objects were found.</p>"
    rows = [["#", "class", "score", "box", "look", *(["confirmed"] if data["confirmable"] else [])]]
    for order, each in enumerate(data["objects"][:LISTED], 1):
        sure = ["yes" if each["confirmed"] else "no"] if data["confirmable"] else []
        place = _corners(each["box"])
        rows.append([str(order), each["label"], f"{each['score']:.2f}", place, str(each["look"]), *sure])
    caption = "Objects, most confident first, with boxes (x1, y1, x2, y2) in picture pixels and the sharpest look"
    return table_html(rows, caption) + _left_out(count - len(rows) + 1, "object")


def _left_out(count: int, what: str) -> str:
    if not count:
        return ""
    return f"<p>{count} less confident {what}{'s are' if count != 1 else ' is'} left out.</p>"


def _corners(box: Sequence[float]) -> str:
    return ", ".join(f"{n:.0f}" for n in box)


def _image(uri: str, size: tuple[int, int]) -> str:
    return f'<image href="{uri}" width="{size[0]}" height="{size[1]}" preserveAspectRatio="none"/>'


def _framed(box: Sequence[float]) -> str:
    """A box drawn twice: a light line under a coloured one."""
    return _rect(box, "under") + _rect(box, "over")


def _rect(box: Sequence[float], kind: str) -> str:
    x1, y1, x2, y2 = box
    return f'<rect class="{kind}" x="{x1:g}" y="{y1:g}" width="{max(x2 - x1, 0):g}" height="{max(y2 - y1, 0):g}"/>'


def table_html(rows: Sequence[Sequence[str]], caption: str) -> str:
    """A table whose first row is its head and whose first column names the rows."""
    kinds = ["", *[' class="number"'] * (len(rows[0]) - 1)]
    head = "".join(f'<th scope="col"{kind}>{escape(cell)}</th>' for kind, cell in zip(kinds, rows[0], strict=True))
    body = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>'
        + "".join(f'<td class="number">{escape(cell)}</td>' for cell in row[1:])
        + "</tr>"
        for row in rows[1:]
    )
    label = escape(caption)
    return (
        f'<p>{label}</p><div class="wide" tabindex="0" role="region" aria-label="{label}">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )
