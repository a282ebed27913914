"""What large pictures are compared with: sparse slices, and the expectations of an observation model."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from eval.zoom import folds
from eval.zoom.objects import object_table
from eval.zoom.observed import ObservedRates
from eval.zoom.orders import sparse
from eval.zoom.run import ZoomConfig
from semfov import FovealObservationModel, InputError, WindowEye
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import LiveWindowLooks, Window
from semfov.zoom.slices import usual_slices
from tests.small import Coloured

LATTICE = Lattice.over((1024, 768), (128, 128))


def test_sparse_slices_are_those_in_which_the_overview_shows_enough():
    """The highest score of a slice, by a loop over the boxes of the hints and not over the cells."""
    pixels = np.full((900, 1200, 3), 100, np.uint8)
    pixels[600:690, 900:990], pixels[100:160, 100:160] = (25, 230, 25), (230, 25, 25)
    eye = WindowEye(Coloured())
    source = LiveWindowLooks(eye, eye.open(pixels))
    windows = usual_slices(source.lattice)
    (look,) = source.see([Window.overview(source.lattice)])
    (hints,) = eye.detect(source.view, torch.tensor([look.window.fixation])).hints
    wide, high = source.lattice.pitch
    for targets in ([], [1], [2]):
        for least in (0.05, 0.5):
            order, done, chosen = sparse(windows, targets, least), set(), []
            while choice := order([look] * (len(done) + 1), done):
                done.add(choice[0][0])
                chosen.append(choice[0][0])
            expected = []
            for window in windows:
                x1, y1, x2, y2 = window.cells
                best = 0.0
                for box, scores in zip(hints.boxes.tolist(), hints.scores, strict=True):
                    column, row = (box[0] + box[2]) / 2 // wide, (box[1] + box[3]) / 2 // high
                    if x1 <= column < x2 and y1 <= row < y2:
                        best = max(best, float(max(scores[[t - 1 for t in targets]] if targets else scores)))
                expected += [window] if best >= least else []
            assert chosen == expected
    assert 0 < len(expected) < len(windows)


def observation():
    torch.manual_seed(0)
    miss = torch.rand(3, 4).double().clamp(0.1, 0.9)
    alpha = 1 + torch.rand(3, 4, 3).double()
    cells = {"cells": [97, 1, 2]}
    return FovealObservationModel(alpha, [0.5, 1.5, 2.5], ("red", "blue"), miss_rate=miss, metadata=cells)


def test_expected_finds_of_closer_looks_follow_from_the_model():
    model = observation()
    rates = ObservedRates(model, LATTICE)
    span = LATTICE.span(1)
    scores, found = torch.zeros(span, span, 2), torch.zeros(span, span, 2, dtype=torch.bool)
    scores[3, 4, 0] = 0.2
    found[10, 10, 1] = True
    look = Gist(1, (0, 0), 1, scores, torch.zeros(span, span), found)
    expected_finds = rates.rates(look, torch.tensor([0, 1, 2])).exp()
    level = [sum(float(octave) > edge for edge in (0.5, 1.5, 2.5)) for octave in LATTICE.octaves]
    miss, share = model.miss_rate, torch.tensor([98.0, 2, 3]).double() / 103
    nothing = share * miss[:, level[1]]
    nothing = nothing / nothing.sum()
    seen = model.calibrate(torch.tensor([0.8, 0.2, 0.0]).double(), LATTICE.octaves[1].double()).detach()
    for cell, held in (((20, 20), nothing), ((3, 4), seen)):
        for t in (1, 2):
            expected = held[t] * (1 - miss[t, level[2]])
            assert float(expected_finds[t, 0, *cell]) == pytest.approx(float(expected), rel=1e-4)
        assert float(expected_finds[0, 0, *cell]) == pytest.approx(float(expected_finds[1:, 0, *cell].sum()), rel=1e-4)
    # Objects already found are not expected again, and no look is closer than the finest level.
    assert expected_finds[2, 0, 9:12, 9:12].max() < 1e-6
    assert expected_finds[:, LATTICE.levels - 2 :].max() < 1e-6
    assert rates.taper(5).tolist() == [1.0] * 5


def test_a_model_without_counts_of_cells_is_refused():
    with pytest.raises(InputError, match=r"train\.fit_fom fitted with --mosaics"):
        ObservedRates(FovealObservationModel.identity(("red", "blue"), [0.5]), LATTICE)


class _Photographs:
    """Photographs by their ids."""

    classes = ("cat",)
    fingerprint = "photographs"

    def __init__(self, count: int) -> None:
        self.ids = [100 + number for number in range(count)]

    def __len__(self) -> int:
        return len(self.ids)


def _run(photographs: int, parts: int, photograph: object = None) -> SimpleNamespace:
    """Make a run whose records say to which photographs its evidence was fitted."""
    run = SimpleNamespace(
        config=SimpleNamespace(folds=parts, seed=3),
        scenes=_Photographs(photographs),
        eye=None,
        evidence=SimpleNamespace(photograph=photograph, fitted_to=None),
    )
    run.outcomes = lambda index: ([{"scene": run.scenes.ids[index], "fitted to": run.evidence.fitted_to}], {})
    return run


def test_each_photograph_is_judged_with_evidence_of_all_other_folds(monkeypatch):
    settings = []

    def fit(model, others, eye, chosen):
        model.fitted_to = [*others.ids]
        settings.append(chosen)

    monkeypatch.setattr(folds, "fit_photographs", fit)
    records = folds.outcomes_in_folds(_run(7, 3, SimpleNamespace(window=(0.3, 3.0))))
    assert sorted(record["scene"] for record in records) == [100, 101, 102, 103, 104, 105, 106]
    for record in records:
        part = {100 + number for number in range(7) if number % 3 == (record["scene"] - 100) % 3}
        assert {*record["fitted to"]} == {100 + number for number in range(7)} - part
    assert [each.photographs for each in settings] == [4, 5, 5]
    assert {(each.window, each.seed) for each in settings} == {((0.3, 3.0), 3)}


def test_folds_need_as_many_photographs_and_no_mosaics():
    with pytest.raises(InputError, match=r"^folds: expected at most one for each of 2 photographs, got 3"):
        folds.outcomes_in_folds(_run(2, 3))
    for wrong in ({"folds": 1, "mosaics": 0}, {"folds": 2, "mosaics": 5}):
        with pytest.raises(InputError, match=r"^folds: expected 0, or 2 or more with mosaics 0"):
            ZoomConfig(**wrong)


def test_objects_are_compared_with_those_of_semfov():
    def record(way: str, scene: int, scores: list[float], right: list[int]) -> dict[str, object]:
        after = {"scores": scores, "labels": [1] * len(scores), "right": right, "listed": len(scores), "kept": 0}
        after |= {"listed right": sum(right), "in all": None, "error": None, "given": False}
        common = {"measure": "objects", "way": way, "scene": scene, "objects": 1, "by class": {"1": 1}, "plain": 0}
        return common | {"after": {"1": after}}

    records = [record("plain", scene, [0.9, 0.8], [0, 1]) for scene in range(3)]
    records += [record("semfov", scene, [0.9, 0.2], [1, 0]) for scene in range(3)]
    _, row = [line for line in object_table(records) if line.startswith("| plain")][:2]
    # Half of all boxes are right; of semfov, those that come first: its average precision and precision are 1 and 0.5.
    cells = [cell.strip() for cell in row.split("|")[2:-1]]
    assert cells[0] == "-0.500 ± 0.000"
    assert cells[1:4] == ["+0.000 ± 0.000"] * 3
