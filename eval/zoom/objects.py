"""How far the objects that an exploration returns can be believed: average precision, and what the default shows."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from eval.bootstrap import Bootstrap
from semfov.agents.windows import LIKELY
from semfov.data.scene import Annotation
from semfov.detection.objects import Objects
from semfov.metrics.calibration import BinarySums
from semfov.runs.results import ResultRecord
from semfov.runs.tables import table
from semfov.runs.window_looking import right_boxes
from semfov.zoom.certainty import Certainty
from semfov.zoom.glances import Glance
from semfov.zoom.lattice import Lattice
from semfov.zoom.objects import merge, probable_objects

AFTER = (1, 4, 8, 12, 16, 24)
"""Numbers of passes after which objects are compared with the annotated ones."""

_RECALLS = 101


def object_record(
    way: str,
    looks: Sequence[Glance],
    lattice: Lattice,
    target: int | None,
    annotation: Annotation,
    passes: int,
    certainty: Certainty | None,
    ahead: Sequence[tuple[tuple[float, float], float]] = (),
) -> ResultRecord:
    """Compare the objects after some numbers of passes with the annotated ones.

    Args:
        way: name of the way of looking.
        looks: the looks.
        lattice: lattice of the picture.
        target: class whose objects are looked for, 1..K; None for all classes.
        annotation: the annotated objects.
        passes: largest number of passes.
        certainty: gives objects probabilities; None leaves them the detector's scores.
        ahead: after each look, the numbers of objects that further looks are expected to find (`ZoomBelief.remaining`),
            and the number that the looks after the first were expected to find.

    Returns:
        The record: for each number of passes the scores of the objects, which of them are right, and the number of
        objects that are expected in all, or None without `ahead`. Objects in areas that are annotated as crowds are
        left out.
    """
    after = {}
    for number in sorted({n for n in AFTER if n < passes} | {passes}):
        objects: Objects
        unseen: float | None = None
        if certainty is None:
            objects = merge(looks[:number], target)
        else:
            remaining, promised = ahead[min(number, len(looks)) - 1] if ahead else ((0.0, 0.0), 0.0)
            objects, (unseen, _) = probable_objects(
                looks[:number], lattice, target, certainty, remaining=remaining, promised=promised
            )
        right = right_boxes(objects, annotation)
        counts = right >= 0
        in_all = None if unseen is None else float(objects.scores[counts].sum()) + unseen
        after[str(number)] = {
            "scores": objects.scores[counts].tolist(),
            "right": right[counts].tolist(),
            "in all": in_all,
        }
    single = len(annotation.boxes) - int(annotation.crowd.sum())
    return {"measure": "objects", "way": way, "objects": single, "after": after}


def average_precision(scores: Tensor, right: Tensor, objects: int) -> float:
    """Average precision as COCO computes it: the mean over 101 recalls of the highest precision at that recall or more.

    Args:
        scores: `(N,)`, scores of boxes.
        right: `(N,)`, whether each of them is right.
        objects: number of annotated objects.

    Returns:
        The average precision, from 0 to 1; NaN without objects.

    >>> average_precision(torch.tensor([0.9, 0.8]), torch.tensor([True, False]), 2)
    0.504950...
    """
    if not objects:
        return torch.nan
    hits = right[scores.argsort(descending=True, stable=True)].double().cumsum(0)
    precision = hits / torch.arange(1, len(hits) + 1)
    precision = precision.flip(0).cummax(0).values.flip(0) if len(hits) else precision
    at = torch.searchsorted(hits / objects, torch.linspace(0, 1, _RECALLS, dtype=torch.float64) - 1e-9)
    return float(torch.cat([precision, precision.new_zeros(1)])[at.clamp(max=len(hits))].mean())


def object_figures(groups: dict[str, list[ResultRecord]], numbers: Sequence[str], pictures: Tensor) -> Tensor:
    """Figures of each way of looking at some pictures.

    Args:
        groups: for each way, a record of each picture.
        numbers: numbers of passes.
        pictures: indices of the pictures, some of them repeated.

    Returns:
        `(ways, len(numbers) + 6)`, float64: the average precision after each number of passes, and after the last one,
        of the objects from 0.5 on, precision, recall, number for each annotated object, and the mean absolute error of
        their number in a picture; then that of the sum of all scores, and the expected calibration error of the scores.
    """
    rows = []
    for group in groups.values():
        chosen = [group[picture] for picture in pictures.tolist()]
        total = sum(record["objects"] for record in chosen)
        line = []
        for number in numbers:
            after = [record["after"][number] for record in chosen]
            scores = torch.cat([torch.as_tensor(each["scores"], dtype=torch.float64) for each in after])
            right = torch.cat([torch.as_tensor(each["right"]) for each in after]) > 0
            line.append(average_precision(scores, right, total))
        sure = scores >= LIKELY
        hits = float(right[sure].sum())
        pairs = [(torch.as_tensor(record["after"][number]["scores"]), record["objects"]) for record in chosen]
        off = [float(((each >= LIKELY).sum() - count).abs()) for each, count in pairs]
        apart = [float((each.sum() - count).abs()) for each, count in pairs]
        line += [hits / max(int(sure.sum()), 1), hits / max(total, 1), int(sure.sum()) / max(total, 1)]
        line += [sum(off) / len(off), sum(apart) / len(apart), BinarySums.of(scores, right).ece if len(scores) else 0]
        rows.append(line)
    return torch.tensor(rows, dtype=torch.float64)


def object_table(records: Sequence[ResultRecord]) -> list[str]:
    """Table of the figures of all ways, as Markdown."""
    groups: dict[str, list[ResultRecord]] = {}
    for record in records:
        # The bootstrap reads the numbers many times.
        after = {
            n: {name: torch.tensor(outcome[name]) for name in ("scores", "right")}
            for n, outcome in record["after"].items()
        }
        groups.setdefault(record["way"], []).append(record | {"after": after})
    first = next(iter(groups.values()))
    numbers = list(first[0]["after"])
    figures = Bootstrap.of(partial(object_figures, groups, numbers), range(len(first)))
    heads = [f"AP50, {number}" for number in numbers]
    heads += ["precision", "recall", "boxes for each object"]
    heads += [f"mean absolute error of the {number}" for number in ("count", "expected number")] + ["ECE"]
    rows = [["", *heads]]
    for way, value, error in zip(groups, figures.value.tolist(), figures.error.tolist(), strict=True):
        rows.append([way, *(f"{each:.3f} ± {apart:.3f}" for each, apart in zip(value, error, strict=True))])
    objects = sum(record["objects"] for record in first)
    return [
        f"Objects of {len(first)} pictures with {objects} annotated ones: average precision (IoU 0.5) after n passes; "
        f"after {numbers[-1]} passes, of the objects from {LIKELY} on, precision, recall, their number for each "
        "annotated object, and the mean absolute error of their number in a picture; that of the sum of all scores; "
        "and the expected calibration error of the scores. ± is the standard error by bootstrap over pictures.",
        "",
        *table(rows),
        "",
        *in_all_table(records, numbers),
    ]


def in_all_table(records: Sequence[ResultRecord], numbers: Sequence[str]) -> list[str]:
    """Table of the number of objects that are expected in all after numbers of passes, as Markdown."""
    rows = [["", *numbers]]
    expecting = [record for record in records if record["after"][numbers[0]].get("in all") is not None]
    if not expecting:
        return []
    expected = torch.tensor(
        [[record["after"][n]["in all"] for n in numbers] for record in expecting], dtype=torch.float64
    )
    true = torch.tensor([[record["objects"]] for record in expecting], dtype=torch.float64)
    rows.append(["expected in all", *(f"{each:.1f}" for each in expected.mean(0).tolist())])
    rows.append(["off by", *(f"{each:.1f}" for each in (expected - true).abs().mean(0).tolist())])
    return [
        f"The number of objects that semfov expects in all after n passes, those that no look has shown included: the "
        f"mean over pictures, and the mean absolute error. There are {float(true.mean()):.1f} in the mean.",
        "",
        *table(rows),
        "",
    ]
