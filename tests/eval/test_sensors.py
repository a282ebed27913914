"""Sensors compared at equal pixels of the detector, and the searcher of SemBA."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from eval import semba, sensors
from eval.semba import _BilinearFovea, _Inhibited, _search_scene, _SembaConfig
from semfov import Eye, Grid
from semfov.runs.config import BeliefConfig, DataConfig, DetectorConfig, ProtocolConfig, SensorConfig
from semfov.runs.looking import Looking
from tests.colours import write_home
from tests.small import cells_of

pytestmark = pytest.mark.usefixtures("few_samples")


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


def crops_in_scalars(eye, view, centre, threshold, limit):
    """Boxes and scores of each crop as in the code of SemBA, with the 2^l of the crops."""
    gaze, crops = view.placement.points_to_canvas(centre[None]), []
    for level, canvas in enumerate(eye.sensor.look(view.state, gaze)):
        found, seen = eye.detector.propose(canvas[None]), []
        confidence = found.classes[0].amax(-1) * (1 if found.objectness is None else found.objectness[0])
        for row in confidence.argsort(descending=True, stable=True)[:limit].tolist():
            odds = found.classes[0, row].double().clamp(1e-12, 1 - 1e-12).numpy()
            scores = odds / (1 - odds) / (odds / (1 - odds)).sum()
            corner = gaze[0] + 0.5 - eye.sensor.side * 2**level / 2
            box = view.placement.boxes_to_image(found.boxes[0, row] * 2**level + corner.repeat(2))
            if scores.max() > threshold:
                seen.append((box, scores))
        crops.append(seen)
    return crops


def search_by_loop(run, index, target, rule, stop, shifts, eye=None):
    """One search in scalars; ties go to the first cell. With an eye it is that of the code of SemBA."""
    grid, annotation = run.grid(index), run.scenes.annotation(index)
    goal = grid.footprint(annotation.boxes[annotation.labels == target]).any(0)
    code, eye, selection = eye is not None, eye or run.eye, run.eye.detector.selection
    view, cell = eye.open(run.scenes[index].image[None]), int(grid.cell_of(grid.extent / 2))
    beta, visited, on = np.ones((len(grid), len(run.scenes.classes) + (not code))), [], []
    inhibited, target, empty = set(), target - code, 0

    def inhibit(around):
        for other in range(len(grid)):
            gap = np.abs(np.subtract(divmod(other, grid.columns), divmod(around, grid.columns)))
            inhibited.update([other] if gap.max() <= 1 else [])

    while True:
        visited.append(cell)
        on.append(bool(goal[cell]))
        if code:
            crops = crops_in_scalars(eye, view, grid.centres[cell], selection.threshold, selection.limit)
            looked = [each for crop in crops for each in crop]
            if not all(crops):
                inhibit(cell)
                empty += 1
        else:
            seen = eye.look(view, grid.centres[cell])
            looked = [*zip(seen.boxes[0], seen.scores[0].double().numpy(), strict=True)]
            inhibited.add(cell)
        for box, scores in looked:
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
            return [*found, stopped, stopped and on[-1]], empty
        cell = int(np.where(np.isin(np.arange(len(grid)), [*inhibited]), -1, probability).argmax())
        if code:
            inhibit(cell)


def test_the_searcher_of_semba_equals_a_loop(home):
    photographs = home / "photographs"
    config = _SembaConfig(
        data=DataConfig(photographs, photographs / "instances.json", min_instances=0),
        detector=DetectorConfig(str(home / "colours.onnx"), background="none", threshold=0.9, limit=9),
        sensor=SensorConfig("multi-scale", **CROPS),
        belief=BeliefConfig(columns=7, rows=6, prior=1.0),
        protocol=ProtocolConfig(shifts=6, ties="first"),
        native=300.0,
        stop=0.4,
        cache=home / "cache",
        out=home / "semba",
    )
    run, stopped, empty = Looking(config), 0, 0
    eye, bilinear = (Eye(each, run.eye.detector, reference=300.0) for each in (run.eye.sensor, _BilinearFovea(64, 3)))
    for index in range(2):
        results = _search_scene(config, run, index)
        grid, annotation = run.grid(index), run.scenes.annotation(index)
        middle = grid.footprint(annotation.boxes)[:, int(grid.cell_of(grid.extent / 2))]
        targets = [t for t in run.scenes.targets(index) if not bool(middle[annotation.labels == t].any())]
        assert len(results) == len(targets) > 0
        for target, result in zip(targets, results, strict=True):
            for number, rule in enumerate(("kaplan", "semba")):
                for row, code in ((number, None), (number - 4, eye), (number - 2, bilinear)):
                    expected, nothing = search_by_loop(run, index, target, rule, config.stop, 6, code)
                    assert result[row].tolist() == [float(each) for each in expected]
                    stopped, empty = stopped + expected[-2], empty + nothing
    assert stopped > 0
    assert empty > 0


def test_bilinear_crops_equal_those_that_torch_resizes():
    image, sensor, side, levels = torch.rand(1, 3, 50, 70), _BilinearFovea(12, 4), 12, range(4)
    for x, y in ((20, 30), (3, 47), (69, 1)):
        # Edges of the crops lie between pixels where the fixation does.
        crops = sensor.look(sensor.open(image, torch.ones(1)), torch.tensor([[x - 0.5, y - 0.5]]))
        wide = torch.nn.functional.pad(image, [96] * 4)
        for level, crop in zip(levels, crops, strict=True):
            half = side * 2**level // 2
            square = wide[..., 96 + y - half : 96 + y + half, 96 + x - half : 96 + x + half]
            resized = torch.nn.functional.interpolate(square, (side, side), mode="bilinear")
            torch.testing.assert_close(crop[None], resized, atol=2e-5, rtol=0)


@pytest.mark.parametrize("escape", [False, True])
def test_cells_around_chosen_and_empty_ones_are_not_chosen(escape):
    generator = torch.Generator().manual_seed(3)
    grid, shifts = Grid(9, 8, (90, 80)), 5
    looks = SimpleNamespace(grid=grid)
    choice = _Inhibited(torch.rand(4, shifts, len(grid), generator=generator), looks, escape=escape)
    left, cell = [{*range(len(grid))} for _ in range(4)], torch.tensor([36, 0, 8, 71])
    for shift in range(shifts):
        episodes = torch.arange(4)[shift // 3 :]  # the first one ends early
        looks.cell, looks.empty = cell[episodes], torch.rand(len(episodes), generator=generator) < 0.5
        values = torch.rand(len(episodes), len(grid), generator=generator)
        point, cells = choice(shift, episodes, values, torch.zeros(0), grid.centres)
        assert torch.equal(point, grid.centres[cells])
        for row, (episode, now, chosen) in enumerate(zip(episodes, looks.cell, cells, strict=True)):
            apart = [(grid.centres[:, None] - grid.centres).abs().amax(-1)[each] < 15 for each in (now, chosen)]
            if escape and looks.empty[row]:
                left[episode] -= {*apart[0].nonzero()[:, 0].tolist()}
            assert int(chosen) == max(left[episode], key=lambda each: float(values[row, each]))
            left[episode] -= {*apart[1].nonzero()[:, 0].tolist()}
        cell[episodes] = cells


def test_the_command_writes_its_table(home, capsys):
    few = [
        "--data.limit", "3", "--protocol.shifts", "3", "--sensor.settings.side", "64",
        "--belief.columns", "7", "--belief.rows", "5",
    ]  # fmt: skip
    assert semba.main(given(home, "semba", *few)) == 0
    shown = capsys.readouterr().out
    assert "escape, semba" in shown
    assert "CP@3" in shown
    assert "CP@6" not in shown
    assert (home / "semba/summary.md").read_text(encoding="utf-8").startswith("7 searches in 3 photographs")
