"""The decision of a search: whether the image holds the target, where, and with what probability, on what evidence."""

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
from semfov.errors import check, check_whole
from semfov.io.schema import is_number
from semfov.words import DECISION, OtherWords

Outcome = Literal["found", "absent", "undecided"]
OUTCOMES: tuple[Outcome, ...] = ("undecided", "found", "absent", "undecided")
"""Outcomes by their number in `decide`; the first is that of searches that run out of gaze shifts."""

_NEARLY = 0.9  # share of the largest probability of any cell from which on a fixated cell counts as the target's
_ABSENT = 0.5  # probability of the picture below which the target of a search without a find is absent


@dataclass(frozen=True)
class Decision(OtherWords):
    """Decision of a search; box `(4,)`."""

    outcome: Outcome
    probability: float
    cell: int | None = None
    box: Tensor | None = None
    place: float | None = None

    _other_words = DECISION


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

    @property
    def of_look(self) -> int:
        """Number of the look that it is, or after which it was made."""
        return (self.fixation if self.number is None else self.number) or 0


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
    # Evidence of each look: score times footprint, of each detection in each cell.
    evidence = [
        grid.footprint(look.boxes, "soft")[0] * (look.mask[0] * look.scores[0, :, target])[:, None] for look in looks
    ]
    cells = belief.probability(target)[0]
    if cell is None:
        strongest = torch.cat([cells.new_zeros(1, len(grid)), *evidence]).amax(0)
        cell = int((cells * strongest if bool(strongest.any()) else cells).argmax())
    best, box = 0.0, None
    for look, values in zip(looks, evidence, strict=True):
        if len(values) and float(values[:, cell].max()) > best:
            best, box = float(values[:, cell].max()), look.boxes[0, int(values[:, cell].argmax())]
    return Decision("found", probability, cell, box, float(cells[cell]))


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


def check_thresholds(confirm: float | None, give_up: float | None, closer: int | None = None) -> None:
    """Raise `InputError` unless each threshold is None or a probability, and closer looks are None or 0 to 100."""
    for name, value in (("confirm", confirm), ("give_up", give_up)):
        check(value is None or (is_number(value) and 0 <= value <= 1), name, "a probability from 0 to 1", value)
    check_whole(0 if closer is None else closer, "closer", 0, 100)


def confirms(detections: Detections, grid: Grid, cell: Tensor, target: int, score: float) -> Tensor:
    """Whether a detection over each cell `(B,)` gives `target` at least this score, `(B,)`."""
    sure = detections.mask & (detections.class_scores[..., target - 1] >= score)
    there = grid.footprint(detections.boxes).take_along_dim(cell[:, None, None], -1)[..., 0]
    return (there & sure).any(-1)


def detects(step: Step, *, grid: Grid, weights: Mapping[int, float], score: float) -> Tensor:
    """Decide without thresholds which searches end: where a fixated cell has a detection that is meant, `(A,)`.

    The product of its score and of the weight of its class, the probability that it is meant, is `score` at least.
    """
    meant = ((number, weight) for number, weight in weights.items() if weight > 0)
    hits = [confirms(step.detections, grid, step.cell, number, score / weight) for number, weight in meant]
    return torch.stack(hits).any(0).long()


def gains_less(step: Step, *, gain: Callable[[Belief, Tensor], Tensor], least: float) -> Tensor:
    """Decide which explorations end: where a look at every cell that is left gains less than `least`, `(A,)`."""
    best = gain(step.belief, step.visited).masked_fill(step.visited, -torch.inf).amax(-1)
    return ((best < least) & (least > 0) & ~step.visited.all(-1)).long()


def cell_of(box: Tensor, grid: Grid) -> int:
    """The cell that a box `(4,)` covers most (its `soft` footprint)."""
    return int(grid.footprint(box[None], "soft")[0].argmax())
