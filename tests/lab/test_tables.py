"""Tables of runs: means, errors by bootstrap, and how well scores tell what is there, against loops and SciPy."""

import csv
import io
import math
import statistics
from itertools import product

import numpy as np
import pytest
import torch
from scipy.stats import bootstrap, norm

from eval.bootstrap import Bootstrap
from eval.comparison.summary import LAST_COLUMN, curve_of, curve_rows, curves_csv
from eval.comparison.telling import Telling, _tells, calibrated, class_frequencies
from eval.explore import report as explore_report
from eval.presence import hits_at
from eval.search import report as search_report
from semfov import EmbeddedScenes
from semfov.metrics.calibration import calibration_error
from semfov.metrics.episodes import area_under_roc
from semfov.runs.tables import percent
from tests.refusals import refused
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
    curve = curve_of([r for r in explorations() if r["repetition"] == 0], lambda r: np.asarray(r["right"]) / 4)
    assert np.isnan(curve.over_repetitions).all()
    assert curve.over_images == pytest.approx([0.125] * 3)
    assert percent(0.5, float("nan")) == "50.0"


@pytest.fixture(scope="module")
def pairs():
    """Two searches in each of 30 scenes: probabilities of two ways, and what is there."""
    generator = torch.Generator().manual_seed(0)
    there = torch.tensor([True, False] * 30)
    told = {
        name: (torch.randn(60, generator=generator) + skill * there).sigmoid()
        for name, skill in (("sharp", 2.0), ("blunt", 0.5))
    }
    right = {"sharp": torch.where(there, torch.tensor([1.0, 1, 0, 1, 1]).repeat(12), torch.nan)}
    return told, there, [f"scene {n // 2}" for n in range(60)], right


def numbers(cell):
    return [float(part) for part in cell.replace("(", "").replace(")", "").replace("to", "").replace("±", "").split()]


def test_rows_hold_the_figures_and_intervals_around_them(pairs):
    told, there, scenes, right = pairs
    telling = Telling(told, there, scenes, right)
    for (name, score), row in zip(told.items(), telling.rows(), strict=True):
        area, error = numbers(row[0])
        assert area == round(area_under_roc(score, there), 3)
        assert 0.005 < error < 0.1
        for share, cell in zip((0.01, 0.02, 0.05), row[1:], strict=True):
            value, low, high = numbers(cell)
            assert value == round(100 * hits_at(score, there, share))
            assert low <= value <= high
            assert high > low, name
    value, low, high = numbers(telling.place("sharp"))
    assert value == pytest.approx(100 * right["sharp"][there].mean().item(), abs=0.05)
    assert low < value < high
    assert telling.place("blunt") == "-"


def test_differences_are_those_of_the_rows_with_smaller_errors_than_unpaired(pairs):
    told, there, scenes, right = pairs
    nearly = told["sharp"] + 1e-3 * there
    telling = Telling({**told, "nearly sharp": nearly}, there, scenes, right)
    heads, _, *rows = cells_of("\n".join(telling.differences("sharp")))
    assert heads[0] == "difference to sharp"
    assert [row[0] for row in rows] == ["blunt", "nearly sharp"]
    apart, error = numbers(rows[0][1])
    expected = area_under_roc(told["blunt"], there) - area_under_roc(told["sharp"], there)
    assert apart == pytest.approx(expected, abs=5e-4)
    assert numbers(rows[1][1])[1] < 0.005 < error
    assert [row[-1] for row in rows] == ["-", "-"]
    assert "place right" in heads
    assert "place right" not in Telling(told, there, scenes).differences("sharp")[0]


def test_without_absent_classes_there_is_nothing_to_tell(pairs):
    told, there, scenes, _ = pairs
    assert all(map(math.isnan, _tells(told["sharp"], torch.ones_like(there))))
    telling = Telling(told, torch.ones_like(there), scenes)
    assert telling.rows() == [["-"] * 4] * 2
    assert telling.differences("sharp")[2].count("| - ") == 4


def test_calibrated_probabilities_have_the_error_of_chance():
    """The mean and the limit of chance are those of outcomes that come true with their probabilities."""
    generator = torch.Generator().manual_seed(5)
    p = torch.rand(600, generator=generator, dtype=torch.float64)
    drawn = [float(calibration_error(p, torch.rand(600, generator=generator) < p)) for _ in range(100)]
    measured, by_chance = calibrated(p, p > 0.5)
    assert float(measured) == pytest.approx(float(calibration_error(p, p > 0.5)), abs=5e-4)
    mean, limit = map(float, by_chance.split(", to "))
    assert mean == pytest.approx(sum(drawn) / 100, abs=0.003)
    assert 88 <= sum(error <= limit for error in drawn) <= 100
    assert float(calibrated(p.square(), torch.rand(600, generator=generator) < p)[0]) > limit


def test_frequencies_are_those_of_the_other_scenes():
    scenes = EmbeddedScenes(["boat", "truck", "dog"], count=5)
    held = [set(scenes.annotation(index).labels.tolist()) for index in range(5)]
    for index, row in enumerate(class_frequencies(scenes)):
        others = [held[other] for other in range(5) if other != index]
        assert row.tolist() == [sum(label in each for each in others) / 4 for label in range(4)]


GROUPS = ["a", "b", "a", "c", "b", "b"]
CASES = torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0, 32.0], dtype=torch.float64)


def mean_of(values):
    return lambda index: values[index].mean()


def test_samples_hold_whole_groups_with_all_their_cases():
    drawn = Bootstrap.of(lambda index: torch.bincount(index, minlength=6), GROUPS, samples=200)
    assert drawn.value.tolist() == [1] * 6
    for counts in drawn.samples.tolist():
        assert counts[0] == counts[2]
        assert counts[1] == counts[4] == counts[5]
        assert counts[0] + counts[1] + counts[3] == 3
    assert len(drawn.samples.unique(dim=0)) == 10  # multisets of 3 of 3 groups


def test_error_and_interval_are_those_of_every_possible_sample():
    """All 27 samples of three groups are equally likely."""
    parts = [CASES[[0, 2]], CASES[[1, 4, 5]], CASES[[3]]]
    every = np.array([torch.cat([parts[n] for n in sample]).mean() for sample in product(range(3), repeat=3)])
    drawn = Bootstrap.of(mean_of(CASES), GROUPS, samples=20_000)
    assert set(drawn.samples.numpy().round(9)) == set(every.round(9))
    assert float(drawn.error) == pytest.approx(every.std(), rel=0.02)
    low, high = np.quantile(np.repeat(every, 1000), (0.05, 0.95))
    assert drawn.interval(0.9).tolist() == pytest.approx([low, high])


def test_error_and_interval_agree_with_scipy_where_every_case_is_a_group(dtype):
    values = torch.randn(80, generator=torch.Generator().manual_seed(0), dtype=torch.float64).exp().to(dtype)
    theirs = bootstrap((values.numpy(),), np.mean, n_resamples=4000, method="percentile", rng=0)
    ours = Bootstrap.of(mean_of(values), range(80), samples=4000)
    assert float(ours.error) == pytest.approx(theirs.standard_error, rel=0.05)
    assert ours.interval().tolist() == pytest.approx(list(theirs.confidence_interval), rel=0.02)


def test_error_of_the_area_is_that_of_delong():
    """Cases that are independent: the variance of the structural components (DeLong and others, 1988)."""
    generator = torch.Generator().manual_seed(3)
    present = torch.arange(300) < 150
    score = torch.randn(300, generator=generator, dtype=torch.float64) + present
    hits, misses = score[present].tolist(), score[~present].tolist()
    above = np.array([[(h > m) + (h == m) / 2 for m in misses] for h in hits])
    expected = (above.mean(1).var(ddof=1) / 150 + above.mean(0).var(ddof=1) / 150) ** 0.5
    measure = lambda index: torch.tensor(area_under_roc(score[index], present[index]))  # noqa: E731
    got = Bootstrap.of(measure, range(300))
    assert float(got.value) == pytest.approx(norm.cdf(2**-0.5), abs=3 * expected)
    assert float(got.error) == pytest.approx(expected, rel=0.08)


def test_differences_are_paired_samples_without_a_figure_do_not_count_and_the_seed_decides_them():
    """Two figures that differ by a constant differ without an error."""
    drawn = Bootstrap.of(lambda index: torch.stack([CASES[index].mean(), CASES[index].mean() + 3]), GROUPS)
    apart = drawn.less(0)
    assert apart.value.tolist() == [0, 3]
    assert apart.error.tolist() == pytest.approx([0, 0], abs=1e-12)
    assert drawn.error[0] > 1
    values = torch.tensor([1.0, torch.nan, 5.0], dtype=torch.float64)
    drawn = Bootstrap.of(lambda index: values[index].nanmean(), range(3), samples=500)
    left = drawn.samples[~drawn.samples.isnan()]
    assert 0 < len(left) < 500
    assert float(drawn.error) == pytest.approx(float(left.std()))
    assert drawn.interval().tolist() == left.quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    draws = [Bootstrap.of(mean_of(CASES), GROUPS, seed=seed).samples for seed in (0, 0, 1)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    for groups, samples, told in [([], 10, "groups"), ([1], 1, "samples")]:
        refused(f"{told}: expected", Bootstrap.of, mean_of(CASES), groups, samples=samples)
