"""Sensors compared at equal pixels of the detector, and the searcher of SemBA."""

import numpy as np
import pytest

from eval import semba, sensors
from eval.semba import _search_scene, _SembaConfig
from semfov.runs.config import BeliefConfig, DataConfig, DetectorConfig, ProtocolConfig, SensorConfig
from semfov.runs.looking import Looking
from tests.colours import write_home
from tests.small import cells_of


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with a network of 64 × 64 pixels, and photographs of coloured squares."""
    return write_home(tmp_path_factory.mktemp("colours"), 6)


CROPS = {"settings": {"side": 64, "scales": 3}}


def given(home, out, *more):
    photographs = home / "photographs"
    return [
        "--data.root", str(photographs), "--data.annotations", str(photographs / "instances.json"),
        "--data.min_instances", "0", "--detector.name", str(home / "colours.onnx"),
        "--out", str(home / out), "--cache", str(home / "cache"), "--workers", "1", *more,
    ]  # fmt: skip


def test_sensors_are_compared_with_models_of_their_own(home, monkeypatch, capsys):
    chosen = {
        "crops": sensors._SensorChoice("multi-scale", 64, CROPS),
        "log-polar": sensors._SensorChoice("log-polar", 64),
    }
    monkeypatch.setattr(sensors, "CANDIDATES", chosen)
    fit = ["--fit.root", str(home / "photographs"), "--fit.annotations", str(home / "photographs/instances.json")]
    small = ["--belief.columns", "4", "--belief.rows", "4", "--protocol.starts", "1", "--candidates", '["crops"]']
    arguments = given(home, "sensors", *fit, *small, "--data.limit", "3")
    assert sensors.main(arguments) == 0
    text = (home / "sensors/summary.md").read_text(encoding="utf-8")
    head, _, row = cells_of(text)
    assert row[:2] == ["crops", f"{3 * 64 * 64:,}"]
    # All 16 cells have been visited after 15 shifts.
    assert all(each.startswith("100.0") for name, each in zip(head, row, strict=True) if name.endswith("CP@15"))
    model = home / "sensors/crops/observation.safetensors"
    capsys.readouterr()
    before = model.stat().st_mtime_ns
    assert sensors.main(arguments) == 0
    assert "100.0" in capsys.readouterr().out
    assert model.stat().st_mtime_ns == before


def test_too_few_shifts_for_the_table_are_refused(home, capsys):
    assert sensors.main(given(home, "few", "--protocol.shifts", "9")) == 1
    assert "protocol.shifts: expected 15 or more, got 9" in capsys.readouterr().err


def search_by_loop(run, index, target, rule, stop, shifts):
    """One search in scalars; ties go to the first cell."""
    grid, annotation = run.grid(index), run.scenes.annotation(index)
    goal = grid.footprint(annotation.boxes[annotation.labels == target]).any(0)
    view, cell = run.eye.open(run.scenes[index].image[None]), int(grid.cell_of(grid.extent / 2))
    beta, visited, on = np.ones((len(grid), len(run.scenes.classes) + 1)), [], []
    while True:
        visited.append(cell)
        on.append(bool(goal[cell]))
        seen = run.eye.look(view, grid.centres[cell])
        for box, scores in zip(seen.boxes[0], seen.scores[0].double().numpy(), strict=True):
            for covered in grid.footprint(box[None])[0].nonzero()[:, 0].tolist():
                b = beta[covered]
                total, least = (scores * b).sum(), scores.min()
                if rule == "semba":
                    beta[covered] = b * (1 + scores / total / (1 + least / total))
                else:
                    beta[covered] = b * (1 + scores / total) / (1 + least / total)
        probability = beta[:, target] / beta.sum(-1)
        stopped = probability[cell] >= stop
        if stopped or len(visited) > shifts:
            found = [any(on[: n + 1]) for n in (1, 3, 6)]
            return [*found, stopped, stopped and on[-1]]
        cell = int(np.where(np.isin(np.arange(len(grid)), visited), -1, probability).argmax())


def test_the_searcher_of_semba_equals_a_loop(home):
    photographs = home / "photographs"
    config = _SembaConfig(
        data=DataConfig(photographs, photographs / "instances.json", min_instances=0),
        detector=DetectorConfig(str(home / "colours.onnx"), background="none"),
        sensor=SensorConfig("multi-scale", **CROPS),
        belief=BeliefConfig(columns=5, rows=4, prior=1.0),
        protocol=ProtocolConfig(shifts=6, ties="first"),
        stop=0.3,
        cache=home / "cache",
        out=home / "semba",
    )
    run, stopped = Looking(config), 0
    for index in range(2):
        results = _search_scene(config, run, index)
        grid, annotation = run.grid(index), run.scenes.annotation(index)
        middle = grid.footprint(annotation.boxes)[:, int(grid.cell_of(grid.extent / 2))]
        targets = [t for t in run.scenes.targets(index) if not bool(middle[annotation.labels == t].any())]
        assert len(results) == len(targets) > 0
        for target, result in zip(targets, results, strict=True):
            for number, rule in enumerate(("kaplan", "semba")):
                expected = search_by_loop(run, index, target, rule, 0.3, 6)
                assert result[number].tolist() == [float(each) for each in expected]
                stopped += expected[-2]
    assert stopped > 0


def test_the_command_writes_its_table(home, capsys):
    few = ["--data.limit", "3", "--sensor.settings.side", "64", "--belief.columns", "7", "--belief.rows", "5"]
    assert semba.main(given(home, "semba", *few)) == 0
    assert "| semba" in capsys.readouterr().out
    assert (home / "semba/summary.md").read_text(encoding="utf-8").startswith("7 searches in 3 photographs")
