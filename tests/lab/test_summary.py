"""Tables of a run: means and both standard errors against hand calculations, and the columns of each table."""

import csv
import io
import statistics

import numpy as np
import pytest

from eval.comparison.summary import LAST_COLUMN, curve_of, curve_rows, curves_csv
from eval.explore import report as explore_report
from eval.search import report as search_report
from semfov.runs.tables import percent
from tests.small import cells_of

# Gaze shift at which each search found its target (-1: not found), by image and repetition.
FOUND = {"one": [0, 1, -1], "two": [1, 1, 2], "three": [-1, 2, 0]}


def searches(policy="random"):
    return [
        {"policy": policy, "scene": scene, "repetition": repetition, "commonest": True, "found_at": found}
        for scene, repetitions in FOUND.items()
        for repetition, found in enumerate(repetitions)
    ]


def explorations(policy="kl-raw"):
    """Two images with objects in four cells; each of two gaze shifts makes one more cell right."""
    return [
        {
            "policy": policy,
            "scene": scene,
            "repetition": repetition,
            "right": [scene + repetition, scene + repetition + 1, scene + repetition + 2],
            "right_without_background": [4, 4, 4],
            "right_everywhere": [5, 5, 10],
            "object_cells": 4,
            "grid_cells": 10,
        }
        for scene in (0, 1)
        for repetition in (0, 1)
    ]


def standard_error(values):
    return statistics.stdev(values) / len(values) ** 0.5


def found_by(shift):
    """Share of searches that have found their target, by image and by repetition."""
    hits = {scene: [0 <= at <= shift for at in found] for scene, found in FOUND.items()}
    return [statistics.mean(each) for each in hits.values()], [
        statistics.mean(r) for r in zip(*hits.values(), strict=True)
    ]


def test_means_and_errors_match_hand_calculations():
    curve = search_report.performance(searches(), ("random",), 2, "all targets")["random"]
    assert (curve.images, curve.episodes) == (3, 9)
    for shift in range(3):
        images, repetitions = found_by(shift)
        assert curve.mean[shift] == pytest.approx(statistics.mean(images))
        assert curve.over_images[shift] == pytest.approx(standard_error(images))
        assert curve.over_repetitions[shift] == pytest.approx(standard_error(repetitions))


def test_the_last_column_is_the_largest_error_over_repetitions():
    """The paper's Max. SEM: the standard error over the repetitions' mean curves, at its largest gaze shift."""
    curves = search_report.performance(searches(), ("random",), 2, "all targets")
    (row,) = curve_rows(curves, [0, 2])
    largest = max(standard_error(found_by(shift)[1]) for shift in range(3))
    assert row == [
        "random",
        *(percent(*map(float, each)) for each in first_and_last(curves["random"])),
        f"{100 * largest:.2f}",
    ]
    assert LAST_COLUMN == "max. SEM over repetitions"


def first_and_last(curve):
    return [(curve.mean[shift], curve.over_images[shift]) for shift in (0, 2)]


def test_search_tables_have_a_row_for_each_policy_and_no_durations():
    curves = {
        average: search_report.performance(searches(), ("random",), 2, average) for average in search_report._AVERAGES
    }
    text = search_report._search_summary(curves, np.array([0.0, 0.25, 0.5]), "an eye")
    head, _, row, formula, *rest = cells_of(text)
    assert head == ["policy", "CP@1", LAST_COLUMN]
    assert (row[0], formula) == ("random", ["random, by formula", "25.0", ""])
    assert len(rest) == 3
    assert " ms" not in text
    assert "millisecond" not in text


def test_exploration_tables_name_the_published_answer_first():
    curves = {answer: explore_report.success(explorations(), ("kl-raw",), answer) for answer in explore_report._ANSWERS}
    text = explore_report._exploration_summary(curves, 2, "an eye")
    published, other = text.split("**as published", 1)[1].split("**the answer", 1)
    other, everywhere = other.split("**all cells count", 1)
    assert "most probable class, background included" in published
    assert "most probable class other than background" in other
    head, _, row = cells_of(published)
    assert head == ["policy", "0", "1", "2", LAST_COLUMN]
    # Means 1/4, 2/4, 3/4; images and repetitions differ by a quarter, so both errors are an eighth.
    assert row == ["kl-raw", "25.0 ± 12.5", "50.0 ± 12.5", "75.0 ± 12.5", "12.50"]
    assert cells_of(other)[2] == ["kl-raw", *["100.0 ± 0.0"] * 3, "0.00"]
    assert cells_of(everywhere)[2] == ["kl-raw", *["50.0 ± 0.0"] * 2, "100.0 ± 0.0", "0.00"]


def test_csv_has_a_row_for_every_gaze_shift():
    curves = {"all targets": search_report.performance(searches(), ("random",), 2, "all targets")}
    rows = list(csv.DictReader(io.StringIO(curves_csv(curves, ("average", "performance")))))
    assert [int(row["shifts"]) for row in rows] == [0, 1, 2]
    for row, shift in zip(rows, range(3), strict=True):
        assert float(row["error_over_repetitions"]) == pytest.approx(standard_error(found_by(shift)[1]), abs=1e-6)


def test_one_repetition_has_no_error_over_repetitions():
    curve = curve_of([r for r in explorations() if r["repetition"] == 0], lambda r: np.asarray(r["right"]) / 4)
    assert np.isnan(curve.over_repetitions).all()
    assert curve.over_images == pytest.approx([0.125] * 3)
    assert percent(0.5, float("nan")) == "50.0"
