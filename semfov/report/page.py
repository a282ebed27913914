"""A page as a single file with markup, style, script and data, which loads nothing from elsewhere.

The looks at a large picture are complete without the script.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from semfov.detection.objects import box_text
from semfov.errors import check
from semfov.io.files import write_text
from semfov.paths.look import CONFIDENT
from semfov.report.episode import Data
from semfov.viz.labels import place_labels, place_within
from semfov.viz.style import PROBABILITY, TIME, UNCERTAINTY, overlay_colours

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

_FOLDER = Path(__file__).parent

_OPACITY = 0.82  # opacity over the photograph of colours that do not stand for probabilities


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
    """Return the path of a page if its suffix is that of a page; otherwise raise `InputError`."""
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
    stepped = [episode for episode in episodes if "looks" not in episode]
    drawn = [picture for each in stepped for picture in (each["image"], *(look["view"] for look in each["fixations"]))]
    different = dict.fromkeys(picture for picture in drawn if picture is not None)
    numbers = {picture: number for number, picture in enumerate(different)}
    read_by_script: list[Data] = []
    for number, episode in enumerate(episodes):
        if "looks" not in episode:
            fixations = [{**each, "view": numbers.get(each["view"])} for each in episode["fixations"]]
            own = {key: value for key, value in episode.items() if key != "objects"}
            own |= {"image": numbers.get(episode["image"]), "fixations": fixations, "article": f"objects-{number}"}
            read_by_script.append(own)
        else:
            looks = [{"box": look["box"], "status": look["status"]} for look in episode["looks"]]
            own = {key: episode[key] for key in (*_ABOUT, "summary")}
            read_by_script.append({**own, "article": f"large-{number}", "looks": looks})
    data = {
        "episodes": read_by_script,
        "pictures": list(numbers),
        "colours": {
            "time": colour_steps(TIME),
            "overlay": colour_steps(overlay_colours()),
            "probability": colour_steps(PROBABILITY, _OPACITY),
            "uncertainty": colour_steps(UNCERTAINTY, _OPACITY),
        },
    }
    rows = []
    for key, label in _ABOUT.items():
        if any(key in episode for episode in episodes):
            hidden = "" if episodes[0].get(key) else " hidden"
            fact = escape(episodes[0].get(key) or "")
            rows.append(f'<div{hidden}><dt>{label}</dt><dd data-about="{key}">{fact}</dd></div>')
    # Facts about the first episode, which the script updates for other episodes.
    about = f'<dl id="about" class="facts">{"".join(rows)}</dl>' if episodes else ""
    several = bool(sections) or len(episodes) > 1
    contents = {
        "title": escape(title),
        "sections": sections,
        # The facts about one of several episodes stand where it is chosen.
        "about": "" if several else about,
        "of_episode": about if several else "",
        "looks": "".join(
            _looks_html(episode, f"large-{number}", headed=number == 0)
            for number, episode in enumerate(episodes)
            if "looks" in episode
        ),
        "objects": "".join(
            f'<section class="found-objects of-episode" id="objects-{number}" aria-labelledby="objects-{number}-title">'
            f'<h3 id="objects-{number}-title">Objects in {escape(episode["name"])}</h3>'
            f"{_objects(episode, 'episode')}</section>"
            for number, episode in enumerate(episodes)
            if "looks" not in episode
        ),
        "least": f"{CONFIDENT:g}",
        "fixations": " hidden" if episodes and all("looks" in episode for episode in episodes) else "",
    }
    return filled("page", data, contents)


def filled(name: str, data: Data, contents: dict[str, str]) -> str:
    """The page of a template: head, controls, foot and script of all pages, its own, data, and contents by place."""

    def text(*files: str) -> str:
        return "".join((_FOLDER / file).read_text(encoding="utf-8") for file in files)

    parts = {"style": text("page.css"), "steps": text("steps.html"), "program": text("steps.js", f"{name}.js")}
    script = json.dumps(data, separators=(",", ":"), allow_nan=False)
    # The data are inside an element, which no text in them may close.
    parts["data"] = script.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    parts |= contents
    # All parts are inserted in one pass, so that braces inside a part are not taken for a placeholder.
    template = text("head.html", f"{name}.html", "foot.html")
    return re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], template)


_STEPS = 33  # of a colour map


def colour_steps(colours: str | Colormap, opacity: float = 1.0) -> list[list[float]]:
    """Red, green and blue from 0 to 255 and opacity from 0 to 1 of a colour map of matplotlib, at equal steps."""
    from matplotlib import colormaps

    colours = colormaps[colours] if isinstance(colours, str) else colours
    shades = [colours(step / (_STEPS - 1)) for step in range(_STEPS)]
    return [
        [*(round(255 * float(value)) for value in shade[:3]), round(float(shade[3]) * opacity, 3)] for shade in shades
    ]


_ABOUT = {
    "name": "Photograph",
    "pixels": "Size",
    "detector": "Detector",
    "sensor": "Sensor",
    "passes": "Passes of the detector",
    "decision": "Outcome",
}
"""Entries at the head of an episode, by their keys in its data."""


_NAMED = 25  # largest number of objects whose names are shown at first; more would cover the picture


def _looks_html(data: Data, place: str, *, headed: bool = True) -> str:
    """The picture with its objects and windows, the list of the objects, and all looks."""
    name = escape(data["name"])
    facts = "".join(
        f"<div><dt>{_ABOUT[key]}</dt><dd>{escape(data[key])}</dd></div>" for key in _ABOUT if data[key] is not None
    )
    head = "" if headed else f'<noscript><dl class="facts">{facts}</dl></noscript>'
    looks = "".join(_look(data, number, f"{place}-look-{number}") for number in range(len(data["looks"])))
    what = "view" if data["turns"] else "window"
    names = " checked" if data["count"] <= _NAMED else ""
    switches = (
        f'<span class="switches"><label><input type="checkbox" class="windows-shown" checked> {what.title()}s</label> '
        f'<label><input type="checkbox" class="names-shown"{names}> Names</label></span>'
    )
    sure = [each["confirmed"] for each in data["objects"]]
    entries = [("objects", "object that was found")] if not all(sure) else []
    entries += [("sure", "confirmed by the decision or a closer look")] if any(sure) else []
    entries += [("best", "best place, not sure enough")] if data["best"] else []
    if not all(look["whole"] for look in data["looks"]):
        entries += [("windows", f"{what} of a look, numbered in their order"), ("now", "the chosen look")]
    entries += [("truth", "true box")] if data["truth"] else []
    legend = "".join(f'<li><i class="of-{kind}"></i> {text}</li>' for kind, text in entries)
    return (
        f'<article class="large" id="{place}" aria-labelledby="{place}-name"><h3 id="{place}-name">{name}</h3>{head}'
        f'<div class="panes"><figure class="overview"><figcaption><ul class="key">{legend}</ul>{switches}</figcaption>'
        f'{_picture(data, place)}</figure><section class="found-objects" aria-labelledby="{place}-objects">'
        f'<h4 id="{place}-objects">Objects</h4>{_objects(data, place)}</section></div>'
        f'<p class="hint keys">The keys ← and → step through the looks. Home and End go to the first and the last one. '
        f"Click on the number or the border of a {what} to choose its look, or on a row of the list.</p>"
        f'<div class="looks">{looks}</div>'
        f'<p class="hint">{data["values"]}</p></article>'
    )


def _picture(data: Data, place: str) -> str:
    """The picture with named objects and numbered windows."""
    width, height = data["size"]
    unit = max(width, height) / 640
    truth = "".join(_rect(box, "truth") for box in data["truth"])
    windows = [(number, look) for number, look in enumerate(data["looks"]) if not look["whole"]]
    sizes = [(unit * (8 * len(str(number)) + 8), unit * 17) for number, _ in windows]
    tags = place_labels([tuple(look["box"]) for _, look in windows], sizes, (width, height))
    words = [f"{each['label']} {each['score']:.2f}" for each in data["objects"]]
    spans = [(unit * (6.3 * len(text) + 4), unit * 13) for text in words]
    boxes = [tuple(each["box"]) for each in data["objects"]]
    around = [
        [
            (x - w / 2, y - h / 2)
            for x in (x1 + w / 2, x2 - w / 2, x1 - w / 2, x2 + w / 2)
            for y in (y1 - h / 2, y2 + h / 2)
        ]
        for (x1, y1, x2, y2), (w, h) in zip(boxes, spans, strict=True)
    ]
    places = place_within(around, spans, (width, height), tags)
    shapes = []
    for order, (each, text, where) in enumerate(zip(data["objects"], words, places, strict=True), 1):
        sure = ", confirmed" if each["confirmed"] else ""
        kind = "object confirmed" if sure else "object"
        x, y = where[0] + 2 * unit, (where[1] + where[3]) / 2
        name = f'<text class="name" x="{x:.1f}" y="{y:.1f}" font-size="{11 * unit:.1f}">{escape(text)}</text>'
        title = f"<title>{escape(text)}{sure}, look {each['look']}</title>"
        inside = f"{title}{_framed(each['box'])}{name}"
        shapes.append(f'<g class="{kind}" data-look="{each["look"]}" data-object="{order}">{inside}</g>')
    if data["best"]:
        shapes.append(f'<g class="best"><title>best place</title>{_framed(data["best"])}</g>')
    for (number, look), tag in zip(windows, tags, strict=True):
        x, y = (tag[0] + tag[2]) / 2, (tag[1] + tag[3]) / 2
        text = f'<text x="{x:.1f}" y="{y:.1f}" font-size="{13 * unit:.1f}">{number}</text>'
        shapes.append(f'<g class="window" data-look="{number}">{_framed(look["box"])}{_rect(tag, "tag")}{text}</g>')
    several = "s" if data["count"] != 1 else ""
    what = "views" if data["turns"] else "windows"
    label = f"The picture with {len(windows)} numbered {what} and {data['count']} object{several}"
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(label)}">'
        f"{_image(data['image'], (width, height), f'{place}-picture')}{truth}{''.join(shapes)}"
        f'<g class="chosen"></g></svg>'
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
        rows.append([str(order), each["label"], f"{each['score']:.2f}", box_text(each["place"])])
    value = "none: the first look" if look["value"] is None else f"{look['value']:.2g}"
    where = {
        "Window": f"x {x1} to {x2}, y {y1} to {y2} ({x2 - x1} × {y2 - y1} px)",
        "Magnification": f"{look['magnification']:.2g}",
    }
    facts = {
        **(where if look["turned"] is None else {"Head": look["turned"]}),
        "Value when it was chosen": value,
        "Objects that no look shows more sharply": look["brought"],
    }
    if look["value"] is None and number:
        del facts["Value when it was chosen"]
    if look["seconds"] is not None:
        facts["End"] = f"after {look['seconds']:.2f} s{', with the warm-up of the detector' if look['warm'] else ''}"
    if look["closer"] is not None:
        facts["Closer look"] = look["closer"]
    facts_html = "".join(f"<div><dt>{key}</dt><dd>{escape(fact)}</dd></div>" for key, fact in facts.items())
    least = f"from score {CONFIDENT:g} on"
    table = f"<p>No detections {least}.</p>"
    if len(rows) > 1:
        table = table_html(rows, f"Detections of look {number} {least}, with boxes x1,y1–x2,y2 in picture pixels")
    left = look["count"] - len(look["detections"])
    label = f"The window of look {number} with {look['count']} detection{'s' if look['count'] != 1 else ''}"
    return (
        f'<section class="look" data-look="{number}" id="{place}" aria-labelledby="{place}-title">'
        f'<h4 id="{place}-title">Look {number}{": the whole picture" if look["whole"] else ""}</h4>'
        f'<svg viewBox="0 0 {size[0]} {size[1]}" role="img" aria-label="{label}">'
        f"{_image(look['view'], size, f'{place}-view')}{''.join(shapes)}{''.join(tags)}</svg>"
        f'<dl class="facts">{facts_html}</dl>{table}{_left_out(left, "detection")}</section>'
    )


def _objects(data: Data, place: str) -> str:
    """The list of the objects with what their boxes show, most confident first."""
    count = data["count"]
    if not count:
        return "<p>No objects were found.</p>"
    look, nearest = ("look", "sharpest look") if "looks" in data else ("fixation", "nearest fixation")
    heads = ["#", "", "class", "score", *(["pan, tilt"] if data["turns"] else []), look]
    heads += [*(["confirmed"] if data["confirmable"] else []), "box"]
    rows = []
    for order, each in enumerate(data["objects"], 1):
        cells = [escape(each["label"]), f"{each['score']:.2f}"]
        cells += [f"{each['pan']:z.0f}°, {each['tilt']:z.0f}°"] if data["turns"] else []
        cells += [str(each["look"]), *(["yes" if each["confirmed"] else "no"] if data["confirmable"] else [])]
        cells.append(box_text(each["box"]))
        rows.append(
            f'<tr data-object="{order}" data-look="{each["look"]}"><th scope="row">'
            f'<button type="button" class="pick">{order}</button></th><td>{_crop(data, each, place)}</td>'
            + "".join(f'<td class="number">{cell}</td>' for cell in cells)
            + "</tr>"
        )
    titles = "".join(
        f'<th scope="col"><button type="button" class="sort">{head}</button></th>' if head else "<td></td>"
        for head in heads
    )
    label = f"Objects with boxes x1,y1–x2,y2 in picture pixels and the {nearest}"
    table = f"<thead><tr>{titles}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return (
        f'<div class="wide" tabindex="0" role="region" aria-label="{label}"><table class="objects" '
        f'aria-label="{label}">{table}</table></div>{_left_out(count - len(rows), "object")}'
    )


def _crop(data: Data, each: Data, place: str) -> str:
    """What the box of an object shows, of the look that shows it most sharply; a part of a picture that is there."""
    x1, y1, x2, y2 = each["box"]
    source, left, top = f"{place}-picture", 0, 0
    if "looks" in data and not data["turns"]:  # other views are no parts of the picture
        source, (left, top) = f"{place}-look-{each['look']}-view", data["looks"][each["look"]]["box"][:2]
    margin = 0.1 * max(x2 - x1, y2 - y1, 1)
    across, down = x2 - x1 + 2 * margin, y2 - y1 + 2 * margin
    view = f"{x1 - left - margin:.1f} {y1 - top - margin:.1f} {across:.1f} {down:.1f}"
    width = f"width: {min(4.0, 3 * across / down):.2f}rem"
    return f'<svg class="crop" viewBox="{view}" style="{width}" aria-hidden="true"><use href="#{source}"/></svg>'


def _left_out(count: int, what: str) -> str:
    if not count:
        return ""
    return f"<p>{count} less confident {what}{'s are' if count != 1 else ' is'} left out.</p>"


def _image(uri: str, size: tuple[int, int], name: str) -> str:
    return f'<image id="{name}" href="{uri}" width="{size[0]}" height="{size[1]}" preserveAspectRatio="none"/>'


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
