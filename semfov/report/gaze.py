"""A page of where people look in pictures, with a slider over the fixations of drawn viewers."""

import base64
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.fixations import Fixations
from semfov.paths.gaze import GazePrediction
from semfov.report.episode import Data, jpeg_uri
from semfov.report.template import colour_steps, filled
from semfov.viz.style import COLOURS, overlay_colours

_WIDTH = 960  # of the picture in pixels
_QUALITY = 80  # of the picture as JPEG
_MOST_STEPS = 12  # largest number of fixations of the slider


def gaze_part(prediction: GazePrediction, scanpaths: Sequence[Fixations]) -> Data:
    """Collect what the page has of a prediction, as JSON values.

    Args:
        prediction: the prediction.
        scanpaths: drawn scanpaths of viewers.

    Returns:
        `picture`, for the script: maps relative to their largest values as bytes, contours and scanpaths; and `facts`,
        HTML.
    """
    steps = min(max(map(len, scanpaths)), _MOST_STEPS)
    maps = [prediction.cells, *(prediction.given(scanpaths, number) for number in range(1, steps + 1))]
    picture = {
        "name": prediction.name,
        "size": list(prediction.size),
        "image": jpeg_uri(prediction.image, _WIDTH, _QUALITY),
        "cells": list(prediction.cells.shape),
        "maps": [_bytes_of_map(density) for density in maps],
        "contours": [_contours(density, prediction.size) for density in maps],
        "paths": [[[round(x, 1), round(y, 1)] for x, y in path.points.tolist()] for path in scanpaths],
    }
    return {"picture": picture, "facts": _facts(prediction)}


def _bytes_of_map(density: Tensor) -> str:
    """Encode a density relative to its largest value as bytes, in base 64."""
    relative = (density / density.max() * 255).round().byte()
    return base64.b64encode(relative.numpy().tobytes()).decode()


def gaze_page_html(title: str, parts: Sequence[Data]) -> str:
    """Make the page of one or several pictures.

    Args:
        title: plain text.
        parts: the pictures, from `gaze_part`.

    Returns:
        The HTML of the page.
    """
    data = {
        "pictures": [part["picture"] for part in parts],
        "heat": colour_steps(overlay_colours()),
        "colours": list(COLOURS),
    }
    facts = [
        f'<section class="facts-of" id="facts-{number}"><h2>{escape(part["picture"]["name"])}</h2>'
        f"{part['facts']}</section>"
        for number, part in enumerate(parts)
    ]
    return filled("gaze", data, {"title": escape(title), "facts": "".join(facts)})


_MASSES = (0.8, 0.5, 0.25)  # shares of all fixations that the smallest regions inside the contours hold


def _contours(cells: Tensor, size: tuple[int, int]) -> list[str]:
    """Draw the borders of the smallest regions that hold given shares of all fixations.

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
    # An edge of zeros closes the contours at the border of the picture.
    generator = contour_generator(x.clip(0, width), y.clip(0, height), np.pad(values, 1))
    ordered = np.sort(values.reshape(-1))[::-1]
    paths = []
    for mass in _MASSES:
        # The smallest region with this mass has the cells of the highest densities.
        last = min(int(np.searchsorted(ordered.cumsum(), mass)), ordered.size - 1)
        lines: list[NDArray[np.float64]] = generator.lines(ordered[last])  # type: ignore[assignment]
        paths.append("".join(_svg_path(line) for line in lines))
    return paths


def _svg_path(line: NDArray[np.float64]) -> str:
    """Draw a closed line through points `(n, 2)`."""
    return "M" + "L".join(f"{x:.0f},{y:.0f}" for x, y in line.tolist()) + "Z"


def _facts(prediction: GazePrediction) -> str:
    """Tell what is known of a picture without the script: entropy, terms, and places in order."""
    bits = ", ".join(f"{name} {value:.2f}" for name, value in prediction.parts.items())
    rows = "".join(
        f"<tr><td>{place}</td><td>{peak['x']:.0f}, {peak['y']:.0f}</td><td>{100 * peak['share']:.1f} %</td></tr>"
        for place, peak in enumerate(prediction.peaks(), 1)
    )
    caution = "" if prediction.caution is None else f"<p>{escape(prediction.caution.capitalize())}.</p>"
    return (
        f'{caution}<dl class="facts"><div><dt>Entropy of the density</dt><dd>{prediction.entropy:.2f} bits</dd></div>'
        f"<div><dt>Added by each term, bits</dt><dd>{escape(bits)}</dd></div></dl>"
        '<div class="wide" tabindex="0" role="region" aria-label="Places">'
        '<table><caption>Where most fixations are expected</caption><thead><tr><th scope="col">Place</th>'
        '<th scope="col">x, y in pixels</th><th scope="col">Fixations within 5 % of the longer side</th></tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )
