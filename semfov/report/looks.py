"""HTML of looks that is complete without the script: the picture with its objects, and a section for each look."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import NamedTuple

from semfov.data.classes import amount
from semfov.detection.objects import box_text
from semfov.paths.look import CONFIDENT
from semfov.report.episode import Data
from semfov.report.markup import facts_html, framed, left_out, picture, rect, table_html
from semfov.viz.labels import LabelBox, place_labels, place_within

_NAMED = 12  # largest number of objects whose names are shown at first; more would cover the picture

_STEPS = (
    "The keys ← and → step through the looks. Home and End go to the first and the last one. "
    "Click on the number or the border of a {view} to choose its look, or on a row of the list."
)


def article_html(data: Data, place: str, objects: str, facts: Mapping[str, str], *, is_named: bool) -> str:
    """Make the article of a record: the picture with its objects and windows, the list of the objects, and all looks.

    It embeds its pictures, also those that another article of the page has.

    Args:
        data: data of the record (`semfov.report.zoom.zoom_data`).
        place: id of the article.
        objects: HTML of the list of the objects.
        facts: facts that are shown without the script, by their names; empty for none.
        is_named: whether the name of the picture is shown.

    Returns:
        HTML.
    """
    name = escape(data["name"])
    noscript = f'<noscript><dl class="facts">{facts_html(facts)}</dl></noscript>' if facts else ""
    looks = "".join(_look(data, index, f"{place}-look-{index + 1}") for index in range(len(data["looks"])))
    view = _view_word(data)
    names_shown = " checked" if data["count"] <= _NAMED else ""
    switches = (
        f'<span class="switches"><label><input type="checkbox" class="windows-shown" checked> {view.title()}s</label> '
        f'<label><input type="checkbox" class="names-shown"{names_shown}> Names</label></span>'
    )
    legend = "".join(f'<li><i class="of-{kind}"></i> {text}</li>' for kind, text in _legend(data))
    unseen = "" if is_named else ' class="unseen"'
    steps = f'<p class="hint keys">{_STEPS.format(view=view)}</p>' if len(data["looks"]) > 1 else ""
    return (
        f'<article class="large" id="{place}" aria-labelledby="{place}-name"><h3 id="{place}-name"{unseen}>{name}</h3>'
        f'{noscript}<div class="panes"><figure class="overview"><figcaption><ul class="key">{legend}</ul>{switches}'
        f'</figcaption>{_overview(data, place)}</figure><section class="found-objects" '
        f'aria-labelledby="{place}-objects"><h4 id="{place}-objects">Objects</h4>{objects}</section></div>'
        f'{steps}<div class="looks">{looks}</div>'
        f'<p class="hint">{data["values"]}</p></article>'
    )


def _view_word(data: Data) -> str:
    """Say what a look shows: a view of a head, or a window."""
    return "view" if data["turns"] else "window"


def _legend(data: Data) -> list[tuple[str, str]]:
    """Explain the boxes of the overview that there are: CSS class and text of each kind."""
    confirmed = [found["confirmed"] for found in data["objects"]]
    entries = []
    if not all(confirmed):
        entries.append(("objects", "object that was found"))
    if any(confirmed):
        entries.append(("sure", "confirmed by the decision or a closer look"))
    if data["best"]:
        entries.append(("best", "best place, not sure enough"))
    if not all(look["whole"] for look in data["looks"]):
        entries.append(("windows", f"{_view_word(data)} of a look, numbered in their order"))
        entries.append(("now", "the chosen look"))
    if data["truth"]:
        entries.append(("truth", "true box"))
    return entries


def _overview(data: Data, place: str) -> str:
    """Draw the picture with named objects and numbered windows.

    Args:
        data: data of the record.
        place: id of the article.

    Returns:
        SVG.
    """
    width, height = data["size"]
    unit = max(width, height) / 640  # the drawing is about 640 pixels of the screen wide
    windows = _numbered_windows(data, unit)
    # What comes later lies over what was drawn before.
    shapes = [rect(box, "truth") for box in data["truth"]]
    shapes += _object_shapes(data, unit, [window.tag for window in windows])
    if data["best"]:
        shapes.append(f'<g class="best"><title>best place</title>{framed(data["best"])}</g>')
    shapes += [_window_shape(window, unit) for window in windows]
    objects = amount(data["count"], "object")
    label = f"The picture with {len(windows)} numbered {_view_word(data)}s and {objects}"
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(label)}">'
        f"{picture(data['image'], (width, height), f'{place}-picture')}{''.join(shapes)}"
        f'<g class="chosen"></g></svg>'
    )


class _NumberedWindow(NamedTuple):
    """What a look shows of the picture: its number, from 1, its box, and the rectangle in which the number stands."""

    number: int
    box: LabelBox
    tag: LabelBox


def _numbered_windows(data: Data, unit: float) -> list[_NumberedWindow]:
    """List the windows of the looks that show a part of the picture; no number covers another.

    Args:
        data: data of the record.
        unit: length in pixels of the picture of about a pixel of the screen.
    """
    numbers: list[int] = []
    boxes: list[LabelBox] = []
    sizes: list[tuple[float, float]] = []
    for number, look in enumerate(data["looks"], 1):
        if look["whole"]:
            continue
        x1, y1, x2, y2 = look["box"]
        numbers.append(number)
        boxes.append((x1, y1, x2, y2))
        # Room for digits of 13 pixels of the screen.
        sizes.append((unit * (8 * len(str(number)) + 8), unit * 17))
    width, height = data["size"]
    tags = place_labels(boxes, sizes, (width, height))
    return [_NumberedWindow(*window) for window in zip(numbers, boxes, tags, strict=True)]


def _window_shape(window: _NumberedWindow, unit: float) -> str:
    """Draw the window of a look, with the look's number in the middle of its rectangle."""
    left, top, right, bottom = window.tag
    x = (left + right) / 2
    y = (top + bottom) / 2
    text = f'<text x="{x:.1f}" y="{y:.1f}" font-size="{13 * unit:.1f}">{window.number}</text>'
    shapes = f"{framed(window.box)}{rect(window.tag, 'tag')}{text}"
    return f'<g class="window" data-look="{window.number - 1}">{shapes}</g>'


def _object_shapes(data: Data, unit: float, obstacles: Sequence[LabelBox]) -> list[str]:
    """Draw the objects, each with its name at a corner where it covers neither another one nor a number.

    Args:
        data: data of the record.
        unit: length in pixels of the picture of about a pixel of the screen.
        obstacles: rectangles of the numbers of the windows.

    Returns:
        SVG of each object.
    """
    width, height = data["size"]
    objects = data["objects"]
    sizes: list[tuple[float, float]] = []
    candidates: list[list[tuple[float, float]]] = []
    for found in objects:
        # Room for letters of 11 pixels of the screen.
        size = (unit * (6.3 * len(_object_name(found)) + 4), unit * 13)
        sizes.append(size)
        candidates.append(_corner_places(found["box"], size))
    labels = place_within(candidates, sizes, (width, height), obstacles)
    shapes = []
    for order, (found, label) in enumerate(zip(objects, labels, strict=True), 1):
        shapes.append(_object_shape(found, label, order, unit))
    return shapes


def _object_name(found: Data) -> str:
    return f"{found['label']} {found['score']:.2f}"


def _object_shape(found: Data, label: LabelBox, order: int, unit: float) -> str:
    """Draw the box of an object, with its name in the rectangle of its label.

    Args:
        found: data of the object.
        label: the rectangle.
        order: number of the object, from 1.
        unit: length in pixels of the picture of about a pixel of the screen.

    Returns:
        SVG.
    """
    left, top, _, bottom = label
    x = left + 2 * unit
    y = (top + bottom) / 2
    name = escape(_object_name(found))
    text = f'<text class="name" x="{x:.1f}" y="{y:.1f}" font-size="{11 * unit:.1f}">{name}</text>'
    css_class = "object"
    title = name
    if found["confirmed"]:
        css_class += " confirmed"
        title += ", confirmed"
    content = f"<title>{title}, look {found['look']}</title>{framed(found['box'])}{text}"
    return f'<g class="{css_class}" data-look="{found["look"] - 1}" data-object="{order}">{content}</g>'


def _corner_places(box: Sequence[float], size: tuple[float, float]) -> list[tuple[float, float]]:
    """List the places of a name at the borders of a box and beside it.

    Args:
        box: `(x1, y1, x2, y2)`.
        size: `(width, height)` of the name.

    Returns:
        Left upper corners of the name.
    """
    x1, y1, x2, y2 = box
    width, height = size
    # Middles of the name: inside and outside at the left and at the right, on the upper and on the lower border.
    columns = (x1 + width / 2, x2 - width / 2, x1 - width / 2, x2 + width / 2)
    rows = (y1 - height / 2, y2 + height / 2)
    return [(x - width / 2, y - height / 2) for x in columns for y in rows]


def _look(data: Data, index: int, place: str) -> str:
    """Make the section of a look: its pixels with its detections, facts, and a table of the detections."""
    look = data["looks"][index]
    number = index + 1
    width, height = look["size"]
    count = look["count"]
    title = f"Look {number}: the whole picture" if look["whole"] else f"Look {number}"
    label = f"The window of look {number} with {amount(count, 'detection')}"
    pixels = picture(look["view"], (width, height), f"{place}-view")
    shapes = _detection_shapes(look, data["target"])
    view = f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{label}">{pixels}{shapes}</svg>'
    facts = f'<dl class="facts">{facts_html(_look_facts(look, number))}</dl>'
    rest = left_out(count - len(look["detections"]), "detection")
    return (
        f'<section class="look" data-look="{index}" id="{place}" aria-labelledby="{place}-title">'
        f'<h4 id="{place}-title">{title}</h4>{view}{facts}{_detection_table(look, number)}{rest}</section>'
    )


def _detection_shapes(look: Data, target: str | None) -> str:
    """Draw the detections of a look, and over all boxes their numbers.

    Args:
        look: data of the look.
        target: name of the class that was searched for; None for none.

    Returns:
        SVG.
    """
    unit = look["size"][0] / 640  # the view is drawn about 640 pixels of the screen wide
    boxes = []
    tags = []
    for order, detection in enumerate(look["detections"], 1):
        kind = "detection target" if detection["label"] == target else "detection"
        boxes.append(f'<g class="{kind}">{framed(detection["box"])}</g>')
        left, top, right, bottom = detection["tag"]
        x = left + 4 * unit
        y = (top + bottom) / 2
        # Fonts of browsers differ: the text is stretched or squeezed into its rectangle.
        length = max(right - left - 8 * unit, 0)
        text = (
            f'<text x="{x:.1f}" y="{y:.1f}" font-size="{19 * unit:.1f}" '
            f'textLength="{length:.1f}" lengthAdjust="spacingAndGlyphs">{order}</text>'
        )
        tags.append(f'<g class="{kind}">{rect(detection["tag"], "tag")}{text}</g>')
    return "".join(boxes + tags)  # what comes later lies over what was drawn before


def _look_facts(look: Data, number: int) -> dict[str, str]:
    """Collect the facts about a look by their names."""
    facts: dict[str, str] = {}
    if look["turned"] is None:
        x1, y1, x2, y2 = look["box"]
        facts["Window"] = f"x {x1} to {x2}, y {y1} to {y2} ({x2 - x1} × {y2 - y1} px)"
        facts["Magnification"] = f"{look['magnification']:.2g}"
    else:
        facts["Head"] = look["turned"]
    if look["value"] is not None:
        facts["Value when it was chosen"] = f"{look['value']:.2g}"
    elif number == 1:
        facts["Value when it was chosen"] = "none: the first look"
    if look["brought"]:
        facts["Best seen in this look"] = look["brought"]
    if look["seconds"] is not None:
        warm_up = ", with the warm-up of the detector" if look["warm"] else ""
        facts["End"] = f"after {look['seconds']:.2f} s{warm_up}"
    if look["closer"] is not None:
        # A first look is at the whole picture, and may be close enough.
        kind = "Closer look" if number > 1 else "Close enough to tell"
        facts[kind] = look["closer"]
    return facts


def _detection_table(look: Data, number: int) -> str:
    """Make the table of the detections of a look."""
    threshold = f"from score {CONFIDENT:g} on"
    if not look["detections"]:
        return f"<p>No detections {threshold}.</p>"
    rows = [["#", "class", "score", "box"]]
    for order, detection in enumerate(look["detections"], 1):
        rows.append([str(order), detection["label"], f"{detection['score']:.2f}", box_text(detection["place"])])
    return table_html(rows, f"Detections of look {number} {threshold}, with boxes x1,y1–x2,y2 in picture pixels")
