"""How far the objects that an exploration returns can be believed: average precision, and what the default shows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from eval.bootstrap import Bootstrap
from semfov.agents.window_episode import LIKELY
from semfov.data.scene import Annotation
from semfov.detection.detections import Detections
from semfov.detection.objects import Objects
from semfov.detection.selection import Selection, suppress
from semfov.metrics.calibration import BinarySums
from semfov.observation.matching import box_iou, right_boxes
from semfov.paths import ZoomPath
from semfov.runs.results import ResultRecord
from semfov.runs.tables import table
from semfov.zoom.certainty import SPREAD, number_of, number_of_faint
from semfov.zoom.looks import WindowLook
from semfov.zoom.objects import merge

RASTER, SEMFOV = "slices, raster", "semfov"
"""Names of slices in raster order, and of the agent."""

AFTER = (1, 2, 4, 8, 12, 16, 24)
"""Numbers of passes after which objects are compared with the annotated ones."""

_RECALLS = 101
_SAME = 0.5


class Returned(NamedTuple):
    """All objects, those that are listed, and the number that was not seen, if known, with the spread of all.

    `given` tells whether a number of objects in all is given, and `faint` whether it is that of a class to which the
    detector hardly reacts.
    """

    objects: Objects
    listed: Objects
    unseen: tuple[float, float] | None = None
    spread: float = SPREAD
    given: bool = False
    faint: bool = False


def expected_of(path: ZoomPath) -> Returned:
    """Take the objects of a search or an exploration, and what it says of their number in all."""
    given = any(not math.isnan(number) for number in path.expected.values())
    return Returned(path.candidates, path.objects, path.unseen, path.spread, given, given and not path.reacts)


def merged(looks: Sequence[WindowLook], target: int | None) -> Returned:
    """Return the objects of looks by the scores of the detector (`semfov.zoom.objects.merge`)."""
    objects = merge(looks, target)
    return Returned(objects, objects.above(LIKELY))


def suppressed(looks: Sequence[WindowLook], target: int | None) -> Returned:
    """Return the objects of looks by plain suppression: boxes that a border cuts go, of those alike one stays."""
    boxes, scores = (
        torch.cat([each[0, ~look.cut] for look, each in zip(looks, column, strict=True)])
        for column in zip(*((look.detections.boxes, look.detections.scores) for look in looks), strict=True)
    )
    value, label = scores[:, 1:].max(-1)
    if target is not None:
        value, label = scores[:, target], torch.full_like(label, target - 1)
    kept = suppress(boxes, value, label, Selection(threshold=0.0, iou=0.5, limit=10_000, per_class=True))
    objects = Objects(boxes[kept], value[kept], label[kept] + 1, torch.zeros_like(kept))
    return Returned(objects, objects.above(LIKELY))


def sure_boxes(detections: Detections, target: int | None) -> Objects:
    """Return what a plain pass of the detector shows from 0.5 on."""
    boxes, scores, labels = detections.boxes[0], detections.confidence[0], detections.labels[0]
    kept = detections.mask[0] & (scores >= LIKELY) & (labels == (labels if target is None else target))
    return Objects(boxes[kept], scores[kept], labels[kept], torch.zeros_like(labels[kept]))


def object_record(way: str, returned: Mapping[int, Returned], annotation: Annotation, plain: Objects) -> ResultRecord:
    """Compare the objects after some numbers of passes with the annotated ones, and with those of a plain pass.

    Args:
        way: name of the way of looking.
        returned: what it returns, by number of passes.
        annotation: the annotated objects.
        plain: what a plain pass of the detector shows (`sure_boxes`).

    Returns:
        The record: for each number of passes scores and classes of the objects, which of them are right, how many are
        listed, how many of those are right, how many of the plain pass are among them, and where it is known the number
        of objects that are expected in all, with its standard deviation. Objects in areas that are annotated as crowds
        are left out.
    """
    after = {}
    for number, (objects, listed, unseen, spread, given, faint) in returned.items():
        right, sure = right_boxes(objects, annotation), right_boxes(listed, annotation)
        counts = right >= 0
        chances = objects.scores[counts]
        mean, variance = number_of_faint(chances) if faint else number_of(chances, unseen or (0.0, 0.0), spread)
        alike = (box_iou(plain.boxes, listed.boxes) >= _SAME) & (plain.labels[:, None] == listed.labels)
        after[str(number)] = {
            "scores": chances.tolist(),
            "labels": objects.labels[counts].tolist(),
            "right": right[counts].tolist(),
            "listed": int((sure >= 0).sum()),
            "listed right": int((sure > 0).sum()),
            "kept": int(alike.any(1).sum()) if len(listed) else 0,
            "in all": None if unseen is None else mean,
            "error": None if unseen is None else variance**0.5,
            "given": given,
        }
    labels = annotation.labels[~annotation.crowd]
    counted = {str(label): int((labels == label).sum()) for label in labels.unique().tolist()}
    return {
        "measure": "objects",
        "way": way,
        "objects": len(labels),
        "by class": counted,
        "plain": len(plain),
        "after": after,
    }


def average_precision(scores: Tensor, right: Tensor, objects: int, counts: Tensor | None = None) -> float:
    """Average precision as COCO computes it: the mean over 101 recalls of the highest precision at that recall or more.

    Args:
        scores: `(N,)`, scores of boxes.
        right: `(N,)`, whether each of them is right.
        objects: number of annotated objects.
        counts: `(N,)`, how often each box counts; None for once.

    Returns:
        The average precision, from 0 to 1; NaN without objects.

    >>> average_precision(torch.tensor([0.9, 0.8]), torch.tensor([True, False]), 2)
    0.504950...
    """
    if not objects:
        return torch.nan
    order = scores.argsort(descending=True, stable=True)
    each = torch.ones(len(order)).double() if counts is None else counts[order].double()
    hits = (right[order] * each).cumsum(0)
    precision = hits / each.cumsum(0).clamp(min=1)
    precision = precision.flip(0).cummax(0).values.flip(0) if len(hits) else precision
    at = torch.searchsorted(hits / objects, torch.linspace(0, 1, _RECALLS, dtype=torch.float64) - 1e-9)
    return float(torch.cat([precision, precision.new_zeros(1)])[at.clamp(max=len(hits))].mean())


class _Boxes(NamedTuple):
    """All boxes of a way of looking after a number of passes, the best first, with their pictures; each `(N,)`."""

    scores: Tensor
    labels: Tensor
    right: Tensor
    pictures: Tensor

    @classmethod
    def of(cls, group: Sequence[ResultRecord], number: str) -> Self:
        """Return the boxes of the records of all pictures."""
        after = [record["after"][number] for record in group]
        scores, labels, right = (
            torch.tensor([value for each in after for value in each[name]]) for name in ("scores", "labels", "right")
        )
        pictures = torch.arange(len(after)).repeat_interleave(torch.tensor([len(each["scores"]) for each in after]))
        order = scores.argsort(descending=True, stable=True)
        return cls(scores.double()[order], labels.long()[order], right[order] > 0, pictures[order])


def object_figures(groups: dict[str, list[ResultRecord]], numbers: Sequence[str]) -> Callable[[Tensor], Tensor]:
    """Figures of each way of looking at some pictures.

    Args:
        groups: for each way, a record of each picture.
        numbers: numbers of passes.

    Returns:
        A function of the indices of the pictures, some of them repeated → `(ways, len(numbers) + 6)`, float64: the
        average precision after each number of passes, and after the last one, of the objects that are listed,
        precision, recall, number for each annotated object, and the mean absolute error of their number in a picture;
        then that of the sum of all scores, and the expected calibration error of the scores.
    """
    boxes = {way: [_Boxes.of(group, number) for number in numbers] for way, group in groups.items()}
    counts = {
        way: torch.tensor(
            [
                [last["listed"], last["listed right"], sum(last["scores"]), record["objects"]]
                for record in group
                for last in [record["after"][numbers[-1]]]
            ],
            dtype=torch.float64,
        )
        for way, group in groups.items()
    }

    def figures(pictures: Tensor) -> Tensor:
        rows = []
        for way, some in boxes.items():
            drawn = counts[way][pictures]
            listed, hits, _, total = drawn.sum(0).tolist()
            weight = pictures.bincount(minlength=len(counts[way]))
            line = [average_precision(each.scores, each.right, int(total), weight[each.pictures]) for each in some]
            off, apart = ((drawn[:, column] - drawn[:, 3]).abs().mean().item() for column in (0, 2))
            line += [hits / max(listed, 1), hits / max(total, 1), listed / max(total, 1), off, apart]
            last = some[-1]
            repeated = torch.arange(len(last.scores)).repeat_interleave(weight[last.pictures])
            line.append(BinarySums.of(last.scores[repeated], last.right[repeated]).ece if len(repeated) else 0)
            rows.append(line)
        return torch.tensor(rows, dtype=torch.float64)

    return figures


def object_table(records: Sequence[ResultRecord]) -> list[str]:
    """Table of the figures of all ways, as Markdown."""
    groups: dict[str, list[ResultRecord]] = {}
    for record in records:
        groups.setdefault(record["way"], []).append(record)
    first = next(iter(groups.values()))
    numbers = list(first[0]["after"])
    figures = Bootstrap.of(object_figures(groups, numbers), range(len(first)))
    heads = [f"AP50, {number}" for number in numbers]
    heads += ["precision", "recall", "boxes for each object"]
    heads += [f"mean absolute error of the {number}" for number in ("count", "expected number")] + ["ECE"]
    rows = [["", *heads]]
    for way, value, error in zip(groups, figures.value.tolist(), figures.error.tolist(), strict=True):
        rows.append([way, *(f"{each:.3f} ± {apart:.3f}" for each, apart in zip(value, error, strict=True))])
    apart = figures.less(list(groups).index(SEMFOV))
    less = [[f"difference to {SEMFOV}", *heads]]
    for way, value, error in zip(groups, apart.value.tolist(), apart.error.tolist(), strict=True):
        cells = [f"{each:+.3f} ± {spread:.3f}" for each, spread in zip(value, error, strict=True)]
        less += [[way, *cells]] if way != SEMFOV else []
    objects = sum(record["objects"] for record in first)
    return [
        f"Objects of {len(first)} pictures with {objects} annotated ones: average precision (IoU 0.5) after n passes; "
        f"after {numbers[-1]} passes, of the objects that are listed, precision, recall, their number for "
        "each annotated object, and the mean absolute error of their number in a picture; that of the sum of all "
        "scores; and the expected calibration error of the scores. ± is the standard error by bootstrap over pictures; "
        "differences are paired.",
        "",
        *table(rows),
        "",
        *table(less),
        "",
        *plain_table(groups, numbers),
        *in_all_table(records, numbers),
    ]


def plain_table(groups: Mapping[str, Sequence[ResultRecord]], numbers: Sequence[str]) -> list[str]:
    """Table of the mean of AP50 over the classes, and of what is kept of a plain pass, as Markdown."""
    rows = [["", *(f"AP50, {number}" for number in numbers), "kept", "pictures without"]]
    for way, group in groups.items():
        last, shown = [record["after"][numbers[-1]] for record in group], [record["plain"] for record in group]
        kept = f"{sum(after['kept'] for after in last) / sum(shown):.3f}" if sum(shown) else "-"
        without = sum(count > 0 and not after["listed"] for count, after in zip(shown, last, strict=True))
        means = [class_mean(group, number) for number in numbers]
        rows.append([way, *(f"{mean:.3f}" for mean in means), kept, str(without)])
    return [
        f"The mean of AP50 over the classes that are annotated; the share of the {sum(shown)} boxes that one plain "
        f"pass of the detector shows from {LIKELY} on of which a listed object has the class and an IoU of "
        f"{_SAME}, after {numbers[-1]} passes; and the pictures in which it shows some and nothing is listed.",
        "",
        *table(rows),
        "",
    ]


def class_mean(group: Sequence[ResultRecord], number: str) -> float:
    """Mean over the annotated classes of the average precision after a number of passes."""
    boxes, totals = _Boxes.of(group, number), Counter[int]()
    for record in group:
        totals.update({int(label): count for label, count in record["by class"].items()})
    of_class = {label: boxes.labels == label for label in totals}
    each = [average_precision(boxes.scores[mine], boxes.right[mine], totals[label]) for label, mine in of_class.items()]
    return sum(each) / max(len(each), 1)


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
    off = (expected - true).abs()
    rows.append(["off by", *(f"{each:.1f}" for each in off.mean(0).tolist())])
    error = torch.tensor([[record["after"][n]["error"] for n in numbers] for record in expecting], dtype=torch.float64)
    rows.append(["its error", *(f"{each:.1f}" for each in error.mean(0).tolist())])
    rows.append(["within two errors", *(f"{each:.2f}" for each in (off <= 2 * error).double().mean(0).tolist())])
    rows.append(["number given", *(f"{sum(r['after'][n]['given'] for r in expecting)}" for n in numbers)])
    return [
        f"The number of objects that semfov expects in all after n passes, those that no look has shown included: the "
        f"mean over pictures, the mean absolute error, the error that it is given with, the share of the pictures in "
        f"which it is off by at most twice that, and the pictures in which a number is given. There are "
        f"{float(true.mean()):.1f} in the mean.",
        "",
        *table(rows),
        "",
    ]
