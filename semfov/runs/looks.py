"""Computes the looks that are stored, bit for bit the same with any number of threads and processes."""

from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.eye import Eye

LOOK_SOURCES = ("semfov.eye", "semfov.detection.load", "semfov.sensor.named", "semfov.data.reading", __name__)
"""The modules that turn an image into detections; all modules that they import count, too."""


def photograph_looks(
    eye: Eye, image: Callable[[], Tensor], grid: Grid
) -> Callable[[int | tuple[float, ...]], Detections]:
    """Return what looks at a photograph: from a cell, by number, or closely at a box, by its corners.

    Args:
        eye: the eye.
        image: gives the photograph, `(1, 3, H, W)`; it is called once, at the first look.
        grid: the cells.

    Returns:
        A function from a look to its detections, a batch of one without padding.
    """
    image = cache(image)
    open_view = cache(lambda: eye.open(image()))  # at the first look from a cell

    def look(action: int | tuple[float, ...]) -> Detections:
        if isinstance(action, tuple):
            return tight(eye.close_up(image(), torch.tensor(action)))
        view = open_view()
        return tight(eye.look(view, grid.centres.to(view.canvas)[[action]]))

    return look


def tight(look: Detections) -> Detections:
    """Remove the padding from the detections of a single look."""
    return look.take(look.mask[0])
