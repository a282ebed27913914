"""Curves of finished runs: per image, paired over images, and by repetition, as the paper averages them."""

import json
import math
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path

import numpy as np

from eval.comparison.summary import Curve, by_scene, curve_of
from semfov.metrics.episodes import FloatArray, cumulative_performance, standard_error
from semfov.runs.results import ResultRecord
from semfov.runs.tables import plus_minus

OBJECTS = "right_without_background"


@cache
def _read_records(folder: Path) -> tuple[ResultRecord, ...]:
    """Read the records of all episodes of a run."""
    lines = (folder / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    return tuple(json.loads(line) for line in lines)


def records_of(folder: Path, policy: str, *, commonest: bool = False) -> list[ResultRecord]:
    """Read records of a policy; with `commonest`, only searches for each image's commonest target, as in the paper."""
    return [r for r in _read_records(folder) if r["policy"] == policy and (r["commonest"] if commonest else True)]


def policies_of(folder: Path) -> list[str]:
    """Return the policies of a run in their order."""
    return list(dict.fromkeys(record["policy"] for record in _read_records(folder)))


def _curve_of_record(record: ResultRecord, last: int, field: str = "right") -> FloatArray:
    """Measure of an episode after 0..`last` gaze shifts; in explorations, `field` says which answers are counted."""
    if "found_at" in record:
        return cumulative_performance(np.array([record["found_at"]]), last)
    return np.asarray(record[field])[: last + 1] / record["object_cells"]


def _per_image(records: list[ResultRecord], last: int, field: str = "right") -> FloatArray:
    """Measure of each image after 0..`last` gaze shifts, in order of the images, `(images, last+1)`."""
    means = by_scene((str(record["scene"]), _curve_of_record(record, last, field)) for record in records)
    return np.stack([means[scene] for scene in sorted(means)])


def averaged(records: list[ResultRecord], last: int) -> Curve:
    """Mean measure after 0..`last` gaze shifts, with its standard errors over images and over repetitions."""
    return curve_of(records, partial(_curve_of_record, last=last))


def paired_difference(
    folder: Path, one: str, other: str, last: int, field: str = "right", *, commonest: bool = False
) -> tuple[FloatArray, FloatArray]:
    """`difference` of two policies of a run after 0..`last` gaze shifts."""
    both = (records_of(folder, policy, commonest=commonest) for policy in (one, other))
    return difference(*(_per_image(records, last, field) for records in both))


def difference(one: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean difference, paired over images, and its standard error, each `(last+1,)`."""
    paired = one - other
    return paired.mean(0), standard_error(paired)


def points(mean: FloatArray, error: FloatArray, shifts: Sequence[int]) -> list[str]:
    """Differences after these gaze shifts, in percentage points, with their standard errors."""
    return [plus_minus(100 * mean[n], 100 * error[n], sign="+") for n in shifts]


def behind(mean: FloatArray, error: FloatArray) -> list[int]:
    """Gaze shifts, from 1, at which a paired difference is below zero, corrected for all shifts by Holm's method.

    >>> behind(np.array([0.0, -0.3, -0.19, 0.4]), np.array([0.0, 0.1, 0.1, 0.1]))
    [1]
    """
    signs = corrected_signs(mean[1:], error[1:])
    return [number for number, sign in enumerate(signs.tolist(), 1) if sign < 0]


def corrected_signs(mean: FloatArray, error: FloatArray, *, alpha: float = 0.05) -> FloatArray:
    r"""Signs of differences, 0 for those that Holm's method does not tell from zero.

    Each difference has the two-sided p-value of a normal distribution, :math:`p = \mathrm{erfc}(|m| / (s \sqrt 2))`. In
    ascending order, the i-th of n p-values is compared with :math:`\alpha / (n - i + 1)`, until one exceeds it. The
    probability of any wrong sign is then at most α, however the differences depend on each other (Holm, 1979, A simple
    sequentially rejective multiple test procedure).

    Shapes: mean `(n,)`, error `(n,)`.

    >>> corrected_signs(np.array([-3.0, 2.1, 0.0]), np.ones(3))
    array([-1.,  0.,  0.])
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = np.nan_to_num(np.abs(mean) / error, nan=0.0, posinf=np.inf)
    chance = np.array([math.erfc(each / math.sqrt(2)) for each in scaled])
    order = np.argsort(chance)
    significant = np.cumprod(chance[order] <= alpha / np.arange(len(order), 0, -1))
    signs = np.zeros(len(mean))
    signs[order] = significant * np.sign(mean)[order]
    return signs


def spans(numbers: list[int]) -> str:
    """Write ascending numbers as spans.

    >>> spans([1, 2, 3, 7, 9, 10])
    '1 to 3, 7, 9 to 10'
    """
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)
