"""The decision of a search: whether the image holds the target, where, and with what probability, on what evidence."""

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
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.io.schema import is_number

Outcome = Literal["found", "absent", "undecided"]
OUTCOMES: tuple[Outcome, ...] = ("undecided", "found", "absent", "undecided")
"""Outcomes by their number in `decide`; the first is that of searches that run out of gaze shifts."""

_NEARLY = 0.9
"""A target counts as looked at if a fixated cell has at least this share of the largest probability of any cell."""


_ABSENT = 0.5
"""A search that ends without a find decides that the target is absent below this probability of the picture."""


@dataclass(frozen=True)
class Decision:
    """Decision of a search; box `(4,)`."""

    outcome: Outcome
    probability: float
    cell: int | None = None
    box: Tensor | None = None
    place: float | None = None


@dataclass(frozen=True)
class CloseUp:
    """A closer look at a place that seems to hold the target; box `(4,)`."""

    fixation: int | None
    target: int
    cell: int | None
    box: Tensor
    place: float
    presence: float
    number: int | None = None


def decide(step: Step, target: int | Tensor, thresholds: Thresholds) -> Tensor:
    """Decide by thresholds which searches end with this step; target `(A,)` → `(A,)`.

    A search has found its target if the image holds the target with enough probability, and a fixated cell is nearly as
    probable as the most probable one (`_NEARLY`) and probable enough itself. A search gives up if no remaining cell is
    probable enough to be worth a look, given that no fixated cell holds the target (`Belief.chance`). The target is
    then absent, unless the image holds it with a probability of at least `_ABSENT`.
    """
    looked = place_known(step.belief.probability(target), step.visited, thresholds.place)
    left = step.belief.chance(target).masked_fill(step.visited, 0).amax(-1)
    return settle(step.belief.presence(target), looked, left, thresholds)


def settle(presence: Tensor, looked: Tensor, left: Tensor, thresholds: Thresholds) -> Tensor:
    """Apply the thresholds of `decide` to the probabilities of searches.

    Shapes: presence `(A,)`, looked `(A,)`, left `(A,)` → `(A,)`.
    """
    rest = torch.where(left < thresholds.give_up, torch.where(presence < _ABSENT, 2, 3), 0)
    return torch.where((presence >= thresholds.confirm) & looked, 1, rest)


def place_known(cells: Tensor, visited: Tensor, place: float = 0.0) -> Tensor:
    """Whether a fixated cell is nearly as probable as the most probable one, and at least as probable as `place`.

    All cells of a large object are about equally probable, and there is no need to fixate each of them.

    >>> place_known(torch.tensor([[0.95, 0.9, 0.1]]), torch.tensor([[False, True, False]]), 0.8)
    tensor([True])

    Shapes: cells `(..., X·Y)`, visited `(..., X·Y)`.
    """
    fixated = cells.masked_fill(~visited, 0).amax(-1)
    return (fixated >= _NEARLY * cells.amax(-1)) & (fixated >= place)


def conclude(
    outcome: int, belief: Belief, looks: Sequence[Detections], grid: Grid, target: int, cell: int | None = None
) -> Decision:
    r"""Make the decision of one search that ended.

    The cell of a found target is the one with the strongest evidence of belief and detections together,

    .. math:: x = \arg\max_x P(t \in x) \max_l s_{lt} w_l(x)

    where l runs over the detections of all looks, with scores s and `soft` footprints w.
    """
    probability = float(belief.presence(target))
    if OUTCOMES[outcome] != "found":
        return Decision(OUTCOMES[outcome], probability)
    if cell is None:
        cells = belief.probability(target)[0]
        strengths = (_strength(look, grid, target) for look in looks)
        evidence = torch.stack([cells.new_zeros(len(grid)), *strengths]).amax(0)
        cell = int((cells * evidence if bool(evidence.any()) else cells).argmax())
    return Decision("found", probability, cell, _strongest(looks, grid, cell, target)[1])


def verified(places: Sequence[float], presence: float, confirm: float, *, over: bool) -> int:
    """Decide a search after closer looks.

    It has found its target if a place is sure: halfway between `confirm` and 1, or more. When it is over, it has found
    it if a place is probable enough; otherwise the target is absent if the picture holds it with a probability below
    `_ABSENT`.
    """
    best = max(places, default=0.0)
    if places and best >= (confirm if over else (1 + confirm) / 2):
        return OUTCOMES.index("found")
    if not over:
        return 0
    return OUTCOMES.index("absent") if presence < _ABSENT else len(OUTCOMES) - 1


def outcome_of(
    weights: Mapping[int, float],
    grid: Grid,
    goal: Tensor | None,
    thresholds: Thresholds | None,
    confirm: float,
) -> Callable[[Step], Tensor]:
    """Make the function that decides which searches end with a step; goal `(X·Y,)` → `(A,)`."""
    first = next(iter(weights))

    def outcome(step: Step) -> Tensor:
        if goal is not None:
            return goal[step.cell].long()
        if thresholds is not None:
            return decide(step, first, thresholds)
        hits = [
            confirms(step.detections, grid, step.cell, index, confirm / weight)
            for index, weight in weights.items()
            if weight > 0
        ]
        return torch.stack(hits).any(0).long()

    return outcome


def outcome_by_gain(gain: AcquisitionFunction, worth: float) -> Callable[[Step], Tensor]:
    """Make the function that decides which explorations end with a step; → `(A,)`."""

    def outcome(step: Step) -> Tensor:
        best = gain(step.belief, step.visited).masked_fill(step.visited, -math.inf).amax(-1)
        return ((best < worth) & (worth > 0) & ~step.visited.all(-1)).long()

    return outcome


def check_thresholds(confirm: float | None, give_up: float | None) -> None:
    """Raise `InputError` unless each threshold is None or a probability."""
    for name, value in (("confirm", confirm), ("give_up", give_up)):
        check(value is None or (is_number(value) and 0 <= value <= 1), name, "a probability from 0 to 1", value)


def _strength(detections: Detections, grid: Grid, target: int) -> Tensor:
    """Evidence of the detections of one look for the target in each cell, `(X·Y,)`: score times `soft` footprint."""
    scores = detections.mask[0] * detections.scores[0, :, target]
    by_detection = grid.footprint(detections.boxes, "soft")[0] * scores[:, None]
    return by_detection.amax(0) if len(by_detection) else by_detection.sum(0)


def _strongest(looks: Sequence[Detections], grid: Grid, cell: int, target: int) -> tuple[float, Tensor | None]:
    """Detection with the strongest evidence for the target in a cell: score times `soft` footprint; → `(4,)`."""
    evidence, box = 0.0, None
    for look in looks:
        weight = grid.footprint(look.boxes, "soft")[0, :, cell] * look.mask[0]
        scores = weight * look.scores[0, :, target]
        if scores.numel() and float(scores.max()) > evidence:
            evidence, box = float(scores.max()), look.boxes[0, int(scores.argmax())]
    return evidence, box


def confirms(detections: Detections, grid: Grid, cell: Tensor, target: int, score: float) -> Tensor:
    """Whether a detection over each cell `(B,)` has `target` as its best class with at least this score, `(B,)`."""
    sure = (detections.scores.argmax(-1) == target) & (detections.scores[..., target] >= score) & detections.mask
    there = grid.footprint(detections.boxes).take_along_dim(cell[:, None, None], -1)[..., 0]
    return (there & sure).any(-1)


def goal_cells(boxes: Tensor | Sequence[Sequence[float]], grid: Grid, like: Tensor) -> Tensor:
    """Cells that boxes overlap; by the protocol of the paper a search ends when it fixates one of them.

    Shapes: boxes `(M, 4)` → `(X·Y,)`.
    """
    tensor = torch.as_tensor(boxes).to(like)
    check_shape(tensor, "boxes", None, 4)
    check(tensor.ndim == 2, "boxes", "shape (M, 4)", tuple(tensor.shape))
    check_finite(tensor, "boxes")
    full = bool((tensor[:, 2:] > tensor[:, :2]).all())
    check(
        full,
        "boxes",
        "(x1, y1, x2, y2) with x1 < x2 and y1 < y2",
        "others; convert (x, y, width, height) to (x, y, x + width, y + height)",
    )
    return grid.footprint(tensor).any(-2)


def cell_of(box: Tensor, grid: Grid) -> int:
    """The cell that a box `(4,)` covers most (its `soft` footprint)."""
    return int(grid.footprint(box[None], "soft")[0].argmax())
