"""How well scores tell whether a target is present: cells against the figures and against loops over scenes."""

import math

import pytest
import torch

from eval.comparison.telling import Telling, _tells, calibrated, class_frequencies
from eval.presence import hits_at
from semfov import EmbeddedScenes
from semfov.metrics.episodes import area_under_roc
from tests.small import cells_of


@pytest.fixture(scope="module")
def searches():
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


def test_rows_hold_the_figures_and_intervals_around_them(searches):
    told, there, scenes, right = searches
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


def test_differences_are_those_of_the_rows_with_smaller_errors_than_unpaired(searches):
    told, there, scenes, right = searches
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


def test_without_absent_classes_there_is_nothing_to_tell(searches):
    told, there, scenes, _ = searches
    assert all(map(math.isnan, _tells(told["sharp"], torch.ones_like(there))))
    telling = Telling(told, torch.ones_like(there), scenes)
    assert telling.rows() == [["-"] * 4] * 2
    assert telling.differences("sharp")[2].count("| - ") == 4


def test_calibrated_probabilities_have_the_error_of_chance():
    """The mean and the limit of chance are those of outcomes that come true with their probabilities."""
    generator = torch.Generator().manual_seed(5)
    p = torch.rand(600, generator=generator, dtype=torch.float64)
    drawn = [float(calibrated(p, torch.rand(600, generator=generator) < p)[0]) for _ in range(100)]
    mean, limit = (float(part) for part in calibrated(p, p > 0.5)[1].split(", to "))
    assert mean == pytest.approx(sum(drawn) / 100, abs=0.003)
    assert 88 <= sum(error <= limit for error in drawn) <= 100
    assert float(calibrated(p.square(), torch.rand(600, generator=generator) < p)[0]) > limit


def test_frequencies_are_those_of_the_other_scenes():
    scenes = EmbeddedScenes(["cup", "cat", "dog"], count=5)
    held = [set(scenes.annotation(index).labels.tolist()) for index in range(5)]
    for index, row in enumerate(class_frequencies(scenes)):
        others = [held[other] for other in range(5) if other != index]
        assert row.tolist() == [sum(label in each for each in others) / 4 for label in range(4)]
