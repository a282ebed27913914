"""How costs grow with the size of the problem: the slope of log time over log size."""

import math
from collections.abc import Callable

import torch

from benchmarks.beliefs import make_belief, make_look, make_model, unvisited
from benchmarks.timing import Clock, Run, Spread, interleaved
from semfov import Grid, acquisition, foveate
from semfov.belief import fuse


def fusing(cells: int = 100, classes: int = 80, batch: int = 1) -> Run:
    """A program that fuses 30 detections into each map."""
    beta, look = make_belief(cells, classes, batch).beta, make_look(cells, classes, batch)
    return lambda: fuse(beta, *look)


def exploring(side: int = 10, classes: int = 80, levels: int = 8) -> Run:
    """A program that makes one decision by KL divergence."""
    value = acquisition.KLDivergence(make_model(classes, levels), Grid(side, side, (640, 480)))
    belief = make_belief(side * side, classes)
    visited = unvisited(belief)
    return lambda: value(belief, visited)


def foveating(side: int = 256, levels: int = 5) -> Run:
    """A program that foveates an image for one fixation, including the pyramid."""
    image, gaze = torch.rand(1, 3, side, side), torch.tensor([side / 3, side / 2])
    return lambda: foveate(image, gaze, sigma=side / 6, levels=levels)


SERIES: dict[str, tuple[Callable[[int], Run], tuple[int, ...]]] = {
    "fusion, cells": (lambda n: fusing(cells=n), (100, 400, 1600)),
    "fusion, classes": (lambda n: fusing(classes=n), (80, 320, 1280)),
    "fusion, maps in a batch": (lambda n: fusing(batch=n), (1, 8, 64)),
    "exploration, cells": (lambda n: exploring(side=math.isqrt(n)), (100, 400, 1600)),
    "exploration, classes": (lambda n: exploring(classes=n), (20, 80, 320)),
    "exploration, levels": (lambda n: exploring(levels=n), (4, 8, 16)),
    "foveation, pixels": (lambda n: foveating(side=math.isqrt(n)), (256**2, 512**2, 1024**2)),
    "foveation, levels": (lambda n: foveating(levels=n), (2, 4, 6)),
}


def grow(seconds: float, clock: Clock) -> dict[str, tuple[dict[int, Spread], float]]:
    """For every series, milliseconds by size and the slope between the first and the last size."""
    grown = {}
    for name, (make, sizes) in SERIES.items():
        times = interleaved({str(size): make(size) for size in sizes}, seconds, clock)
        spreads = {size: Spread.of(times[str(size)]) for size in sizes}
        rise = math.log(spreads[sizes[-1]].middle / spreads[sizes[0]].middle)
        grown[name] = spreads, rise / math.log(sizes[-1] / sizes[0])
    return grown
