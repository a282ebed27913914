"""The probability that an object of a large picture is there, and how many objects no look has shown yet."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.detection.objects import intersection, neighbours
from semfov.errors import check

FACTS = (
    "score",
    "best",
    "sharpest",
    "shown",
    "missed",
    "cut",
    "size",
    "size squared",
    "agreement",
    "double",
    "inside",
    "around",
    "octaves",
    "rival",
)
"""Facts about an object, from which its probability is predicted (`object_facts`)."""

SPREAD = 0.3
"""The spread of a certainty (`Certainty`) for which none was fitted."""

_SURE, _SEVERAL, _PART = 0.5, 5, 0.6
"""Probability, number and share of the objects to which a detector reacts (`reacts`)."""

_LEAST, _MOST = 0.01, 0.999
_SMALLEST = 6.0
"""Side in canvas pixels from which on a look should show an object."""
_EDGE = 2.0
"""Canvas pixels from the border of a window within which it may cut an object."""


@dataclass(frozen=True)
class Certainty:
    r"""A logistic regression from facts f about an object to the probability that its box and class are right.

    .. math:: \operatorname{logit} p = a + \sum_i b_i f_i

    The number n of objects that looks would still show is about :math:`c R`. The evidence expects :math:`R_1` objects
    in cells that clearly promise one and :math:`R_2` in others, most of which count less, because many cells promise a
    little where nothing is. The scale c is learned from the looks that were made: if they showed F new objects where
    the evidence promised W, its distribution is a Gamma distribution, and n is negative binomial:

    .. math::
        R = R_1 + w R_2, \qquad
        E[c] = \frac{k c_0 + F}{k + u W}, \qquad
        \operatorname{Var}[n] = E[c] R + \frac{E[c] R^2}{k + u W}

    Pictures differ in how far all this suits them: the `spread` is the standard deviation of the share of the expected
    number by which it is off for that reason.
    """

    offset: float
    weights: tuple[float, ...]
    scale: float = 0.0
    strength: float = math.inf
    faint: float = 1.0
    promise: float = 1.0
    spread: float = SPREAD

    @classmethod
    def of(cls, numbers: Sequence[float]) -> Self:
        """Read a certainty from the numbers of a file."""
        if len(numbers) == 2:
            return cls(numbers[0], (numbers[1], *[0.0] * (len(FACTS) - 1)))
        first = len(FACTS) + 1
        check(
            len(numbers) - first in (2, 4, 5),
            "certainty",
            f"2, {first + 2}, {first + 4} or {first + 5} numbers",
            len(numbers),
        )
        return cls(numbers[0], tuple(numbers[1:first]), *numbers[first:])

    @property
    def numbers(self) -> list[float]:
        """The numbers of a file, as `of` reads them."""
        if math.isinf(self.strength):
            return [self.offset, self.weights[0]]
        return [self.offset, *self.weights, self.scale, self.strength, self.faint, self.promise, self.spread]

    def probability(self, facts: Tensor) -> Tensor:
        """The probabilities of objects; facts `(M, 14)` → `(M,)`."""
        return (self.offset + facts @ facts.new_tensor(self.weights)).sigmoid()

    def unseen(self, expected: tuple[float, float], *, promised: float, discoveries: float) -> tuple[float, float]:
        """How many objects further looks would show."""
        clear, faint = expected
        number = clear + self.faint * faint
        if math.isinf(self.strength):
            return self.scale * number, self.scale * number
        rate = self.strength + self.promise * promised
        scale = (self.strength * self.scale + discoveries) / rate
        return scale * number, scale * number * (1 + number / rate)


def reacts(chances: Tensor) -> bool:
    """Whether a detector reacts to the objects with these probabilities `(M,)`, so that their number can be believed.

    It does where five or more of them have a probability of one half, or where these make up three fifths of the sum
    of all. Otherwise most of that sum is of faint candidates.
    """
    sure = chances[chances >= _SURE]
    return len(sure) >= _SEVERAL or float(sure.sum()) >= _PART * float(chances.sum())


def number_of(chances: Tensor, unseen: tuple[float, float], spread: float) -> tuple[float, float]:
    r"""Mean and variance of the number of objects with some probabilities, and of those that no look has shown.

    The former are independent (a Poisson-binomial distribution), the latter have the distribution of `Certainty`:

    .. math::
        E = \sum_i p_i + E[n], \qquad
        \sigma^2 = \sum_i p_i (1 - p_i) + \operatorname{Var}[n] + \tau^2 E^2

    Shapes: chances `(M,)`.
    """
    each = chances.double()
    mean = float(each.sum()) + unseen[0]
    return mean, float((each * (1 - each)).sum()) + unseen[1] + (spread * mean) ** 2


def object_facts(
    index: Tensor,
    boxes: Tensor,
    scores: Tensor,
    labels: Tensor,
    looks: Tensor,
    cut: Tensor,
    windows: Tensor,
    magnifications: Tensor,
    size: tuple[int, int],
    finest: float,
    *,
    latest: bool = False,
) -> Tensor:
    """Compute the facts about each object (`FACTS`) from all looks.

    A look shows an object with a box of its class that overlaps it by half, or that the border of the window cuts and
    of which four fifths lie in it. A look should show an object of 6 canvas pixels or more that lies in its window and
    not at its border.

    Shapes: index `(M,)`, boxes `(L, 4)`, scores `(L,)`, labels `(L,)`, looks `(L,)`, cut `(L,)`, windows `(N, 4)`,
    magnifications `(N,)`, size `(width, height)` → `(M, 14)`.
    """
    count = len(index)
    if not count:
        return scores.new_zeros(0, len(FACTS))
    corners, value, label, look, broken, view, scale = (
        each.numpy() for each in (boxes.float(), scores.float(), labels, looks, cut, windows.float(), magnifications)
    )
    chosen, scale = index.numpy(), scale.astype(np.float32)
    first, second, shared, area = overlapping(corners)
    union = area[first] + area[second] - shared
    overlap = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)
    part = shared / np.maximum(area[second], 1e-6)
    place = np.full(len(corners), -1)
    place[chosen] = np.arange(count)
    object_, same = place[first] >= 0, label[first] == label[second]
    whole = object_ & same & (overlap >= 0.5)
    shows = whole | (object_ & same & broken[second] & (part >= 0.8) & (look[first] != look[second]))

    # The highest score of each object in each look.
    best_of = np.zeros((count, len(view)), np.float32)
    best_of[np.arange(count), look[chosen]] = value[chosen]
    np.maximum.at(best_of, (place[first[shows]], look[second[shows]]), value[second[shows]])
    visible, side = _visible(corners[chosen], view, scale, size, latest=latest)
    detected = best_of > 0
    usable = visible | detected
    sharpness = np.where(usable, scale, 0)
    sharpest = sharpness.max(1)
    odds = _logit(best_of)
    agree = whole & ~broken[second]
    number = np.bincount(place[first[agree]], minlength=count)
    agreement = np.bincount(place[first[agree]], overlap[agree], minlength=count) / np.maximum(number, 1)
    best = odds.max(1)

    # Among objects: the better one of a pair is the one with the higher best score.
    pair = np.flatnonzero(object_ & (place[second] >= 0))
    one, other = place[first[pair]], place[second[pair]]
    worse = (best[other] > best[one]) | ((best[other] == best[one]) & (other < one))
    pair, one, other = pair[worse], one[worse], other[worse]
    weight, alike = 1 / (1 + np.exp(-best[other])), same[pair]
    near = [each[pair] * weight for each in (overlap, shared / np.maximum(area[first], 1e-6), part)]
    double, inside, around, rival = np.zeros((4, count), np.float32)
    measures = (double, near[0], alike), (inside, near[1], alike), (around, near[2], alike), (rival, near[0], ~alike)
    for into, values, which in measures:
        np.maximum.at(into, one[which], values[which])

    extent = (side + np.log2(sharpest) - 5) / 2
    facts = [
        _logit(value[chosen]),
        best,
        np.where(sharpness >= sharpest[:, None] * (1 - 1e-6), odds, -np.inf).max(1),
        np.log1p(detected.sum(1)),
        np.log1p((visible & ~detected).sum(1)),
        broken[chosen],
        extent,
        extent**2,
        np.where(number > 0, agreement - 0.6, 0),
        double,
        inside,
        around,
        np.maximum(math.log2(finest) - np.log2(sharpest), 0),
        rival,
    ]
    return torch.from_numpy(np.stack(facts, -1).astype(np.float32))


def _logit(scores: NDArray[np.float32]) -> NDArray[np.float32]:
    inside = np.clip(scores, _LEAST, _MOST)
    odds: NDArray[np.float32] = np.log(inside / (1 - inside))
    return odds


def overlapping(
    boxes: NDArray[np.float32],
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]:
    """Pairs of boxes that overlap, in both orders, the areas that they share `(P,)`, and the areas of all `(L,)`."""
    x1, y1, x2, y2 = np.ascontiguousarray(boxes.T)
    order = x1.argsort(kind="stable")
    one, other = neighbours(x1[order], x2[order])
    one, other = order[one], order[other]
    shared = intersection(x1, y1, x2, y2, one, other)
    meets = shared > 0
    one, other, shared = one[meets], other[meets], shared[meets]
    area = np.maximum(x2 - x1, 0) * np.maximum(y2 - y1, 0)
    return np.concatenate([one, other]), np.concatenate([other, one]), np.concatenate([shared, shared]), area


def _visible(
    boxes: NDArray[np.float32],
    windows: NDArray[np.float32],
    scale: NDArray[np.float32],
    size: tuple[int, int],
    *,
    latest: bool,
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Which looks should show each box, `(M, N)`, and the logarithms (base 2) of the sides of the boxes, `(M,)`."""
    side = np.log2(np.maximum(boxes[:, 2:] - boxes[:, :2], 1e-3)).mean(1)
    # The border of the picture cuts no object.
    low = np.where(windows[:, :2] > 0, windows[:, :2] + _EDGE / scale[:, None], -np.inf)
    high = np.where(windows[:, 2:] < np.array(size) - 0.5, windows[:, 2:] - _EDGE / scale[:, None], np.inf)
    inside = (boxes[:, None, :2] >= low).all(-1) & (boxes[:, None, 2:] <= high).all(-1)
    visible = inside & (side[:, None] + np.log2(scale) >= math.log2(_SMALLEST))
    if latest:
        for number in range(len(scale) - 1):
            later = visible[:, number + 1 :] & (scale[number + 1 :] >= scale[number])
            visible[:, number] &= ~later.any(1)
    return visible, side
