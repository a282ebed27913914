"""Closer looks judged in other ways: the chain against loops over its formula, and the table of the rules."""

import math

import pytest
import torch

from eval.closer import JudgedLook, chain_at_place, chain_in_cells, compare
from semfov import DataError, Detections
from semfov.belief.grid import Grid
from tests.small import search_model

GRID = Grid(2, 2, (20, 20))
BOXES = [[1.0, 1.0, 8.0, 8.0], [12.0, 1.0, 19.0, 9.0], [2.0, 2.0, 9.0, 9.0]]


def look_of(scores, boxes=BOXES, count=None):
    """The detections of a closer look; those after `count` are padding."""
    mask = torch.arange(len(boxes)) < (len(boxes) if count is None else count)
    return Detections(torch.tensor(boxes).reshape(1, -1, 4), scores[None], mask[None])


def scores_of(count):
    drawn = torch.rand(count, 4, generator=torch.Generator().manual_seed(3)) + 0.05
    return drawn / drawn.sum(-1, keepdim=True)


def log_odds(model, scores, weights, target):
    """Log odds of a target at one place, detection by detection."""
    likelihood = [float(each) for each in model.miss_odds(torch.zeros(()))]
    likelihood[0] = 1.0
    for score, weight in zip(scores, weights, strict=True):
        calibrated = model.calibrate(score, torch.zeros(())).tolist()
        for number in range(1, len(likelihood)):
            likelihood[number] += weight * calibrated[number] / calibrated[0]
    return math.log(likelihood[target] / (sum(likelihood) - likelihood[target]))


@pytest.mark.parametrize("count", [3, 2])
def test_a_detection_counts_in_the_cell_of_its_centre(count):
    model, scores = search_model().requires_grad_(False), scores_of(3)
    in_first = [1.0, 0.0, 1.0 if count == 3 else 0.0]
    found = chain_in_cells(model, look_of(scores, count=count), GRID, 2, torch.tensor([0.0, 0.0, 9.0, 9.0]))
    assert found == pytest.approx(log_odds(model, scores, in_first, 2), abs=1e-4)


def test_a_place_has_the_most_probable_of_its_cells():
    model, scores = search_model().requires_grad_(False), scores_of(3)
    found = chain_in_cells(model, look_of(scores), GRID, 1, torch.tensor([0.0, 0.0, 20.0, 10.0]))
    of_cells = [log_odds(model, scores, weights, 1) for weights in ([1.0, 0.0, 1.0], [0.0, 1.0, 0.0])]
    assert found == pytest.approx(max(of_cells), abs=1e-4)


def test_the_weight_of_a_detection_is_its_overlap_with_the_place():
    model, scores = search_model().requires_grad_(False), scores_of(3)
    found = chain_at_place(model, look_of(scores), 3, torch.tensor(BOXES[0]))
    # Two squares of 7 x 7 px that share 6 x 6.
    assert found == pytest.approx(log_odds(model, scores, [1.0, 0.0, 36 / 62], 3), abs=1e-4)


def test_a_look_without_detections_is_a_miss():
    model = search_model().requires_grad_(False)
    found = chain_at_place(model, look_of(scores_of(0), []), 2, torch.tensor(BOXES[0]))
    assert found == pytest.approx(log_odds(model, [], [], 2), abs=1e-4)
    assert chain_in_cells(model, look_of(scores_of(0), []), GRID, 2, torch.tensor(BOXES[0])) == pytest.approx(found)


def judged(number, right, there):
    """A closer look of which the score there alone tells something."""
    features = torch.zeros(7)
    features[3] = there
    return JudgedLook(number, 0.0, right, right, features, 0.0, 0.0, torch.zeros(2), 0.0, 0.0)


def test_the_table_compares_each_rule_with_the_verification():
    # In each of the four folds half of the places are right.
    rights = [number // 4 % 2 == 0 for number in range(40)]
    looks = [judged(number, right, 3.0 if right else -3.0) for number, right in enumerate(rights)]
    lines = compare(looks, 4).splitlines()
    assert lines[0] == "40 closer looks in 40 photographs; the rules are fitted to other folds."
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    rows = {row[0]: row[1:] for row in cells[2:]}
    assert rows["place: verification, 7 features"][-1] == "+0.000 ± 0.000"
    assert rows["place: score times overlap, 2 numbers"][0] == "1.000"
    # What tells nothing has even odds in each fold.
    area, loss, error, _ = rows["place: chain at the place, 2 numbers"]
    assert (area, loss, error) == ("0.500", f"{math.log(2):.3f}", "0.000")


def test_closer_looks_of_one_kind_are_refused():
    with pytest.raises(DataError, match="expected closer looks at places that hold the target and at others"):
        compare([judged(number, True, 1.0) for number in range(4)], 2)
