"""Simulated viewers: where they begin, how long they look, and when they see an area."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from semfov.data.fixations import Fixations
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.io.tables import digits
from semfov.paths.areas import Area, percent

_MOST_FIXATIONS = 100  # of a drawn scanpath
_AT_ONCE = 0.05  # seconds, below which a time rounds to nothing
_SHORTEST = 60  # milliseconds of a fixation, by which the number of fixations in a time is bounded


class AreaVisits(NamedTuple):
    """Number of viewers who see an area, and when they first see it.

    Attributes:
        viewers: share of the viewers with at least one fixation in the area.
        seconds: the median, over these viewers, of the time at which their first fixation in the area begins (time to
            first fixation); None if nobody sees it. The eyes begin in the middle, so an area in the middle is seen at
            0.

    >>> str(AreaVisits(0.36, 0.84))
    'seen by 36 % of viewers, by these first after 0.8 s'
    >>> str(AreaVisits(1.0, 0.0))
    'seen by 100 % of viewers, by these first at once'
    """

    viewers: float
    seconds: float | None

    def __str__(self) -> str:
        """Say both in a few words."""
        if self.seconds is None:
            return "seen by no viewer"
        return f"seen by {percent(self.viewers)} of viewers, by these first {self.when}"

    def __repr__(self) -> str:
        """Write both in words, so that the time stands beside the share of viewers that it is of."""
        return f"{type(self).__name__}: {self}"

    @property
    def when(self) -> str:
        """The time in words; empty where nobody sees the area."""
        if self.seconds is None:
            return ""
        return "at once" if self.seconds < _AT_ONCE else f"after {self.seconds:.1f} s"


def visits_of(viewers: Sequence[Fixations], area: Area, pause: float) -> AreaVisits:
    """Count the viewers with a fixation in an area, and take the median time of their first one.

    Args:
        viewers: their fixations, with durations.
        area: left, top, right and bottom edge, in pixels.
        pause: milliseconds between two fixations.

    Returns:
        The share of viewers, and the time.
    """
    left, top, right, bottom = area
    first: list[float] = []
    for viewer in viewers:
        x, y = viewer.points.T + 0.5  # centres of pixels are at integers, edges at halves
        is_inside = (left <= x) & (x < right) & (top <= y) & (y < bottom)  # (n,)
        if is_inside.any():
            number = int(is_inside.argmax())
            durations = np.asarray(viewer.durations)[:number]
            first.append(float((durations + pause).sum()) / 1000)
    return AreaVisits(len(first) / len(viewers), digits(float(np.median(first))) if first else None)


def drawn_starts(
    model: FixationDensity,
    log_density: Tensor,
    size: tuple[int, int],
    people: int,
    generator: torch.Generator,
) -> Tensor:
    r"""Sample the first fixation of each viewer, near the middle and where people look in this picture.

    .. math:: p_1(u) \propto p(u) \, e^{-z(u)^2 / 2}

    z is the distance from the mean of first fixations, in their standard deviations along each side.

    Args:
        model: has mean and deviations.
        log_density: `(rows, columns)`, :math:`\ln p` in the cells of the picture, but for a constant.
        size: `(width, height)` of the picture in pixels.
        people: number of viewers.
        generator: of the draws.

    Returns:
        `(people, 2)`, in pixels.
    """
    rows, columns = log_density.shape
    mean, spread = model.start.cpu().double()  # (2,) both, shares of the sides
    x = (_centres(columns) - mean[0]) / spread[0]
    y = (_centres(rows) - mean[1]) / spread[1]
    square = x.square() + y[:, None].square()
    share = (log_density.cpu().double() - square / 2).flatten().softmax(0)
    cell = share.multinomial(people, replacement=True, generator=generator)
    corner = torch.stack([cell % columns, cell // columns], 1)  # (people, 2)
    within_cell = torch.rand(people, 2, generator=generator)
    side = torch.tensor(size)  # (2,)
    start = (corner + within_cell) * (side / torch.tensor([columns, rows])) - 0.5
    # The right and the lower edge of a picture belong to none of its pixels.
    return torch.minimum(start, side - 0.5 - 1e-3)


def _centres(cells: int) -> Tensor:
    """Compute the centres of the cells along a side, as shares of it, `(cells,)`."""
    return (torch.arange(cells, dtype=torch.float64) + 0.5) / cells


def drawn_durations(
    model: FixationDensity, people: int, seconds: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Sample durations of fixations in milliseconds, and count the fixations that begin within the time.

    Durations are log-normal; the last distribution of the model stands for all later fixations, too.

    Args:
        model: has the distributions, and the pause between two fixations.
        people: number of viewers.
        seconds: time for which each views the picture.
        generator: of the draws.

    Returns:
        `(people, n)`, and the number of each viewer's fixations, `(people,)`.
    """
    milliseconds = seconds * 1000
    count = min(_MOST_FIXATIONS, math.ceil(milliseconds / _SHORTEST) + 1)
    distributions = model.duration.cpu().float()  # (fixations, 2), mean and spread of the logarithm
    later = distributions[-1:].expand(max(count - len(distributions), 0), -1)
    mean, spread = torch.cat([distributions, later])[:count].unbind(1)  # (count,) both
    durations = (mean + spread * torch.randn(people, count, generator=generator)).exp()  # (people, count)
    ends = (durations + model.pause.cpu().float()).cumsum(1)
    ended_in_time = (ends < milliseconds).sum(1)  # (people,)
    return durations, (ended_in_time + 1).clamp(max=count)  # the last one begins in the time and ends after it
