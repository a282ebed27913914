"""What a search decides: whether the target is there, where, and how sure that is."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.target_evidence import Thresholds
from semfov.detection.detections import Detections
from semfov.episode import Step

Outcome = Literal["found", "absent", "undecided"]
OUTCOMES: tuple[Outcome, ...] = ("undecided", "found", "absent", "undecided")
"""Outcomes by the number that `decide` gives them; the first is that of searches that run out of gaze shifts."""


@dataclass(frozen=True)
class Decision:
    """What came of a search.

    Attributes:
        outcome: `found`; `absent`, when nothing is left to look at and the image rather does not hold the target; or
            `undecided`, when it rather does, but is not sure enough, or gaze shifts ran out before.
        probability: that the target is in the image, after the last look.
        cell: for `found`, the most probable cell.
        box: `(4,)`, of all detections the one that says most of the target in that cell; None where there is none.
    """

    outcome: Outcome
    probability: float
    cell: int | None = None
    box: Tensor | None = None


def decide(step: Step, target: int | Tensor, thresholds: Thresholds) -> Tensor:
    """Which searches end with this step, `(A,)`: 0 for none, else the number of the outcome in `OUTCOMES`.

    A search has found its target when it is probable enough that the image holds it, and the gaze has been on the most
    probable cell. It gives up when no cell is left that is probable enough to be worth a look; the target is then
    absent, unless the image rather holds it than not.

    Args:
        step: of searches, from `semfov.episode.rollout`.
        target: class 1..K, or `(A,)`.
        thresholds: probabilities.
    """
    presence = step.belief.presence(target)
    cells = step.belief.probability(target)
    best = cells.argmax(-1, keepdim=True)
    found = (presence >= thresholds.confirm) & step.visited.gather(-1, best)[:, 0]
    nothing = cells.masked_fill(step.visited, 0).amax(-1) < thresholds.give_up
    rest = torch.where(nothing, torch.where(presence < 0.5, 2, 3), 0)
    return torch.where(found, 1, rest)


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
