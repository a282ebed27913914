"""Arguments that measures do not take: each is refused by its name, before anything is computed with it."""

import numpy as np
import pytest
import torch

from semfov.metrics import scanpath
from semfov.metrics.calibration import BinarySums, calibration, calibration_error, reliability
from semfov.metrics.episodes import cumulative_performance, standard_error
from semfov.metrics.merging import AreaUnderRoc
from tests.refusals import refused

MAP = np.random.default_rng(0).random((20, 30))
PATH = np.random.default_rng(1).random((5, 2)) * (29, 19)
SIZE = (30, 20)
HALVES = torch.full((1, 2), 0.5)

CALLS = {
    "scores in rows": (lambda: AreaUnderRoc().update(torch.ones(2, 2), torch.ones(2, 2)), "score: expected scores"),
    "a score alone": (lambda: AreaUnderRoc().update(torch.tensor(1.0), torch.tensor(True)), "score: expected scores"),
    "fewer outcomes": (lambda: AreaUnderRoc().update([1.0, 2.0], [True]), "present: expected a tensor of shape"),
    "no shifts": (lambda: cumulative_performance(np.zeros(2, int), -1), "shifts: expected a whole number"),
    "a part of a shift": (lambda: cumulative_performance(np.zeros(2, int), 2.5), "shifts: expected a whole number"),
    "shifts in words": (lambda: scanpath.tfp_auc([1], ["cup"], "6"), "shifts: expected a whole number"),
    "found in parts": (lambda: scanpath.mean_performance([0.5], ["cup"], 3), "found: expected numbers of gaze shifts"),
    "found before": (lambda: scanpath.mean_performance([-2], ["cup"], 3), "found: expected numbers of gaze shifts"),
    "one value": (lambda: standard_error(3.0), "values: expected several values"),
    "half a bin": (lambda: calibration(HALVES, torch.zeros(1), bins=2.5), "bins: expected a whole number"),
    "no bins": (lambda: calibration_error(HALVES[0], torch.ones(2), 0), "bins: expected a whole number"),
    "edges": (lambda: reliability(HALVES[0], torch.ones(2), torch.tensor([0.5, 0.2])), "bins: expected edges that"),
    "a search alone": (lambda: cumulative_performance(np.array(5), 3), "found_at: expected a number for each search"),
    "searches in words": (lambda: cumulative_performance(["a"], 3), "found_at: expected numbers"),
    "an edge alone": (lambda: reliability(HALVES[0], torch.ones(2), torch.tensor(0.5)), "bins: expected numbers in a"),
    "edges in rows": (lambda: reliability(HALVES[0], torch.ones(2), torch.tensor([[0.1, 0.5]])), "bins: expected num"),
    "no edge": (lambda: reliability(HALVES[0], torch.ones(2), torch.tensor([torch.nan])), "bins: expected numbers"),
    "a probability": (lambda: reliability(HALVES[0, 0], torch.tensor(1)), "confidence: expected numbers in a row"),
    "confidence in rows": (lambda: calibration_error(HALVES, torch.ones(1, 2)), "confidence: expected numbers in a"),
    "fewer came true": (lambda: reliability(HALVES[0], torch.ones(1)), "correct: expected 2 in a row, got shape"),
    "sums in rows": (lambda: BinarySums.of(HALVES, torch.ones(1, 2)), "probability: expected numbers in a row"),
    "deep": (lambda: calibration(HALVES[None], torch.zeros(1)), "probabilities: expected a tensor of shape"),
    "a duration": (lambda: scanpath.multimatch(PATH, PATH, SIZE, 5), "durations: expected those of both .* got 5"),
    "letters' duration": (lambda: scanpath.scanmatch(PATH, PATH, SIZE, durations=np.array(5)), "durations: expected t"),
    "cells": (lambda: scanpath.scanmatch(PATH, PATH, SIZE, cells=5), r"cells: expected \(columns, rows\), got 5"),
    "a side": (lambda: scanpath.multimatch(PATH, PATH, (30,)), "size: expected a width and a height above 0"),
    "no size": (lambda: scanpath.multimatch(PATH, PATH, None), "size: expected a width and a height above 0"),
    "size in words": (lambda: scanpath.multimatch(PATH, PATH, "ab"), "size: expected a width and a height above 0"),
    "durations of one": (lambda: scanpath.multimatch(PATH, PATH, SIZE, ([1] * 5,)), "durations: expected those"),
    "durations in rows": (
        lambda: scanpath.multimatch(PATH, PATH, SIZE, (np.ones((5, 2)), np.ones((5, 2)))),
        "durations: expected 5 and 5 numbers",
    ),
    "an empty picture": (lambda: scanpath.scanmatch(PATH, PATH, (0, 20)), "size: expected a width and a height"),
    "columns alone": (lambda: scanpath.scanmatch(PATH, PATH, SIZE, cells=(3,)), r"cells: expected \(columns, rows\)"),
    "letters of one": (lambda: scanpath.scanmatch(PATH, PATH, SIZE, durations=([9] * 5,)), "durations: expected those"),
    "no columns": (lambda: scanpath.cell_labels(PATH, 0, 2, SIZE), "columns: expected a whole number"),
    "half a row": (lambda: scanpath.cell_labels(PATH, 2, 2.5, SIZE), "rows: expected a whole number"),
    "turned over": (lambda: scanpath.cell_labels(-PATH, 2, 2, (-30, -20)), "size: expected a width and a height"),
    "three sides": (lambda: scanpath.cell_labels(PATH, 2, 2, (30, 20, 3)), "size: expected a width and a height"),
    "a window's side": (lambda: scanpath.merge_close(PATH, (3,)), "size: expected a width and a height above 0"),
    "bandwidth": (lambda: scanpath.cluster_labels(PATH, PATH, bandwidth=-1), "bandwidth: expected a number"),
    "lengths in rows": (lambda: scanpath.length_distance(np.ones((3, 2)), [1]), "ours: expected numbers"),
    "a length": (lambda: scanpath.length_distance([1.0], 3.0), "theirs: expected numbers in a row"),
    "directions in rows": (lambda: scanpath.direction_distance(np.ones((3, 2)), [1]), "ours: expected numbers"),
    "draws": (lambda: scanpath.auc_borji(MAP, [1], [1], draws=2.5), "draws: expected a whole number"),
    "seed": (lambda: scanpath.auc_borji(MAP, [1], [1], seed=-1), "seed: expected a whole number"),
}  # fmt: skip


@pytest.mark.parametrize("kind", CALLS)
def test_an_argument_that_is_not_taken_is_named(kind):
    call, words = CALLS[kind]
    refused(words, call)


def test_without_episodes_no_share_is_known():
    assert np.isnan(cumulative_performance(np.zeros((3, 0), int), 2)).all()
    assert cumulative_performance(np.zeros((3, 0), int), 2).shape == (3, 3)
