"""Plain rules for presence and place: one unfoveated pass, closer looks at its best places, and quarters."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.verification import closer_features
from semfov.decision import cell_of
from semfov.detection.detections import Detections
from semfov.eye import Eye
from semfov.fit.logistic import logistic_regression
from semfov.observation.matching import SAME_OBJECT_IOU, box_iou
from semfov.runs.results import ResultRecord

_QUARTERS = "one unfoveated pass, four quarters"

PLAIN = {
    "one unfoveated pass": 0,
    "one unfoveated pass, one closer look": 1,
    "one unfoveated pass, two closer looks": 2,
    _QUARTERS: 0,
}
"""Names of the plain rules, with their numbers of closer looks."""

_FOLDS = 5
_LOWEST = 1e-4  # a score of 0 would have an infinite logit


class PlainDecisions(NamedTuple):
    """What a plain rule says of M searches.

    Attributes:
        presence: `(M,)`, probability that the target is there.
        place: `(M,)`, probability of the place that the rule reports; 0 where it reports none.
        right: `(M,)`, whether this place is on the target.
        passes: `(M,)`, number of passes.
    """

    presence: Tensor
    place: Tensor
    right: Tensor
    passes: Tensor


def plain_looks(
    eye: Eye,
    image: Tensor,
    whole: Detections,
    target: int,
    grid: Grid,
    goal: Tensor,
    most: int = 2,
) -> list[ResultRecord]:
    """Take closer looks at the best detections of the target that do not overlap by half.

    Args:
        eye: takes the looks.
        image: the photograph, `(1, 3, H, W)`.
        whole: detections in the whole photograph, a batch of one.
        target: the target's class, 1..K.
        grid: the grid over the photograph.
        goal: `(X·Y,)` boolean, the cells that the target overlaps.
        most: largest number of looks.

    Returns:
        For each look the facts that are known only after it, and whether it shows the target at the right place.
    """
    boxes = whole.boxes[0]
    scores = whole.scores[0, :, target] * whole.mask[0]
    looks: list[ResultRecord] = []
    while len(looks) < most and len(scores) and float(scores.max()) > 0:
        best = int(scores.argmax())
        box = boxes[best]
        # Without a belief the score stands for picture, cell and evidence; the regression knows the picture's score.
        score = float(scores[best])
        facts, found = closer_features(score, score, score, eye.close_up(image, box), box, target)
        looks.append({"facts": facts[2:].tolist(), "right": bool(goal[cell_of(found, grid)])})
        examined = torch.stack([box, found])
        scores = scores.masked_fill(box_iou(boxes, examined).amax(-1) >= SAME_OBJECT_IOU, 0)
    return looks


def plain_rules(records: Sequence[ResultRecord]) -> dict[str, PlainDecisions]:
    """Judge searches by each plain rule.

    The probabilities are logistic regressions of the highest score in the whole photograph, with those of the look
    that shows the place best; for quarters, of the highest score with them. Each part of the scenes is judged with
    regressions that are fitted to the others.

    Args:
        records: the M searches of one way to search.

    Returns:
        What each rule says, by its name; nothing for a run without plain rules.
    """
    if records[0]["plain"] is None:
        return {}
    fold = _folds_by_scene(records)
    there = torch.tensor([record["present"] for record in records])
    whole = _logits([record["sharp"] for record in records])
    rules = {}
    for name, most in PLAIN.items():
        if name == _QUARTERS:
            tiled = _logits([record["tiled"] for record in records])
            rules[name] = _without_places(torch.cat([whole, tiled], 1), there, fold, passes=5)
        else:
            looks = [record["plain"][:most] for record in records]
            rules[name] = _with_closer_looks(whole, looks, there, fold)
    return rules


def _without_places(facts: Tensor, there: Tensor, fold: Tensor, passes: int) -> PlainDecisions:
    """Judge presence from facts `(M, n)`, and report no place."""
    nothing = torch.zeros(len(there))
    return PlainDecisions(_in_folds(facts, there, fold), nothing, nothing.bool(), torch.full_like(nothing, passes))


def _with_closer_looks(
    whole: Tensor, looks: Sequence[Sequence[ResultRecord]], there: Tensor, fold: Tensor
) -> PlainDecisions:
    """Judge places from closer looks, and presence from the most probable place.

    Args:
        whole: `(M, 1)`, logit of the highest score in the whole photograph.
        looks: the closer looks of each search (`plain_looks`); some searches have none.
        there: `(M,)`, whether the target is there.
        fold: `(M,)`, number of the part of the scenes.
    """
    count = len(looks)
    numbers = torch.tensor([len(of_search) for of_search in looks])
    all_looks = [*chain.from_iterable(looks)]
    if not all_looks:  # none was asked for, or no search has a place to look at
        return _without_places(whole, there, fold, passes=1)
    search = torch.arange(count).repeat_interleave(numbers)  # (L,), the search of each look
    facts = torch.tensor([look["facts"] for look in all_looks], dtype=torch.float64)  # (L, n)
    on_target = torch.tensor([look["right"] for look in all_looks])  # (L,)
    chance = _in_folds(torch.cat([whole[search], facts], 1), on_target, fold[search])  # (L,)

    place = torch.zeros(count)
    right = torch.zeros(count, dtype=torch.bool)
    # A search without a look has the lowest fact of all looks.
    best_facts = facts.new_full((count, facts.shape[1]), float(facts.min()))
    for look, number in enumerate(search.tolist()):
        if chance[look] > place[number]:
            place[number] = chance[look]
            right[number] = on_target[look]
            best_facts[number] = facts[look]
    presence = _in_folds(torch.cat([whole, best_facts], 1), there, fold)
    return PlainDecisions(presence, place, right, 1.0 + numbers)


def _folds_by_scene(records: Sequence[ResultRecord]) -> Tensor:
    """Assign folds by number, `(M,)`, so that all searches of a scene are in one."""
    scenes = list(dict.fromkeys(record["scene"] for record in records))
    fold_of = {scene: number % _FOLDS for number, scene in enumerate(scenes)}
    return torch.tensor([fold_of[record["scene"]] for record in records])


def _logits(scores: Sequence[float]) -> Tensor:
    """Compute the logits of M scores as facts, `(M, 1)`."""
    return torch.tensor(scores, dtype=torch.float64).logit(_LOWEST)[:, None]


def _in_folds(facts: Tensor, there: Tensor, fold: Tensor) -> Tensor:
    """Compute probabilities by logistic regressions that are fitted to the other folds.

    Args:
        facts: `(M, n)`.
        there: `(M,)` boolean, the outcomes.
        fold: `(M,)`, number of the fold.

    Returns:
        The probabilities, `(M,)`.
    """
    chance = torch.zeros(len(facts))
    for number in fold.unique().tolist():
        inside = fold == number
        offset, *weights = logistic_regression(facts[~inside], there[~inside])
        chance[inside] = (facts[inside] @ facts.new_tensor(weights) + offset).sigmoid().float()
    return chance
