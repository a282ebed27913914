"""What a search decides: whether the target is there, where, and how sure that is."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.target_evidence import Thresholds
from semfov.detection.detections import Detections
from semfov.episode import Step
from semfov.errors import check, check_finite, check_shape
from semfov.io.schema import is_number

Outcome = Literal["found", "absent", "undecided"]
OUTCOMES: tuple[Outcome, ...] = ("undecided", "found", "absent", "undecided")
"""Outcomes by the number that `decide` gives them; the first is that of searches that run out of gaze shifts."""

NEARLY = 0.9
"""A fixated cell this many times as probable as the most probable one is looked at well enough to find its object."""


@dataclass(frozen=True)
class Decision:
    """What came of a search.

    Attributes:
        outcome: `found`; `absent`, when nothing is left to look at and the image rather does not hold the target; or
            `undecided`, when it rather does, but is not sure enough, or gaze shifts ran out before.
        probability: that the target is in the image, after the last look.
        cell: for `found`, where the target is (`conclude`).
        box: `(4,)`, of all detections the one that says most of the target in that cell; None where there is none.
    """

    outcome: Outcome
    probability: float
    cell: int | None = None
    box: Tensor | None = None


def decide(step: Step, target: int | Tensor, thresholds: Thresholds) -> Tensor:
    """Which searches end with this step, `(A,)`: 0 for none, else the number of the outcome in `OUTCOMES`.

    A search has found its target when it is probable enough that the image holds it, and a cell was fixated that is
    about as probable as any, at least `NEARLY` times, and probable enough itself. It gives up when no cell is left that
    is worth a look, which another would be if no fixated cell holds the target (`Belief.chance`); the target is then
    absent, unless the image rather holds it than not.

    Args:
        step: of searches, from `semfov.episode.rollout`.
        target: class 1..K, or `(A,)`.
        thresholds: probabilities.
    """
    looked = place_known(step.belief.probability(target), step.visited, thresholds.place)
    left = step.belief.chance(target).masked_fill(step.visited, 0).amax(-1)
    return settle(step.belief.presence(target), looked, left, thresholds)


def settle(presence: Tensor, looked: Tensor, left: Tensor, thresholds: Thresholds) -> Tensor:
    """Which searches end, as for `decide`, by what is known of them, `(A,)` each.

    Args:
        presence: probability that the target is there.
        looked: boolean, whether the place that it is most probably in was looked at.
        left: what the best look that is left is worth.
        thresholds: probabilities.

    >>> settle(torch.tensor([0.95, 0.95, 0.2]), torch.tensor([True, False, False]), torch.tensor([0.1, 0.1, 0.01]),
    ...        Thresholds(confirm=0.9, give_up=0.05)).tolist()
    [1, 0, 2]
    """
    rest = torch.where(left < thresholds.give_up, torch.where(presence < 0.5, 2, 3), 0)
    return torch.where((presence >= thresholds.confirm) & looked, 1, rest)


def decide_by_price(step: Step, target: int | Tensor, price: float) -> Tensor:
    r"""Which searches end with this step, `(A,)`, as for `decide`: when looking on is not worth the price of the looks.

    A right decision is worth 1 and a look costs `price`. With P the probability that the image holds the target, to
    decide now is worth :math:`\max(P, 1 - P)`. The next m looks would go to the cells left with the highest
    probabilities p(x); they meet the target with probability :math:`U_m`, and it is then found for sure:

    .. math:: U_m = P \, \frac{\sum_{i \le m} p(x_i)}{\sum_x p(x)}, \qquad
              V_m = U_m + \max(P - U_m, \; 1 - P) - \text{price} \sum_{i < m} (1 - U_i)

    The search goes on as long as :math:`V_m` is greater than the value of deciding for any m, and ends with what is
    rather the case than not. (Ross, 1969, *A problem in optimal search and stop*; here over a fixed order of cells.)

    Args:
        step: of searches, from `semfov.episode.rollout`.
        target: class 1..K, or `(A,)`.
        price: of a look, in right decisions.

    Raises:
        InputError: the price is negative or not finite.
    """
    check(0 <= price < math.inf, "price", "0 or more right decisions", price)
    presence = step.belief.presence(target)[:, None]
    cells = step.belief.probability(target)
    left = cells.masked_fill(step.visited, 0).sort(-1, descending=True).values
    met = presence * left.cumsum(-1) / cells.sum(-1, keepdim=True).clamp(min=1e-12)
    before = torch.cat([torch.zeros_like(met[:, :1]), met[:, :-1]], -1)
    paid = price * (1 - before).cumsum(-1)
    value = met + torch.maximum(presence - met, 1 - presence) - paid
    # What is left is always at least nothing: rounding alone must not make a search go on.
    on = value.amax(-1) > torch.maximum(presence, 1 - presence)[:, 0] + 1e-6
    return torch.where(on, 0, torch.where(presence[:, 0] >= 0.5, 1, 2))


def place_known(cells: Tensor, visited: Tensor, place: float = 0.0) -> Tensor:
    """Whether a fixated cell is about as probable as the most probable one, and as probable as `place`, `(..., )`.

    All cells of a large object are about as probable; to fixate each of them would tell nothing more.

    Args:
        cells: `(..., X·Y)`, probabilities.
        visited: `(..., X·Y)` boolean, cells that were fixated.
        place: probability that the cell must have.

    >>> place_known(torch.tensor([[0.95, 0.9, 0.1]]), torch.tensor([[False, True, False]]), 0.8)
    tensor([True])
    """
    fixated = cells.masked_fill(~visited, 0).amax(-1)
    return (fixated >= NEARLY * cells.amax(-1)) & (fixated >= place)


def conclude(
    outcome: int, belief: Belief, looks: Sequence[Detections], grid: Grid, target: int, cell: int | None = None
) -> Decision:
    r"""The decision of one search that ended.

    A target that was found is in the cell where belief and detections together say most of it,

    .. math:: x = \arg\max_x P(t \in x) \max_l s_{lt} w_l(x)

    over the detections l of all looks, with scores s and `soft` footprints w.

    Args:
        outcome: number of the outcome in `OUTCOMES`.
        belief: after the last look, of one episode.
        looks: what was seen, batches of one.
        grid: the cells.
        target: class 1..K.
        cell: where it was found, if that is known.
    """
    probability = float(belief.presence(target))
    if OUTCOMES[outcome] != "found":
        return Decision(OUTCOMES[outcome], probability)
    if cell is None:
        cells = belief.probability(target)[0]
        shown = torch.stack([cells.new_zeros(len(grid)), *(strength(seen, grid, target) for seen in looks)]).amax(0)
        cell = int((cells * shown if bool(shown.any()) else cells).argmax())
    return Decision("found", probability, cell, best_box(looks, grid, cell, target))


def strength(seen: Detections, grid: Grid, target: int) -> Tensor:
    """How strongly the detections of one look show the target in each cell, `(X·Y,)`: score times `soft` footprint."""
    shown = grid.footprint(seen.boxes, "soft")[0] * (seen.mask[0] * seen.scores[0, :, target])[:, None]
    return shown.amax(0) if len(shown) else shown.sum(0)


def best_box(looks: Sequence[Detections], grid: Grid, cell: int, target: int) -> Tensor | None:
    """Of all detections the box that says most of the target in a cell, `(4,)`: score times `soft` footprint.

    Args:
        looks: batches of one.
        grid: the cells.
        cell: where the target is.
        target: class 1..K.
    """
    score, box = 0.0, None
    for seen in looks:
        weight = grid.footprint(seen.boxes, "soft")[0, :, cell] * seen.mask[0]
        scores = weight * seen.scores[0, :, target]
        if scores.numel() and float(scores.max()) > score:
            score, box = float(scores.max()), seen.boxes[0, int(scores.argmax())]
    return box


def confirms(detections: Detections, grid: Grid, cell: Tensor, target: int, score: float) -> Tensor:
    """Whether a detection that overlaps `cell` `(B,)` has `target` as its best class with such a score, `(B,)`."""
    sure = (detections.scores.argmax(-1) == target) & (detections.scores[..., target] >= score) & detections.mask
    there = grid.footprint(detections.boxes).take_along_dim(cell[:, None, None], -1)[..., 0]
    return (there & sure).any(-1)


def outcome_of(
    wanted: Mapping[int, float],
    grid: Grid,
    goal: Tensor | None,
    price: float | None,
    thresholds: Thresholds | None,
    confirm: float,
) -> Callable[[Step], Tensor]:
    """What tells which searches end with a step, as numbers in `OUTCOMES`, `(A,)`.

    Args:
        wanted: by class 1..K the probability that it is what is meant; the belief is about all of them.
        grid: the cells.
        goal: `(X·Y,)`, cells on which a search ends; None decides.
        price: of a look, to decide by; None decides by thresholds.
        thresholds: of the belief; None where it has none, and detections confirm.
        confirm: score of such a detection, times the probability that its class is meant.
    """
    first = next(iter(wanted))

    def outcome(step: Step) -> Tensor:
        if goal is not None:
            return goal[step.cell].long()
        if price is not None:
            return decide_by_price(step, first, price)
        if thresholds is not None:
            return decide(step, first, thresholds)
        seen = [
            confirms(step.detections, grid, step.cell, index, confirm / weight)
            for index, weight in wanted.items()
            if weight > 0
        ]
        return torch.stack(seen).any(0).long()

    return outcome


def goal_cells(boxes: Tensor | Sequence[Sequence[float]], grid: Grid, like: Tensor) -> Tensor:
    """Which cells boxes overlap, `(X·Y,)`: where a search is at its end by the protocol of the paper.

    Args:
        boxes: `(M, 4)`, `(x1, y1, x2, y2)` in pixels of the image.
        grid: the cells.
        like: whose type and device they take.

    Raises:
        InputError: they are no boxes.
    """
    tensor = torch.as_tensor(boxes).to(like)
    check_shape(tensor, "boxes", None, 4)
    check(tensor.ndim == 2, "boxes", "shape (M, 4)", tuple(tensor.shape))
    check_finite(tensor, "boxes")
    full = bool((tensor[:, 2:] > tensor[:, :2]).all())
    check(full, "boxes", "(x1, y1, x2, y2) with x1 < x2 and y1 < y2", "others; of (x, y, width, height) make x + width")
    return grid.footprint(tensor).any(-2)


def check_thresholds(confirm: float | None, give_up: float | None) -> None:
    """Raise `InputError` unless the thresholds that are given are probabilities."""
    for name, value in (("confirm", confirm), ("give_up", give_up)):
        check(value is None or (is_number(value) and 0 <= value <= 1), name, "a probability from 0 to 1", value)
