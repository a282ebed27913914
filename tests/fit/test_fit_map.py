"""The fit of the map of all classes: examples and objective against loops, training, evaluation and report."""

import math
from types import SimpleNamespace

import pytest
import torch

from semfov import Grid, MapEvidence
from semfov.belief.look_features import class_features
from semfov.belief.observers import LearnedMap
from semfov.episode import StoredLooks, rollout
from semfov.fit.examples import _ExampleLooks
from semfov.fit.map import (
    FitMapConfig,
    _frequencies,
    _judge_map,
    _make_map_examples,
    _map_report,
    _train_gain,
    _train_map,
    map_objective,
)
from semfov.gaze.acquisition import CloserLook
from semfov.gaze.choice import Given
from tests.small import cells_of, looking

GRID = Grid(4, 4, (640, 480))
CELLS = 16
CLASSES = ("person", "cat", "cup", "motorcycle", "zebra", "banana", "kite", "toaster")


@pytest.fixture(scope="module")
def run():
    """A stand-in for a run with stored looks at four embedded scenes."""
    return looking(CLASSES, GRID, 4)


@pytest.fixture(scope="module")
def examples(run):
    return _make_map_examples(run, 6, 2, 0)


def classes_in(annotation, cell):
    left, top = cell % 4 * 160, cell // 4 * 120
    return {
        label
        for (x, y, z, w), label in zip(annotation.boxes.tolist(), annotation.labels.tolist(), strict=True)
        if x < left + 160 and z > left and y < top + 120 and w > top
    }


def test_examples_match_looks_from_every_cell(run, examples):
    assert len(examples) == 4
    assert examples.features.shape == (4, CELLS, 6, CELLS, 10)
    assert examples.features.dtype == torch.float16
    assert examples.score.shape == (4, CELLS, 6)
    assert examples.answers.shape == (4, CELLS, 7)
    for row in range(4):
        index, targets = int(examples.scene[row]), examples.target[row]
        annotation, seen = run.scenes.annotation(index), run.detections(index)
        features = class_features(seen, GRID.centres, GRID, targets)
        torch.testing.assert_close(examples.features[row].float(), features, atol=2e-3, rtol=2e-3)
        for cell in range(CELLS):
            held = classes_in(annotation, cell)
            assert examples.answers[row, cell].tolist() == [not held, *(t in held for t in targets.tolist())]
            for place, target in enumerate(targets.tolist()):
                shown = [float(seen.scores[cell, d, target]) for d in range(5) if seen.mask[cell, d]]
                assert float(examples.score[row, cell, place]) == pytest.approx(max(shown, default=0.0))
        torch.testing.assert_close(examples.distance[row], torch.cdist(GRID.centres, GRID.centres) / 640)


def test_examples_have_all_present_classes_and_some_that_represent_the_others(run, examples):
    for row in range(4):
        annotation, targets = run.scenes.annotation(int(examples.scene[row])), examples.target[row].tolist()
        assert len(set(targets)) == 6
        assert set(annotation.labels.tolist()) <= set(targets)
        # Four classes, present or with the highest scores, represent themselves; two represent the four others.
        assert examples.stands_for[row].tolist() == [1, 1, 1, 1, 2, 2]
        assert float(examples.stands_for[row].sum()) == len(CLASSES)
    draws = {tuple(_make_map_examples(run, 6, 2, seed).target[0].tolist()) for seed in range(8)}
    assert len(draws) > 1
    assert torch.equal(_make_map_examples(run, 6, 2, 0).target, examples.target)


@pytest.mark.parametrize(("classes", "others"), [(8, 3), (9, 3), (12, 3), (20, 5)])
def test_every_class_represents_itself_when_there_are_few(run, classes, others):
    made = _make_map_examples(run, classes, others, 0)
    assert made.target.shape == (4, 8)
    assert bool((made.stands_for == 1).all())


def test_looks_of_examples_match_stored_looks(run):
    """The beliefs about all classes are equal except for the rounding of features to half precision."""
    examples = _make_map_examples(run, 12, 3, 0)
    torch.manual_seed(1)
    model = MapEvidence(6, 5, components=len(CLASSES) + 1).eval().requires_grad_(False)
    cells = torch.tensor([[3, 7, 1, 12], [0, 15, 14, 2]])
    observer, acquisition = LearnedMap(model), CloserLook(GRID)
    chosen = examples[torch.tensor([0, 3])]
    steps = rollout(_ExampleLooks(chosen, GRID), observer, acquisition, cells[:, 0], Given(cells), most=4)
    beliefs = [step.belief for step in steps]
    for row, scene in enumerate(chosen.scene.tolist()):
        path, order = cells[row : row + 1], chosen.target[row]
        alone = rollout(
            StoredLooks(run.detections(scene), GRID), observer, acquisition, path[:, 0], Given(path), most=4
        )
        for number, step in enumerate(alone):
            stored = step.belief.probabilities[0]
            expected = torch.cat([stored[:, :1], stored[:, order]], -1)
            torch.testing.assert_close(beliefs[number].probabilities[row], expected, atol=5e-3, rtol=5e-3)


def test_frequencies_equal_a_loop_over_cells(run):
    count = dict.fromkeys(range(9), 0)
    for index in (1, 3):
        for cell in range(CELLS):
            for label in classes_in(run.scenes.annotation(index), cell):
                count[label] += 1
    cells = 2 * CELLS
    expected = [math.log((n + 1) / (cells + 2) / (1 - (n + 1) / (cells + 2))) / 4 + 1 for n in count.values()]
    assert _frequencies(run, 2).tolist() == pytest.approx(expected, abs=1e-5)


def test_objective_equals_its_formula(examples):
    generator = torch.Generator().manual_seed(0)
    p = torch.rand(4, CELLS, 7, generator=generator, dtype=torch.float64)
    belief = LearnedMap(MapEvidence(4, 4)).start(4, GRID, p)
    known = belief.map(lambda tensor: p if tensor is belief.probabilities else tensor)
    total = 0.0
    for row in range(4):
        for cell in range(CELLS):
            for place, share in enumerate([1, 1, 1, 1, 1, 2, 2]):
                right = bool(examples.answers[row, cell, place])
                value = float(p[row, cell, place])
                total -= share * math.log(value if right else 1 - value) / CELLS / 4
    assert float(map_objective(SimpleNamespace(belief=known), examples)) == pytest.approx(total, rel=1e-6)


@pytest.mark.usefixtures("one_thread")
def test_training_is_repeatable(examples):
    config, models = FitMapConfig(columns=4, rows=4, steps=6, gain_steps=3, batch=3, looks=3), []
    for seed in (5, 6):
        torch.manual_seed(0)
        model = MapEvidence(4, 4, components=len(CLASSES) + 1)
        torch.manual_seed(seed)  # random numbers drawn elsewhere change nothing
        _train_map(config, model, examples, GRID)
        before = {name: value.clone() for name, value in model.state_dict().items()}
        _train_gain(config, model, examples, GRID)
        for name, value in model.state_dict().items():
            assert bool(value.isfinite().all()), name
            assert torch.equal(value, before[name]) == (not name.startswith("worth")), name
        models.append(model.state_dict())
    assert all(torch.equal(value, models[1][name]) for name, value in models[0].items())


def test_a_map_is_evaluated_after_each_number_of_looks_and_reported(examples):
    config = FitMapConfig(columns=4, rows=4)
    model = MapEvidence(4, 4, components=len(CLASSES) + 1).requires_grad_(False)
    judged = _judge_map(config, model, examples, GRID)
    assert [row["looks"] for row in judged] == [1, 2, 3, 5, 10, 15]
    assert all(math.isfinite(value) for row in judged for value in row.values())
    report = _map_report(judged, 3, 2)
    assert "Trained on 3 photographs and evaluated on 2 held-out" in report
    rows = cells_of(report)[2:]
    for row, cells in zip(judged, rows, strict=True):
        shares = [f"{100 * row[name]:.1f}" for name in ("all", "objects", "objects_without_background")]
        errors = [f"{row[name]:.4f}" for name in ("nll", "ece", "ece_background")]
        assert cells == [str(row["looks"]), *shares, *errors, f"{row['expected']:.2f}", f"{row['brought']:.2f}"]
