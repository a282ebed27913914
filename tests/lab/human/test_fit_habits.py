"""`python -m eval.human habits`: people's choices against loops, recovered habits, and a run."""

import json
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from PIL import Image

from eval.human import main
from eval.human.habits.gaze_habits import GazeHabits, Habitual
from eval.human.habits.habits import _ORDER, AGES, EDGES, Halves, fit_terms, habits_of
from eval.human.habits.viewings import Choices, choices_in, fixated_cells, values_in
from semfov import Detections, Grid, rollout
from semfov.belief.observers import Semantic
from semfov.data.fixations import Fixations
from semfov.data.scenes import EmbeddedScenes
from semfov.episode import StoredLooks
from semfov.errors import DataError
from semfov.gaze import acquisition
from semfov.gaze.acquisition import NegativeEntropy
from semfov.gaze.choice import drawn_by
from semfov.observation.foveal import FovealObservationModel

GRID = Grid(4, 3, (80, 60))


def people():
    """People who return to a cell, stay in one, leave the picture, are never in it, or look once."""
    cells = ([0, 5, 0, 11], [3, 3, 3], [7, None, 2], [None, None], [4])
    centres = GRID.centres.numpy().astype(np.float64)
    paths = [np.stack([centres[c] if c is not None else np.array([-9.0, 4.0]) for c in row]) for row in cells]
    return [Fixations("a", str(n + 1), path, (80, 60)) for n, path in enumerate(paths)]


def test_choices_equal_a_loop_over_fixations():
    cells, count = fixated_cells(people(), GRID)
    assert count.tolist() == [4, 3, 2, 0, 1]
    choices = choices_in(cells, count, GRID, 6, torch.arange(1, 6))
    expected = []
    for subject, row in enumerate(([0, 5, 0, 11], [3, 3, 3], [7, 2]), 1):
        for number in range(len(row) - 1):
            past = row[: number + 1]
            age = [past[::-1].index(x) if x in past else math.inf for x in range(12)]
            expected.append((6, subject, row[number], row[number + 1], age))
    assert len(choices) == len(expected) == 6
    columns = choices.picture, choices.subject, choices.cell, choices.next_cell, choices.age
    assert [tuple(each.tolist() for each in row) for row in zip(*columns, strict=True)] == expected
    some = choices[choices.subject == 2]
    assert Choices.join([some, some]).next_cell.tolist() == [3, 3, 3, 3]


def random_detections():
    generator = torch.Generator().manual_seed(5)
    corner = torch.rand(12, 2, 2, generator=generator) * 50
    scores = torch.rand(12, 2, 3, generator=generator)
    boxes = torch.cat([corner, corner + 20], -1)
    return Detections(boxes, scores / scores.sum(-1, keepdim=True), torch.ones(12, 2, dtype=torch.bool))


def test_values_match_the_beliefs_of_each_person():
    """Person by person, look by look."""
    model = FovealObservationModel(1 + 3 * torch.rand(3, 2, 3), [0.4], ["cup", "cat"]).requires_grad_(False)
    observer, value, seen = Semantic(3), NegativeEntropy(model, GRID), random_detections()
    cells, count = fixated_cells(people(), GRID)
    got = values_in(StoredLooks(seen, GRID), observer, lambda cell: value, cells, count)
    expected = []
    for row in ([0, 5, 0, 11], [3, 3, 3], [7, 2]):
        belief = observer.start(1, GRID, seen.scores)
        for cell in row[:-1]:
            look = observer.weigh(seen[cell : cell + 1], GRID.centres[cell : cell + 1], GRID)
            belief = observer.update(belief, look)
            expected.append(value(belief, torch.zeros(1, 12, dtype=torch.bool)))
    torch.testing.assert_close(got, torch.cat(expected))


def simulate(habits, grid, pictures=8, subjects=12, length=10):
    """Scanpaths of people with these habits, in pictures that each have other values."""
    found = []
    for number in range(pictures):
        generator = torch.Generator().manual_seed(number)
        values = torch.randn(len(grid), generator=generator)
        nothing = Detections(
            torch.zeros(len(grid), 1, 4), torch.zeros(len(grid), 1, 3), torch.zeros(len(grid), 1, dtype=torch.bool)
        )
        choice = Habitual(drawn_by(generator, len(grid), values), habits, grid)
        start = torch.randint(len(grid), (subjects,), generator=generator)
        looks, look_at = StoredLooks(nothing, grid), acquisition.Static(values)
        steps = rollout(looks, Semantic(3), look_at, start, choice, most=length)
        cells = torch.stack([step.cell for step in steps], 1)
        count = torch.full((subjects,), length)
        choices = choices_in(cells, count, grid, number, torch.arange(subjects))
        right = values.expand(len(choices), len(grid))
        found.append(replace(choices, values={"right": right, "wrong": torch.randn(right.shape, generator=generator)}))
    return Choices.join(found)


def test_fit_recovers_simulated_habits_and_true_terms_improve_it():
    grid = Grid(5, 4, (100, 80))
    place = -((grid.centres - grid.centres.mean(0)) / 40).square().sum(-1)
    step = torch.tensor([-2.0, 1.0, 1.0, 0.5, 0.0, -0.5, -1.0, -2.0])
    true = GazeHabits(1.2, place, step, EDGES, torch.tensor([-1.5, -1.0, -0.5, -0.3, 0.0]), AGES, 5)
    halves = Halves.of(simulate(true, grid, pictures=24, subjects=24), grid, smoothing=1.0)
    assert not set(halves.fitted.subject.tolist()) & set(halves.held_out.subject.tolist())
    assert not set(halves.fitted.picture.tolist()) & set(halves.held_out.picture.tolist())
    right, wrong, none = (fit_terms(halves, name, 1.0) for name in ("right", "wrong", None))
    gains = [model.gain for model in right]
    assert gains[1] < gains[2] < gains[3]
    assert right[-1].gain > none[-1].gain + 5 * right[-1].error / 2
    assert abs(float(wrong[-1].weights[0])) < 0.1
    habits = habits_of(right[-1], halves)
    assert float(habits.pull) == pytest.approx(1.2, abs=0.15)
    # Tables are determined up to a constant.
    seen = torch.tensor([0, 4, 5, 6, 7])  # bins of step length that occur on the grid
    torch.testing.assert_close((habits.step - habits.step[3])[seen], (step - step[3])[seen], rtol=0, atol=0.3)
    torch.testing.assert_close(habits.back, true.back, rtol=0, atol=0.45)


def test_the_centre_bias_has_no_gain_over_itself():
    grid = Grid(5, 4, (100, 80))
    flat = GazeHabits(0.0, torch.zeros(20), torch.zeros(8), EDGES, torch.zeros(5), AGES, 5)
    halves = Halves.of(simulate(flat, grid), grid, smoothing=1.0)
    first = fit_terms(halves, None, 1.0)[0]
    assert first.terms == ("centre",)
    assert (first.gain, first.error) == (0, 0)
    assert first.fitted == pytest.approx(0, abs=0.1)


def test_too_few_people_or_pictures_are_refused():
    grid = Grid(5, 4, (100, 80))
    flat = GazeHabits(0.0, torch.zeros(20), torch.zeros(8), EDGES, torch.zeros(5), AGES, 5)
    with pytest.raises(DataError, match="two people and two pictures"):
        Halves.of(simulate(flat, grid, pictures=1), grid, 1.0)


def write_viewing(folder, pictures=4, subjects=4):
    """Save embedded scenes as files, with random fixations in them."""
    scenes = EmbeddedScenes(("person",), count=pictures, seed=0)
    generator, record = np.random.default_rng(0), {}
    for number in range(pictures):
        image = (scenes[number].image * 255).byte().permute(1, 2, 0).numpy()
        Image.fromarray(image).resize((800, 600)).save(folder / f"{number}.png")
        drawn = generator.uniform(0, 599, (subjects, 2, 5)).tolist()
        record[f"{number}.png"] = [{"x": x, "y": y, "duration_ms": [200] * 5} for x, y in drawn]
    (folder / "fixations.json").write_text(json.dumps(record))
    return ["--root", str(folder), "--fixations", str(folder / "fixations.json"), "--cache", str(folder / "cache")]


@pytest.mark.slow
@pytest.mark.weights
def test_a_run_writes_a_model_and_a_report(tmp_path, capsys):
    given = write_viewing(tmp_path)
    small = ["--belief.columns", "4", "--belief.rows", "3", "--policies", "[kl-raw,vocus2-raw]"]
    assert main(["habits", *given, *small, "--out", str(tmp_path / "out")]) == 0
    habits = GazeHabits.from_pretrained(tmp_path / "out/yolov3-tiny.safetensors")
    assert len(habits.place) == 12
    assert habits.metadata["policy"] in ("kl-raw", "vocus2-raw")
    assert habits.metadata["fitted_choices"] == habits.metadata["held_out_choices"] == 2 * 2 * 4
    figures = json.loads((tmp_path / "out/bits.json").read_text())
    assert [(row["policy"], tuple(row["terms"])) for row in figures[3:7]] == [
        ("kl-raw", _ORDER[:number]) for number in range(1, 5)
    ]
    text = (tmp_path / "out/report.md").read_text()
    assert "evaluated on 16 fixations of 2 other people in 2 other pictures" in text
    # With few fixations the penalty on the weights matters, but no term lowers the fit of the fitted half.
    for rows in (figures[:3], figures[3:7], figures[7:]):
        assert all(more["fitted"] >= less["fitted"] - 0.1 for less, more in pairwise(rows))
    assert main(["habits", *given, *small, "--save", "kl-rw", "--out", str(tmp_path / "out")]) == 1
    assert "did you mean 'kl-raw'" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.weights
def test_pictures_of_another_size_are_refused(tmp_path, capsys):
    given = write_viewing(tmp_path, pictures=2)
    Image.new("RGB", (640, 480)).save(tmp_path / "1.png")
    assert main(["habits", *given, "--policies", "[vocus2-raw]", "--out", str(tmp_path / "out")]) == 1
    assert "expected all pictures to have 800 × 600 pixels, got another size for 1.png" in capsys.readouterr().err
