"""How far the objects that an exploration returns can be believed: average precision, and what the default shows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from eval.bootstrap import Bootstrap
from eval.comparison.records import grouped
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
    boxes = torch.cat([look.detections.boxes[0, ~look.cut] for look in looks])
    scores = torch.cat([look.detections.scores[0, ~look.cut] for look in looks])
    value, label = scores[:, 1:].max(-1)
    if target is not None:
        value = scores[:, target]
        label = torch.full_like(label, target - 1)
    kept = suppress(boxes, value, label, Selection(threshold=0.0, iou=0.5, limit=10_000, per_class=True))
    objects = Objects(boxes[kept], value[kept], label[kept] + 1, torch.zeros_like(kept))
    return Returned(objects, objects.above(LIKELY))


def sure_boxes(detections: Detections, target: int | None) -> Objects:
    """Return what a plain pass of the detector shows from 0.5 on."""
    boxes = detections.boxes[0]
    scores = detections.confidence[0]
    labels = detections.labels[0]
    kept = detections.mask[0] & (scores >= LIKELY)
    if target is not None:
        kept &= labels == target
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
    for number, returned_then in returned.items():
        after[str(number)] = _compared(returned_then, annotation, plain)
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


def _compared(returned: Returned, annotation: Annotation, plain: Objects) -> ResultRecord:
    """Compare what is returned after a number of passes with annotated objects and a plain pass (`object_record`)."""
    objects, listed, unseen, spread, given, faint = returned
    # 1 for a right box, 0 for a wrong one, and -1 for one in an area that is annotated as a crowd.
    right = right_boxes(objects, annotation)
    right_listed = right_boxes(listed, annotation)
    counts = right >= 0
    chances = objects.scores[counts]
    mean, variance = number_of_faint(chances) if faint else number_of(chances, unseen or (0.0, 0.0), spread)
    alike = (box_iou(plain.boxes, listed.boxes) >= _SAME) & (plain.labels[:, None] == listed.labels)
    return {
        "scores": chances.tolist(),
        "labels": objects.labels[counts].tolist(),
        "right": right[counts].tolist(),
        "listed": int((right_listed >= 0).sum()),
        "listed right": int((right_listed > 0).sum()),
        "kept": int(alike.any(1).sum()) if len(listed) else 0,
        "in all": None if unseen is None else mean,
        "error": None if unseen is None else variance**0.5,
        "given": given,
    }


def average_precision(scores: Tensor, right: Tensor, objects: int, counts: Tensor | None = None) -> float:
    """Compute average precision as COCO does: over 101 recalls, the mean of the highest precision there or beyond.

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
    repeats = torch.ones(len(order)).double() if counts is None else counts[order].double()
    hits = (right[order] * repeats).cumsum(0)
    precision = hits / repeats.cumsum(0).clamp(min=1)
    if len(hits):
        precision = precision.flip(0).cummax(0).values.flip(0)  # the highest at this recall or more
    recalls = torch.linspace(0, 1, _RECALLS, dtype=torch.float64)
    first_box = torch.searchsorted(hits / objects, recalls - 1e-9)  # with which each recall is reached
    reached = torch.cat([precision, precision.new_zeros(1)])  # 0 for recalls that no box reaches
    return float(reached[first_box.clamp(max=len(hits))].mean())


class _Boxes(NamedTuple):
    """All boxes of a way of looking after a number of passes, the best first.

    Attributes:
        scores: `(N,)`.
        labels: `(N,)`, their classes.
        right: `(N,)`, whether each shows an object.
        pictures: `(N,)`, the picture that each is in.
    """

    scores: Tensor
    labels: Tensor
    right: Tensor
    pictures: Tensor

    @classmethod
    def of(cls, group: Sequence[ResultRecord], number: str) -> Self:
        """Join the boxes of the records of all pictures."""
        scores: list[float] = []
        labels: list[int] = []
        right: list[int] = []
        pictures: list[int] = []
        for picture, record in enumerate(group):
            after = record["after"][number]
            scores += after["scores"]
            labels += after["labels"]
            right += after["right"]
            pictures += [picture] * len(after["scores"])
        # Scores are compared in single precision, as the detector gives them.
        single = torch.tensor(scores)
        order = single.argsort(descending=True, stable=True)
        is_right = torch.tensor(right)[order] > 0
        return cls(
            single.double()[order], torch.tensor(labels).long()[order], is_right, torch.tensor(pictures).long()[order]
        )


class _Counts(NamedTuple):
    """Numbers of objects in each picture after the last pass, `(P,)`, float64.

    Attributes:
        listed: objects that are listed.
        right: those of them that are right.
        expected: sum of the scores of all objects.
        annotated: objects that are there.
    """

    listed: Tensor
    right: Tensor
    expected: Tensor
    annotated: Tensor

    @classmethod
    def of(cls, group: Sequence[ResultRecord], last: str) -> Self:
        """Read the numbers from the records of all pictures."""
        rows = []
        for record in group:
            after = record["after"][last]
            rows.append([after["listed"], after["listed right"], sum(after["scores"]), record["objects"]])
        return cls(*torch.tensor(rows, dtype=torch.float64).unbind(1))


def object_figures(groups: dict[str, list[ResultRecord]], numbers: Sequence[str]) -> Callable[[Tensor], Tensor]:
    """Prepare the figures of each way of looking at some pictures.

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
    counts = {way: _Counts.of(group, numbers[-1]) for way, group in groups.items()}

    def figures(pictures: Tensor) -> Tensor:
        rows = [_figures(boxes[way], counts[way], pictures) for way in groups]
        return torch.tensor(rows, dtype=torch.float64)

    return figures


def _figures(boxes: Sequence[_Boxes], counts: _Counts, pictures: Tensor) -> list[float]:
    """Compute the figures of one way of looking (`object_figures`).

    Args:
        boxes: its boxes after each number of passes.
        counts: its numbers of objects after the last.
        pictures: indices of the pictures, some of them repeated.
    """
    repeats = pictures.bincount(minlength=len(counts.listed))  # how often each picture counts
    drawn = _Counts(*(column[pictures] for column in counts))
    listed = float(drawn.listed.sum())
    hits = float(drawn.right.sum())
    annotated = float(drawn.annotated.sum())
    figures = [average_precision(b.scores, b.right, int(annotated), repeats[b.pictures]) for b in boxes]
    figures += [hits / max(listed, 1), hits / max(annotated, 1), listed / max(annotated, 1)]
    figures.append(float((drawn.listed - drawn.annotated).abs().mean()))
    figures.append(float((drawn.expected - drawn.annotated).abs().mean()))
    last = boxes[-1]
    repeated = torch.arange(len(last.scores)).repeat_interleave(repeats[last.pictures])
    figures.append(BinarySums.of(last.scores[repeated], last.right[repeated]).ece if len(repeated) else 0)
    return figures


def object_table(records: Sequence[ResultRecord]) -> list[str]:
    """Write the tables of the figures of all ways, as Markdown."""
    groups = grouped(records, "way")
    first = next(iter(groups.values()))
    numbers = list(first[0]["after"])
    figures = Bootstrap.of(object_figures(groups, numbers), range(len(first)))
    heads = [f"AP50, {number}" for number in numbers]
    heads += ["precision", "recall", "boxes for each object"]
    heads += ["mean absolute error of the count", "mean absolute error of the expected number", "ECE"]
    ways = list(groups)
    rows = [["", *heads]]
    rows += [[way, *figures.cells(number)] for number, way in enumerate(ways)]
    paired = figures.less(ways.index(SEMFOV))
    differences = [[f"difference to {SEMFOV}", *heads]]
    differences += [[way, *paired.cells(number, sign="+")] for number, way in enumerate(ways) if way != SEMFOV]
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
        *table(differences),
        "",
        *plain_table(groups, numbers),
        *in_all_table(records, numbers),
    ]


def plain_table(groups: Mapping[str, Sequence[ResultRecord]], numbers: Sequence[str]) -> list[str]:
    """Write the table of the mean of AP50 over the classes, and of what is kept of a plain pass, as Markdown."""
    first = next(iter(groups.values()))
    shown = sum(record["plain"] for record in first)  # a plain pass shows the same, whatever the way
    rows = [["", *(f"AP50, {number}" for number in numbers), "kept", "pictures without"]]
    for way, group in groups.items():
        means = [f"{class_mean(group, number):.3f}" for number in numbers]
        kept = sum(record["after"][numbers[-1]]["kept"] for record in group)
        without = sum(record["plain"] > 0 and not record["after"][numbers[-1]]["listed"] for record in group)
        rows.append([way, *means, f"{kept / shown:.3f}" if shown else "-", str(without)])
    return [
        f"The mean of AP50 over the classes that are annotated; the share of the {shown} boxes that one plain "
        f"pass of the detector shows from {LIKELY} on of which a listed object has the class and an IoU of "
        f"{_SAME}, after {numbers[-1]} passes; and the pictures in which it shows some and nothing is listed.",
        "",
        *table(rows),
        "",
    ]


def class_mean(group: Sequence[ResultRecord], number: str) -> float:
    """Average the average precision after a number of passes over the annotated classes."""
    boxes = _Boxes.of(group, number)
    objects = Counter[int]()
    for record in group:
        objects.update({int(label): count for label, count in record["by class"].items()})
    precisions = []
    for label, count in objects.items():
        of_class = boxes.labels == label
        precisions.append(average_precision(boxes.scores[of_class], boxes.right[of_class], count))
    return sum(precisions) / max(len(precisions), 1)


def in_all_table(records: Sequence[ResultRecord], numbers: Sequence[str]) -> list[str]:
    """Write the table of the number of objects that are expected in all after numbers of passes, as Markdown."""
    expecting = [record for record in records if record["after"][numbers[0]].get("in all") is not None]
    if not expecting:
        return []

    def after_passes(name: str) -> Tensor:
        """Read a value of each picture after each number of passes, `(P, len(numbers))`."""
        values = [[record["after"][number][name] for number in numbers] for record in expecting]
        return torch.tensor(values, dtype=torch.float64)

    expected = after_passes("in all")
    error = after_passes("error")
    true = torch.tensor([[record["objects"]] for record in expecting], dtype=torch.float64)
    off = (expected - true).abs()
    within = (off <= 2 * error).double()
    rows = [
        ["", *numbers],
        ["expected in all", *(f"{mean:.1f}" for mean in expected.mean(0).tolist())],
        ["off by", *(f"{mean:.1f}" for mean in off.mean(0).tolist())],
        ["its error", *(f"{mean:.1f}" for mean in error.mean(0).tolist())],
        ["within two errors", *(f"{mean:.2f}" for mean in within.mean(0).tolist())],
        ["number given", *(f"{count:.0f}" for count in after_passes("given").sum(0).tolist())],
    ]
    return [
        f"The number of objects that semfov expects in all after n passes, those that no look has shown included: the "
        f"mean over pictures, the mean absolute error, the error that it is given with, the share of the pictures in "
        f"which it is off by at most twice that, and the pictures in which a number is given. There are "
        f"{float(true.mean()):.1f} in the mean.",
        "",
        *table(rows),
        "",
    ]
