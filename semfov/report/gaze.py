"""A page of where people look in pictures, with a slider over the fixations of drawn viewers."""

import base64
import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.classes import counted
from semfov.data.fixations import Fixations
from semfov.paths.areas import Area, AreasLike, border_of, percent, shares_around
from semfov.paths.gaze import GazePrediction
from semfov.paths.viewers import AreaVisits
from semfov.report.episode import Data, jpeg_uri
from semfov.report.markup import scrollable
from semfov.report.overview import OverviewColumn, OverviewRow, overview_section, small_picture
from semfov.report.template import colour_steps, filled
from semfov.viz.gaze import BORDERS
from semfov.viz.style import COLOURS, share_colours

_WIDTH = 960  # of the picture in pixels
_QUALITY = 80  # of the picture as JPEG
_MOST_STEPS = 12  # largest number of fixations of the slider
_RADII = (0.09, 0.06, 0.04)  # of the first fixations over a small picture, in shares of its longer side


class ViewedArea(NamedTuple):
    """Area of interest in a picture.

    Attributes:
        box: left, top, right and bottom edge, in pixels.
        share: of all fixations, from 0 to 1.
        visits: how many viewers see it, and when.
    """

    box: Area
    share: float
    visits: AreaVisits


def viewed_areas(prediction: GazePrediction, areas: AreasLike | None, seconds: float) -> dict[str, ViewedArea]:
    """Compute what is known of areas of interest.

    Args:
        prediction: the prediction for the picture.
        areas: as for `GazePrediction.share`; None for none.
        seconds: time for which each viewer views the picture.

    Returns:
        The areas by name.
    """
    if areas is None:
        return {}
    shares = prediction.share(areas)
    visits = prediction.visits(areas, seconds=seconds)
    boxes = prediction.areas(areas)
    return {name: ViewedArea(box, shares[name], visits[name]) for name, box in boxes.items()}


def gaze_part(
    prediction: GazePrediction,
    scanpaths: Sequence[Fixations],
    areas: AreasLike | None = None,
    seconds: float = 3.0,
) -> Data:
    """Collect what the page has of a prediction, as JSON values.

    Args:
        prediction: the prediction.
        scanpaths: drawn scanpaths of viewers.
        areas: areas of interest, as for `GazePrediction.share`.
        seconds: time for which each viewer views the picture, for `GazePrediction.visits`.

    Returns:
        `picture`, for the script: its result in words, shares of the fixations as bytes, borders and scanpaths;
        `facts`, HTML; `shares` of the areas in words, by name; and `caution`, None for none.
    """
    # The slider begins before the first fixation, with the map of all, and has a step for each fixation that is seen.
    longest = max(map(len, scanpaths))
    steps = min(longest, _MOST_STEPS)
    densities = [prediction.cells]
    densities += [prediction.given(scanpaths, number) for number in range(1, steps + 1)]
    viewed = viewed_areas(prediction, areas, seconds)
    picture = {
        "name": prediction.name,
        "lead": _lead(prediction, viewed),
        "size": list(prediction.size),
        "image": jpeg_uri(prediction.image, _WIDTH, _QUALITY),
        "cells": list(prediction.cells.shape),
        "maps": [_bytes_of_map(density) for density in densities],
        "borders": [_borders(density, prediction.size) for density in densities],
        "paths": [_rounded_points(scanpath) for scanpath in scanpaths],
        "first": [[place["x"], place["y"]] for place in prediction.first_fixations()],
        "areas": [[f"{name} {percent(area.share)}", *area.box] for name, area in viewed.items()],
    }
    return {
        "picture": picture,
        "facts": _facts(prediction, viewed),
        "shares": {name: percent(area.share) for name, area in viewed.items()},
        "caution": prediction.caution,
    }


def _rounded_points(scanpath: Fixations) -> list[list[float]]:
    """List the points of a scanpath to a tenth of a pixel, which is finer than the page shows."""
    return [[round(x, 1), round(y, 1)] for x, y in scanpath.points.tolist()]


def _bytes_of_map(density: Tensor) -> str:
    """Encode the share of the fixations in the smallest area that reaches each cell as bytes, in base 64."""
    # Rounding may bring a sum above 1, and a byte above 255 begins at 0 again.
    shares = (shares_around(density).clamp(max=1) * 255).round().byte()  # (rows, columns)
    return base64.b64encode(shares.numpy().tobytes()).decode()


def gaze_page_html(title: str, parts: Sequence[Data], before: str = "") -> str:
    """Make the page of one or several pictures.

    Args:
        title: plain text.
        parts: the pictures, from `gaze_part`.
        before: HTML above them. Without it, several pictures have an overview (`semfov.report.overview`).

    Returns:
        The HTML of the page.
    """
    data = {
        "pictures": [part["picture"] for part in parts],
        "heat": colour_steps(share_colours()),
        "colours": list(COLOURS),
    }
    facts = ""
    for number, part in enumerate(parts):
        heading = f"<h2>{escape(part['picture']['name'])}</h2>"
        facts += f'<section class="facts-of" id="facts-{number}">{heading}{part["facts"]}</section>'
    if not before and len(parts) != 1:
        before = _overview(parts)
    contents = {
        "title": escape(title),
        "before": before,
        "borders": escape(BORDERS.capitalize()),
        "facts": facts,
    }
    return filled("gaze", data, contents)


def _overview(parts: Sequence[Data]) -> str:
    """List the pictures with their first fixations, and the share of all fixations in each area."""
    areas: dict[str, None] = {}  # each once, in their order
    for part in parts:
        areas |= dict.fromkeys(part["shares"])
    columns = [OverviewColumn(name, "number") for name in areas]
    # Where nothing is to be cautious of, the column would be empty.
    has_caution = any(part["caution"] for part in parts)
    if has_caution:
        columns.append(OverviewColumn("caution", "aside"))
    rows = []
    for number, part in enumerate(parts):
        cells = [part["shares"].get(name, "") for name in areas]
        if has_caution:
            cells.append(part["caution"] or "")
        picture = part["picture"]
        drawing = small_picture(picture["image"], _first_fixations(picture))
        rows.append(OverviewRow(picture["name"], f"facts-{number}", drawing, cells))
    headline = f"Where people look first in {counted(len(parts), 'picture')}, from the largest dot to the smallest"
    return overview_section(headline, columns, rows)


def _first_fixations(picture: Data) -> str:
    """Draw the first fixations over a small picture, in shares of its width and height, in order of size."""
    width, height = picture["size"]
    marks = []
    for radius, (x, y) in zip(_RADII, picture["first"], strict=False):
        pixels = radius * max(width, height)
        marks.append(
            f'<ellipse cx="{x / width:.3f}" cy="{y / height:.3f}" rx="{pixels / width:.3f}" '
            f'ry="{pixels / height:.3f}" fill="{COLOURS[0]}" stroke="#ffffff" stroke-width="0.01"/>'
        )
    return "".join(marks)


_SHARES = (0.9, 0.5)  # shares of all fixations in the smallest areas whose borders are drawn


def _borders(cells: Tensor, size: tuple[int, int]) -> list[str]:
    """Draw the borders of the smallest areas that hold given shares of all fixations.

    Args:
        cells: `(rows, columns)`, the density.
        size: `(width, height)` of the picture in pixels.

    Returns:
        An SVG path in pixels of the picture for each share.
    """
    from contourpy import contour_generator

    values: NDArray[np.float64] = cells.double().numpy()
    width, height = size
    rows, columns = values.shape
    x = (np.arange(-1, columns + 1) + 0.5) * width / columns
    y = (np.arange(-1, rows + 1) + 0.5) * height / rows
    # An edge of zeros closes the lines at the border of the picture.
    generator = contour_generator(x.clip(0, width), y.clip(0, height), np.pad(values, 1))
    paths = []
    for share in _SHARES:
        lines: list[NDArray[np.float64]] = generator.lines(border_of(cells, share))  # type: ignore[assignment]
        paths.append("".join(_svg_path(line) for line in lines))
    return paths


def _svg_path(line: NDArray[np.float64]) -> str:
    """Draw a closed line through points `(n, 2)`."""
    return "M" + "L".join(f"{x:.0f},{y:.0f}" for x, y in line.tolist()) + "Z"


def _lead(prediction: GazePrediction, areas: Mapping[str, ViewedArea]) -> str:
    """Say in a few sentences where people look, and why that may be wrong."""
    said = f"{prediction.describe().capitalize()}."
    if areas:
        shares = ", ".join(f"{name} {percent(area.share)}" for name, area in areas.items())
        said += f" Share of all fixations: {shares}."
    return said if prediction.caution is None else f"{said} Caution: {prediction.caution}."


def _facts(prediction: GazePrediction, areas: Mapping[str, ViewedArea]) -> str:
    """Tell what is known of a picture without the script: first fixations, areas, places, and details in bits."""
    first = _place_rows(prediction.first_fixations())
    places = _place_rows(prediction.peaks())
    tables = [_area_table(areas)] if areas else []
    tables.append(_table("Where people look first", ("Fixation", "x, y in pixels", "Viewers"), first))
    tables.append(_table("Where most fixations are", ("Place", "x, y in pixels", "Fixations"), places))
    return f'<div class="parts">{"".join(tables)}</div>{_details(prediction)}'


def _area_table(areas: Mapping[str, ViewedArea]) -> str:
    """Make the table of areas of interest."""
    rows = []
    for name, area in areas.items():
        rows.append((name, percent(area.share), percent(area.visits.viewers), area.visits.when))
    caption = "Fixations in each area, viewers who see it, and when half of them have"
    return _table(caption, ("Area", "Fixations", "Viewers", "First seen"), rows)


def _place_rows(places: Sequence[Mapping[str, float]]) -> list[tuple[str, str, str]]:
    """Write places as rows of a table, numbered in their order."""
    rows = []
    for number, place in enumerate(places, 1):
        rows.append((str(number), f"{place['x']:z.0f}, {place['y']:z.0f}", percent(place["share"])))
    return rows


def _table(caption: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Make a table."""
    headings = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    lines = []
    for row in rows:
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in row)
        lines.append(f"<tr>{cells}</tr>")
    table = (
        f"<table><caption>{escape(caption)}</caption><thead><tr>{headings}</tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table>"
    )
    return scrollable(table, caption)


def _details(prediction: GazePrediction) -> str:
    """Tell the numbers that researchers ask for, with what they mean."""
    uniform = math.log2(prediction.cells.numel())
    spread = f"{prediction.entropy:.2f} bits; {uniform:.2f} if people looked everywhere alike"
    rows = [("Spread of the map (entropy)", spread)]
    rows += [(f"What the {name} adds to the map", f"{bits:.2f} bits") for name, bits in prediction.parts.items()]
    if prediction.unlikeness is not None:
        alike = f"{prediction.unlikeness:.2f}; above 1 it is unlike the photographs that the model learned from"
        rows.append(("Distance of the picture from those of the fit", alike))
    return f"<details><summary>Numbers of the model</summary>{_table('Numbers of the model', ('', ''), rows)}</details>"
