"""Searches in cells, against footprints of the grid and closed forms."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from eval.chance import random_search
from eval.human.search.scores import People
from eval.human.search.screens import Screens
from eval.human.search.trials import drawn_searches, goal_rectangle, in_cells, read_searches, shift_found
from semfov import Grid
from semfov.data.fixations import Fixations, write_ruarte
from tests.refusals import unusable

SCREEN = (320, 240)
GRID = Grid(8, 6, SCREEN)


def search(points, box=(90.0, 90.0, 150.0, 110.0), found=None, subject="1", picture="a.jpg", target="cup"):
    return Fixations(picture, subject, np.array(points, dtype=np.float64), SCREEN, None, target, box, found)


@pytest.mark.parametrize("seed", range(5))
def test_goal_cells_are_those_that_the_box_overlaps(seed):
    generator = np.random.default_rng(seed)
    corner = generator.uniform(0, 200, 2)
    box = (*corner, *(corner + generator.uniform(1, 40, 2)))
    left, right, top, bottom = goal_rectangle(search([[0, 0]], box), GRID)
    covered = GRID.footprint(torch.tensor([box]))[0].view(6, 8)
    expected = torch.zeros(6, 8, dtype=torch.bool)
    expected[top : bottom + 1, left : right + 1] = True
    assert torch.equal(covered, expected)


def test_scanpaths_in_cells_merge_repeated_fixations_and_end_at_the_target_of_box_or_flag():
    path = search([[10, 10], [30, 30], [200, 200], [100, 100], [300, 10]])
    assert in_cells(path, GRID).tolist() == [[0, 0], [5, 5], [2, 2]]
    away = search([[10, 10], [200, 200]])
    assert in_cells(away, GRID).tolist() == [[0, 0], [5, 5]]
    assert goal_rectangle(search([[0, 0]], (40.0, 40.0, 80.0, 120.0)), GRID) == (1, 1, 1, 2)
    on = [[0, 0], [100, 100], [0, 0]]
    assert shift_found(search(on), 10) == 1
    assert shift_found(search(on, found=True), 10) == 2
    assert shift_found(search(on, found=False), 10) == -1
    assert shift_found(search(on, found=True), 2) == -1


def test_random_draws_without_return_find_targets_as_often_as_the_formula():
    trials = [search([[0, 0]], picture=f"{number}.jpg") for number in range(3000)]
    drawn = drawn_searches(trials, GRID, (10, 10), np.ones(48), longest=10, seed=0, name="random")
    found = np.array([len(each) - 1 if each.found else -1 for each in drawn])
    goal = goal_rectangle(trials[0], GRID)
    cells = (goal[1] - goal[0] + 1) * (goal[3] - goal[2] + 1)
    expected = random_search(cells, 9, cells=48)
    measured = [(found[found >= 0] <= n).sum() / len(found) for n in range(10)]
    np.testing.assert_allclose(measured, expected, atol=4 * np.sqrt(0.25 / 3000))
    assert all(len({tuple(point) for point in each.points.tolist()}) == len(each) for each in drawn)
    assert {tuple(each.points[0]) for each in drawn} == {tuple(GRID.centres[0].tolist())}


def test_people_are_compared_only_with_other_people():
    pytest.importorskip("sklearn")
    pytest.importorskip("rapidfuzz")
    far, near = [[10, 10], [200, 200], [100, 100]], [[10, 10], [10, 200], [100, 100]]
    people = [search(far, subject="1", found=True), search(near, subject="2", found=True)]
    beside = People(people, GRID, longest=10, bandwidth=30, bootstrap=20)
    ours = beside.score(people)
    assert ours.mismatch == 0
    assert ours.area[0] == pytest.approx((0.5 + 7) / 9)
    assert ours.tfp_auc[0] == 5
    # Each scanpath is a string of three letters; two of them are shared.
    assert ours.mean(4)[0] == pytest.approx(2 / 3)
    assert ours.mean(5)[0] == 1
    same = beside.score([search(far, subject="model", found=True)])
    assert same.mean(4)[0] == pytest.approx((1 + 2 / 3) / 2)
    assert same.multimatch[0] > ours.multimatch[0]


def test_searches_without_a_target_or_box_are_refused(tmp_path):
    unusable("found none", read_searches, tmp_path, SCREEN)
    write_ruarte(tmp_path / "a.json", [Fixations("a.jpg", "1", np.zeros((1, 2)), SCREEN)])
    unusable(r"a\.jpg: expected a target and its box", read_searches, tmp_path, SCREEN)


def test_a_screen_shows_the_picture_at_the_position_of_the_experiment(tmp_path):
    from PIL import Image

    Image.new("RGB", (120, 120), (255, 0, 0)).save(tmp_path / "000000000007.jpg", quality=95)
    searches = {
        "100000000007.jpg": search([[0, 0]], picture="100000000007.jpg"),
        "other.jpg": search([[0, 0]], picture="other.jpg"),
    }
    screens = Screens([tmp_path], searches, ("person", "cup"))
    assert screens.ids == ["100000000007.jpg"]
    scene = screens[0]
    assert scene.image.shape == (3, 240, 320)
    red = (scene.image[0] > 0.9) & (scene.image[1] < 0.1)
    assert red[:, 40:280].all()
    assert not red[:, :40].any()
    assert not red[:, 280:].any()
    assert screens.targets(0) == [2]
    assert screens.annotation(0).boxes.tolist() == [[90, 90, 150, 110]]
    unknown = {name: SimpleNamespace(**{**vars(each), "target": "unicorn"}) for name, each in searches.items()}
    assert len(Screens([tmp_path], unknown, ("person", "cup"))) == 0
    assert json.dumps(screens.fingerprint)
