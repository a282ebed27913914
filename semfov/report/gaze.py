"""A page of where people look in pictures, with a slider over the fixations of drawn viewers."""

import base64
from collections.abc import Sequence
from html import escape
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.fixations import Fixations
from semfov.io.files import write_text
from semfov.paths.gaze import GazePrediction
from semfov.report.episode import Data, jpeg_uri
from semfov.report.page import colour_steps, filled, page_path
from semfov.viz.style import COLOURS, overlay_colours

_WIDTH, _QUALITY = 960, 80
_MOST_STEPS = 12  # largest number of fixations of the slider


def gaze_part(prediction: GazePrediction, scanpaths: Sequence[Fixations]) -> Data:
    """What the page has of a prediction: maps relative to their largest values as bytes, contours, drawn scanpaths."""
    steps = min(max(map(len, scanpaths)), _MOST_STEPS)
    maps = [prediction.cells, *(prediction.given(scanpaths, number) for number in range(1, steps + 1))]
    relative = [(each / each.max() * 255).round().byte() for each in maps]
    picture = {
        "name": prediction.name,
        "size": list(prediction.size),
        "image": jpeg_uri(prediction.image, _WIDTH, _QUALITY),
        "cells": list(prediction.cells.shape),
        "maps": [base64.b64encode(each.numpy().tobytes()).decode() for each in relative],
        "contours": [_contours(each, prediction.size) for each in maps],
        "paths": [[[round(x, 1), round(y, 1)] for x, y in each.points.tolist()] for each in scanpaths],
    }
    return {"picture": picture, "facts": _facts(prediction)}


def write_gaze_page(path: str | PathLike[str], title: str, parts: Sequence[Data]) -> Path:
    """Write the page of one or several pictures; the path must end in `.html` or `.htm`."""
    path = page_path(Path(path))
    write_text(path, gaze_page_html(title, parts))
    return path


def gaze_page_html(title: str, parts: Sequence[Data]) -> str:
    """Make the page of one or several pictures."""
    data = {
        "pictures": [each["picture"] for each in parts],
        "heat": colour_steps(overlay_colours()),
        "colours": list(COLOURS),
    }
    contents = {
        "title": escape(title),
        "facts": "".join(
            f'<section class="facts-of" id="facts-{number}"><h2>{escape(each["picture"]["name"])}</h2>'
            f"{each['facts']}</section>"
            for number, each in enumerate(parts)
        ),
    }
    return filled("gaze", data, contents)


_MASSES = (0.8, 0.5, 0.25)  # shares of all fixations that the smallest regions inside the contours hold


def _contours(cells: Tensor, size: tuple[int, int]) -> list[str]:
    """SVG paths around the smallest regions that hold given shares of all fixations, in pixels of the picture."""
    from contourpy import contour_generator

    values: NDArray[np.float64] = cells.double().numpy()
    rows, columns = values.shape
    x = (np.arange(-1, columns + 1) + 0.5) * size[0] / columns
    y = (np.arange(-1, rows + 1) + 0.5) * size[1] / rows
    # An edge of zeros closes the contours at the border of the picture.
    made = contour_generator(x.clip(0, size[0]), y.clip(0, size[1]), np.pad(values, 1))
    ordered = np.sort(values.reshape(-1))[::-1]
    levels = [ordered[min(int(np.searchsorted(ordered.cumsum(), mass)), ordered.size - 1)] for mass in _MASSES]
    lines: list[list[NDArray[np.float64]]] = [made.lines(level) for level in levels]  # type: ignore[misc]
    return [
        "".join("M" + "L".join(f"{px:.0f},{py:.0f}" for px, py in line.tolist()) + "Z" for line in several)
        for several in lines
    ]


def _facts(prediction: GazePrediction) -> str:
    """What is known of a picture without the script: entropy, terms, and places in order."""
    bits = ", ".join(f"{name} {value:.2f}" for name, value in prediction.parts.items())
    rows = "".join(
        f"<tr><td>{place}</td><td>{peak['x']:.0f}, {peak['y']:.0f}</td><td>{100 * peak['share']:.1f} %</td></tr>"
        for place, peak in enumerate(prediction.peaks(), 1)
    )
    return (
        f'<dl class="facts"><div><dt>Entropy of the density</dt><dd>{prediction.entropy:.2f} bits</dd></div>'
        f"<div><dt>Added by each term, bits</dt><dd>{escape(bits)}</dd></div></dl>"
        '<div class="wide" tabindex="0" role="region" aria-label="Places">'
        '<table><caption>Where most fixations are expected</caption><thead><tr><th scope="col">Place</th>'
        '<th scope="col">x, y in pixels</th><th scope="col">Fixations within 5 % of the longer side</th></tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )
