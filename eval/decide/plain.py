"""Plain rules for presence and place: one unfoveated pass, closer looks at its best places, and quarters."""

from __future__ import annotations

from collections.abc import Sequence

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

PLAIN = {
    "one unfoveated pass": 0,
    "one unfoveated pass, one closer look": 1,
    "one unfoveated pass, two closer looks": 2,
    "one unfoveated pass, four quarters": 0,
}
"""Names of the plain rules, with their numbers of closer looks."""

_FOLDS = 5
_LOWEST = 1e-4


def plain_looks(
    eye: Eye, image: Tensor, whole: Detections, target: int, grid: Grid, goal: Tensor, most: int = 2
) -> list[ResultRecord]:
    """Closer looks at the best detections of the target that do not overlap by half, with facts and right places."""
    boxes, scores = whole.boxes[0], whole.scores[0, :, target] * whole.mask[0]
    looks: list[ResultRecord] = []
    while len(looks) < most and len(scores) and float(scores.max()) > 0:
        place = int(scores.argmax())
        score, box = float(scores[place]), boxes[place]
        facts, found = closer_features(score, score, score, eye.close_up(image, box), box, target)
        looks.append({"facts": facts[2:].tolist(), "right": bool(goal[cell_of(found, grid)])})
        scores = scores.masked_fill(box_iou(boxes, torch.stack([box, found])).amax(-1) >= SAME_OBJECT_IOU, 0)
    return looks


def plain_rules(records: Sequence[ResultRecord]) -> dict[str, tuple[Tensor, Tensor, Tensor, Tensor]]:
    """List the plain rules by name: probabilities of presence and of the place, right places, and passes, each `(M,)`.

    The probabilities are logistic regressions of the highest score in the whole photograph, with those of the look
    that shows the place best; for quarters, of the highest score with them. Each part of the scenes is judged with
    regressions that are fitted to the others.
    """
    scenes = {scene: number for number, scene in enumerate(dict.fromkeys(record["scene"] for record in records))}
    fold = torch.tensor([scenes[record["scene"]] % _FOLDS for record in records])
    there = torch.tensor([record["present"] for record in records])
    whole = torch.tensor([record["sharp"] for record in records], dtype=torch.float64).logit(_LOWEST)[:, None]
    rules = {}
    for name, most in PLAIN.items():
        if name.endswith("quarters"):
            tiled = torch.tensor([record["tiled"] for record in records], dtype=torch.float64).logit(_LOWEST)
            presence = _in_folds(torch.cat([whole, tiled[:, None]], 1), there, fold)
            nothing = torch.zeros(len(records))
            rules[name] = presence, nothing, nothing.bool(), torch.full_like(nothing, 5)
            continue
        made = [record["plain"][:most] for record in records]
        rows = [(number, look) for number, looks in enumerate(made) for look in looks]
        place, right, best = torch.zeros(len(records)), torch.zeros(len(records)).bool(), whole
        if rows:
            index = torch.tensor([number for number, _ in rows])
            facts = torch.tensor([look["facts"] for _, look in rows], dtype=torch.float64)
            correct = torch.tensor([look["right"] for _, look in rows])
            chance = _in_folds(torch.cat([whole[index], facts], 1), correct, fold[index])
            best = torch.cat([whole, torch.full((len(records), facts.shape[1]), facts.min().item()).double()], 1)
            for row in range(len(rows)):
                number = int(index[row])
                if chance[row] > place[number]:
                    place[number], right[number], best[number, 1:] = chance[row], correct[row], facts[row]
        passes = torch.tensor([1.0 + len(looks) for looks in made])
        rules[name] = _in_folds(best, there, fold), place, right, passes
    return rules


def _in_folds(facts: Tensor, there: Tensor, fold: Tensor) -> Tensor:
    """Probabilities by logistic regressions that are fitted to the other folds; facts `(M, n)`, the others `(M,)`."""
    chance = torch.zeros(len(facts))
    for number in fold.unique().tolist():
        offset, *weights = logistic_regression(facts[fold != number], there[fold != number])
        mine = fold == number
        chance[mine] = (facts[mine] @ facts.new_tensor(weights) + offset).sigmoid().float()
    return chance
