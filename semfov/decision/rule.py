"""The decision of a search: whether the image holds the target, where, and with what probability, on what evidence."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from semfov.attribute_words import DECISION, OtherWords
from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.episode import Step
from semfov.errors import InputError, check, check_whole
from semfov.io.schema import is_number
from semfov.observation.thresholds import Thresholds

Outcome = Literal["found", "absent", "undecided"]
OUTCOMES: tuple[Outcome, ...] = ("undecided", "found", "absent", "undecided")
"""Outcomes by their number in `decide`; the first is that of searches that run out of gaze shifts."""

GO_ON, FOUND, ABSENT, UNDECIDED = range(len(OUTCOMES))

MOST_CLOSER = 2
"""Number of closer looks after which a place is found that is probable enough.

It is the default for the largest number of closer looks with a fovea; windows have others (`semfov.settings`).
"""

_NEARLY = 0.9  # share of the largest probability of any cell from which on a fixated cell counts as the target's
EVEN_CHANCE = 0.5  # presence below which a picture rather lacks the target: without a find it is absent


@dataclass(frozen=True)
class Decision(OtherWords):
    """Decision of a search.

    Attributes:
        outcome: `found`, `absent`, or `undecided`.
        probability: that the picture holds the target; of windows without fitted models the best score of a detection.
        cell: cell of the found target, where places are cells.
        box: box `(4,)` of the found target, if a detection shows it.
        place: probability that the target is there; None where only its presence was judged.
        confirm: what `found` takes: least probability of one place where closer looks decide, otherwise of the picture,
            or in windows without learned evidence the least score; None where it is not known.
    """

    outcome: Outcome
    probability: float
    cell: int | None = None
    box: Tensor | None = field(default=None, compare=False)  # tensors have no one truth
    place: float | None = None
    confirm: float | None = None

    _other_words = DECISION

    def __bool__(self) -> bool:
        """Refuse: a decision that nothing is there would be as true as any other."""
        raise InputError("decision: expected its outcome where it is a condition: decision.outcome == 'found'")


@dataclass(frozen=True)
class CloseUp:
    """A closer look at a place that seemed to hold the target, and its probabilities.

    Attributes:
        fixation: index of the fixation after which it was made, from 0; None for windows.
        target: class 1..K that was looked for.
        cell: cell that the box covers most, where places are cells.
        box: box `(4,)` of the target, by windows that of the surest object at the place; the examined one where the
            target is not shown.
        place: probability that the target is there, after the look.
        presence: probability that the picture holds the target, after the look.
        index: place of the look that it is in its record, `record[index]`, from 0; None if it is no look of a record.
    """

    fixation: int | None
    target: int
    cell: int | None
    box: Tensor
    place: float
    presence: float
    index: int | None = None

    @property
    def number(self) -> int | None:
        """Number of the closer look among the looks of the search, from 1 (`semfov.paths.RecordedLook.number`)."""
        return None if self.index is None else self.index + 1

    @property
    def index_of_look(self) -> int:
        """Index of the look that it is, or after which it was made."""
        return (self.fixation if self.index is None else self.index) or 0


def decide(step: Step, target: int | Tensor, thresholds: Thresholds) -> Tensor:
    """Decide by the belief alone which searches of a fovea end with a step (`settle`).

    The place is located by a fixated cell (`place_known`). The hit chance is the largest probability of a cell that was
    not fixated, given that no fixated cell holds the target (`Belief.chance`).

    Args:
        step: the step of A searches.
        target: class 1..K, or one for each search, `(A,)`.
        thresholds: thresholds of the belief.

    Returns:
        `(A,)`, numbers of `OUTCOMES`, `GO_ON` for a search that goes on.
    """
    located = place_known(step.belief.probability(target), step.visited, thresholds.place)
    chance = step.belief.chance(target)  # (A, X·Y)
    hit_chance = chance.masked_fill(step.visited, 0).amax(-1)
    return settle(step.belief.presence(target), located, hit_chance, thresholds)


def settle(presence: Tensor, located: Tensor, hit_chance: Tensor, thresholds: Thresholds) -> Tensor:
    """Decide which searches end, without closer looks.

    A search has found its target if the picture holds it with enough probability, and a look has shown where it is. It
    gives up if no remaining look has enough chance of a hit. The target is then absent, unless the picture holds it
    with a probability of one half or more.

    Args:
        presence: `(A,)`, probability that the picture holds the target.
        located: `(A,)` boolean, whether a look has shown the target's place.
        hit_chance: `(A,)`, chance that the best remaining look shows the target, if no look so far has.
        thresholds: `confirm` for the presence, and `stop_below` for the hit chance.

    Returns:
        `(A,)`, numbers of `OUTCOMES`, `GO_ON` for a search that goes on.
    """
    is_found = (presence >= thresholds.confirm) & located
    without_find = torch.where(presence < EVEN_CHANCE, ABSENT, UNDECIDED)
    unfound = torch.where(hit_chance < thresholds.stop_below, without_find, GO_ON)
    return torch.where(is_found, FOUND, unfound)


def place_known(cells: Tensor, visited: Tensor, place: float = 0.0) -> Tensor:
    """Tell whether a fixated cell is nearly as probable as the most probable one, and at least as probable as `place`.

    All cells of a large object are about equally probable, and there is no need to fixate each of them.

    Args:
        cells: `(..., X·Y)`, probability that the target is in each cell.
        visited: `(..., X·Y)` boolean, cells that were fixated.
        place: least probability of the fixated cell.

    Returns:
        `(...)` boolean.
    """
    largest = cells.amax(-1)
    largest_fixated = cells.masked_fill(~visited, 0).amax(-1)
    return (largest_fixated >= _NEARLY * largest) & (largest_fixated >= place)


def decision_without_closer_looks(
    outcome: int,
    belief: Belief,
    looks: Sequence[Detections],
    grid: Grid,
    target: int,
    cell: int | None = None,
    confirm: float | None = None,
) -> Decision:
    r"""Make the decision of one search of a fovea without closer looks.

    The cell of a found target is the one with the strongest evidence of belief and detections together,

    .. math:: x = \arg\max_x P(t \in x) \max_l s_{lt} w_l(x)

    where l runs over the detections of all looks, with scores s and `soft` footprints w.

    Args:
        outcome: number of the outcome (`OUTCOMES`).
        belief: the belief of the search, a batch of one.
        looks: detections of the looks, batches of one.
        grid: the cells.
        target: class 1..K.
        cell: the cell of the target; None takes the one with the strongest evidence.
        confirm: what `found` takes (`Decision`).

    Returns:
        The decision. Its box is that of the detection with the strongest evidence in the cell, if there is one.
    """
    presence = float(belief.presence(target))
    if OUTCOMES[outcome] != "found":
        return Decision(OUTCOMES[outcome], presence, confirm=confirm)
    probability = belief.probability(target)[0]
    if cell is None:
        cell = _strongest_cell(probability, [_evidence_of_cells(look, grid, target) for look in looks])
    box = most_evident_box(looks, grid, target, cell)
    return Decision("found", presence, cell, box, float(probability[cell]), confirm)


def _strongest_cell(probability: Tensor, evidence: Sequence[Tensor]) -> int:
    """Find the cell with the strongest evidence of belief and detections (`decision_without_closer_looks`).

    Args:
        probability: `(X·Y,)`, of the target in each cell.
        evidence: `(L, X·Y)` of each look.
    """
    no_evidence = torch.zeros_like(probability)[None]
    strongest = torch.cat([no_evidence, *evidence]).amax(0)
    # Where no detection shows the target, the belief alone tells where it is.
    value = probability * strongest if bool(strongest.any()) else probability
    return int(value.argmax())


def _evidence_of_cells(look: Detections, grid: Grid, target: int) -> Tensor:
    """Evidence `(L, X·Y)` of each detection of a look that the target is in each cell: score times footprint."""
    scores = look.mask[0] * look.scores[0, :, target]  # (L,)
    footprints = grid.footprint(look.boxes, "soft")[0]  # (L, X·Y)
    return footprints * scores[:, None]


def most_evident_box(looks: Sequence[Detections], grid: Grid, target: int, cell: int) -> Tensor | None:
    """Find the detection that shows the target in a cell with the strongest evidence: its score times its footprint.

    Args:
        looks: detections of the looks, batches of one.
        grid: the cells.
        target: class 1..K.
        cell: number of the cell.

    Returns:
        Its box `(4,)`; None if no detection has any evidence there.
    """
    highest = 0.0
    box = None
    for look in looks:
        in_cell = _evidence_of_cells(look, grid, target)[:, cell]  # (L,)
        if len(in_cell) and float(in_cell.max()) > highest:
            highest = float(in_cell.max())
            box = look.boxes[0, int(in_cell.argmax())]
    return box


def found_at_once(places: Sequence[float], confirm: float, made: int) -> bool:
    """Tell whether one place ends a search at once: it is sure, from halfway between `confirm` and 1 on.

    After `MOST_CLOSER` closer looks it is one that is probable enough, from `confirm` on.

    Args:
        places: probabilities that the target is at each place, after closer looks.
        confirm: probability of a place from which on a search that is over has found its target.
        made: number of closer looks.
    """
    least = confirm if made >= MOST_CLOSER else (1 + confirm) / 2
    return bool(places) and max(places) >= least


def final_outcome(places: Sequence[float], presence: float, confirm: float) -> int:
    """Decide a search with closer looks that is over.

    It has found its target if one place is probable enough. Otherwise the target is absent, unless the picture holds it
    with a probability of one half or more.

    Args:
        places: probabilities that the target is at each place, after closer looks; there may be none.
        presence: probability that the picture holds the target.
        confirm: least probability of a place for `found`.

    Returns:
        The number of one of `OUTCOMES`: `FOUND`, `ABSENT` or `UNDECIDED`.
    """
    if places and max(places) >= confirm:
        return FOUND
    return ABSENT if presence < EVEN_CHANCE else UNDECIDED


def check_thresholds(confirm: float | None, stop_below: float | None, closer: int | None = None) -> None:
    """Raise `InputError` unless each threshold is None or a probability, and closer looks are None or 0 to 100."""
    _check_chance("confirm", confirm)
    _check_chance("stop_below", stop_below)
    if closer is not None:
        check_whole(closer, "closer", 0, 100)


def _check_chance(name: str, value: float | None) -> None:
    """Raise `InputError` unless a threshold is None or a probability."""
    is_chance = value is None or (is_number(value) and 0 <= value <= 1)
    check(is_chance, name, "a probability from 0 to 1", value)


def confirms(detections: Detections, grid: Grid, cell: Tensor, target: int, score: float) -> Tensor:
    """Whether a detection over each cell `(B,)` gives `target` at least this score, `(B,)`."""
    has_score = detections.mask & (detections.class_scores[..., target - 1] >= score)  # (B, L)
    footprints = grid.footprint(detections.boxes)  # (B, L, X·Y)
    is_over_cell = footprints.take_along_dim(cell[:, None, None], -1)[..., 0]
    return (is_over_cell & has_score).any(-1)


def detects(step: Step, *, grid: Grid, weights: Mapping[int, float], score: float) -> Tensor:
    """Decide without thresholds which searches end: where a fixated cell has a detection that is meant, `(A,)`.

    The product of its score and of the weight of its class, the probability that it is meant, is `score` at least.
    """
    hits = []
    for target, weight in weights.items():
        if weight > 0:
            hits.append(confirms(step.detections, grid, step.cell, target, score / weight))
    return torch.stack(hits).any(0).long()


def gains_less(step: Step, *, gain: Callable[[Belief, Tensor], Tensor], least: float) -> Tensor:
    """Decide which explorations end: where a look at every cell that is left gains less than `least`, `(A,)`.

    Exploration without a least gain, or with no cell left, does not end so.
    """
    gains = gain(step.belief, step.visited)  # (A, X·Y)
    best = gains.masked_fill(step.visited, -torch.inf).amax(-1)
    has_cells_left = ~step.visited.all(-1)
    return ((best < least) & (least > 0) & has_cells_left).long()


def cell_of(box: Tensor, grid: Grid) -> int:
    """Find the cell that a box `(4,)` covers most (its `soft` footprint)."""
    return int(grid.footprint(box[None], "soft")[0].argmax())
