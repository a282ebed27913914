"""Benchmarks: compared programs give the same results, and figures are computed correctly."""

import json
import platform
import sys
import time
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks import acuity, decisions
from benchmarks.__main__ import COMPARISONS
from benchmarks.tables import comparison_rows
from benchmarks.timing import Comparison, Spread, interleaved, measure
from semfov import Eye, Foveation, WindowEye
from semfov.sensor import LogPolar
from tests.small import Coloured

pytestmark = pytest.mark.slow


def test_contrasts_and_finest_gratings():
    assert acuity.contrasts(Foveation(1e9), 8.0) == pytest.approx([1.0] * 7, abs=1e-3)
    kept = acuity.contrasts(LogPolar(60.0), 8.0)
    assert kept[0] > 0.85
    assert kept[-1] < 0.05
    found = [float(value.strip("≤ >")) for value in acuity.finest(LogPolar(60.0))]
    assert found == sorted(found)
    # At least two samples per wavelength; samples are 1 + 350 / 60 times as far apart as in the centre.
    assert 2 * (1 + 350 / 60) < found[-1] < 4 * (1 + 350 / 60)


def test_errors_and_found_objects_are_counted_by_distance():
    image = torch.zeros(1, 3, 64, 640)
    image[0, 0, 20:40, 100:120] = 1
    boxes, labels = torch.tensor([[100.0, 20, 120, 40], [600, 20, 620, 40]]), torch.tensor([1, 1])
    counts = acuity.AcuityCounts()
    detector = Coloured(("red",), (640, 64), score=0.75)
    counts.add(Eye(Foveation(1e9), detector), image, torch.tensor([[109.5, 29.5], [300.0, 29.5]]), boxes, labels)
    assert counts.looks == 2
    assert counts.objects.tolist() == [1, 0, 0, 0, 1, 0, 1]  # at 0 and 500 px, and at 190 and 310 px
    assert counts.found.tolist() == [1, 0, 0, 0, 1, 0, 0]
    assert float(counts.error.max()) < 1e-6
    assert float(counts.pixels.sum()) > 40_000


def test_missing_sahi_is_named_with_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "sahi", None)
    monkeypatch.delitem(sys.modules, "benchmarks.sahi", raising=False)
    with pytest.raises(ModuleNotFoundError, match="pip install --no-deps sahi"):
        import_module("benchmarks.sahi")


def test_slicers_see_through_the_same_eye():
    pytest.importorskip("sahi")
    from sahi.predict import get_sliced_prediction

    from benchmarks.sahi import Parts, Slicing, _slicer

    picture = np.zeros((128, 192, 3), dtype=np.uint8)
    picture[70:90, 140:150, 0] = 255

    def parts(classes, target):
        return Parts(WindowEye(Coloured(classes, (64, 64), score=0.8)), target)

    red, slicing = parts(("red",), None), {"slice_height": 64, "slice_width": 64, "verbose": 0}
    found = get_sliced_prediction(picture, Slicing(red), **slicing).object_prediction_list
    assert red.passes == 1 + 3 * 4
    assert [(each.category.id, each.category.name) for each in found] == [(1, "red")] * len(found)
    assert found[0].score.value == pytest.approx(0.8)
    # Without the pass over the whole picture, whose coarse box some versions of SAHI merge with those of the slices.
    alone = Slicing(parts(("red",), None))
    found = get_sliced_prediction(picture, alone, **slicing, perform_standard_pred=False).object_prediction_list
    assert [[round(side) for side in each.bbox.to_xyxy()] for each in found] == [[140, 70, 150, 90]]
    run = SimpleNamespace(eye=red.eye, target=None, config=SimpleNamespace(overlap=0.2))
    objects, passes = _slicer(run, 64, picture)
    assert passes == 3 * 4
    assert objects.boxes.round().tolist() == [[140, 70, 150, 90]]
    green = Slicing(parts(("red", "green"), 2))
    assert not get_sliced_prediction(picture, green, **slicing).object_prediction_list


def test_the_figure_of_seconds_has_a_band_where_there_are_errors():
    pytest.importorskip("sahi")
    from benchmarks.sahi import plot_seconds

    points = {("semfov", f"{n} passes"): (0.1 * n, 0.05 * n, 0.02) for n in (2, 4)}
    points["SAHI", "640 px"] = 0.5, 0.3, 0.1
    without = {name: (*numbers[:2], float("nan")) for name, numbers in points.items()}
    figure = plot_seconds({"pictures": points, "frames": without})
    one, other = figure.axes
    assert [ax.get_xlabel() for ax in figure.axes] == ["seconds a picture (one thread)"] * 2
    (low, *_), (band,) = one.lines[0].get_xydata(), one.collections[:1]
    assert low.tolist() == pytest.approx([0.2, 0.1])
    assert band.get_paths()[0].vertices[:, 1].min() == pytest.approx(0.08)
    assert len(other.collections) == 0


@pytest.mark.parametrize("number", range(len(COMPARISONS)))
def test_compared_programs_give_the_same_results(number):
    with torch.inference_mode():
        comparison = COMPARISONS[number]()
        comparison.agree()
    assert comparison.peers
    assert set(comparison.share) <= set(comparison.peers)


def test_ratios_take_the_share_of_the_work_into_account():
    """A peer that needs twice the time for a quarter of the work is eight times slower."""
    clock = iter(range(10**6))
    seconds = {"ours": 3, "peer": 6}

    def spend(name):
        for _ in range(seconds[name] - 1):
            next(clock)

    comparison = Comparison("work", lambda: spend("ours"), {"peer": lambda: spend("peer")}, {"peer": 1 / 4})
    measured = measure(comparison, 0.0, lambda: float(next(clock)))
    assert measured.ratios["peer"] == Spread(8.0, 8.0, 8.0)
    assert comparison_rows(measured) == [["work", "peer", "3,000", "24,000", "8 (8 to 8)"]]


def test_runs_rotate_and_are_averaged_in_a_turn():
    order: list[str] = []
    interleaved({name: lambda name=name: order.append(name) for name in "abc"}, 0.0, time.perf_counter, least=3)
    rounds = ["".join(order[i : i + 3]) for i in range(0, len(order), 3)]
    assert rounds == ["abc", "bca", "cab", "abc"]
    clock = iter(range(10**6))
    found = interleaved({"a": lambda: next(clock)}, 0.0, lambda: float(next(clock)), least=1, times=4)
    assert found == {"a": [1e3 * 5 / 4]}


def test_decisions_have_a_row_for_every_published_cost(tmp_path, monkeypatch):
    arguments = ["decisions", "--threads", "1", "--seconds", "0", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", arguments)
    decisions.main()
    text, figures = (tmp_path / "decisions.md").read_text(), json.loads((tmp_path / "decisions.json").read_text())
    for costs in decisions.PUBLISHED.values():
        for name in costs:
            assert f"| {name} |" in text
            times = figures["milliseconds"][name]
            assert 0 < times["low"] <= times["middle"] <= times["high"]
    assert set(figures["peers"]["ratios"]) == {"loop over fixations and cells", "all pairs at once"}
    assert figures["published_milliseconds"]["exploration"]["KL divergence, raw"] == 9851
    assert platform.node() not in json.dumps(figures["machine"]).split('"')
