"""The fit of the tempering of likelihoods: its hit rate against a loop."""

import pytest
import torch

from semfov import Detections, Grid
from semfov.belief.observers import Semantic
from semfov.fit.tempering import hit_rate


def looks(count, boxes=3, classes=4):
    generator = torch.Generator().manual_seed(count)
    corner = torch.rand(count, boxes, 2, generator=generator) * 60
    size = 5 + 30 * torch.rand(count, boxes, 2, generator=generator)
    scores = torch.rand(count, boxes, classes + 1, generator=generator)
    full = torch.ones(count, boxes, dtype=torch.bool)
    return Detections(torch.cat([corner, corner + size], -1), scores / scores.sum(-1, keepdim=True), full)


@pytest.mark.parametrize("tempering", [0.3, 1.0])
def test_hit_rate_equals_a_loop_over_looks(tempering):
    grid, seen = Grid(4, 3, (96, 96)), looks(5)
    fixations = torch.tensor([[10.0, 10.0], [80.0, 80.0], [40.0, 30.0], [11.0, 9.0], [60.0, 90.0]])
    targets, goal = torch.tensor([1, 3]), torch.zeros(2, 12, dtype=torch.bool)
    goal[0, [0, 4, 6, 9]] = True
    goal[1, [1, 2, 5, 7]] = True
    observer = Semantic(5, tempering=tempering)
    hits = []
    for target, cells in zip(targets.tolist(), goal, strict=True):
        belief, visited = observer.start(1, grid, seen.scores), set()
        for look, fixation in enumerate(fixations):
            cell = int(grid.cell_of(fixation[None])[0])
            if cells[cell]:
                continue
            belief = observer.update(belief, observer.weigh(seen[look : look + 1], fixation[None], grid))
            visited.add(cell)
            posterior = [float(b[target] / b.sum()) if x not in visited else -1 for x, b in enumerate(belief.beta[0])]
            best = [x for x in range(12) if posterior[x] == max(posterior)]
            hits.append(sum(bool(cells[x]) for x in best) / len(best))
    rate = hit_rate(observer, seen, fixations, grid, targets, goal)
    assert rate == pytest.approx(sum(hits) / len(hits), abs=1e-6)
    assert 0 < rate < 1


def test_a_photograph_whose_first_look_fixates_all_targets_has_no_rate():
    grid, seen = Grid(4, 3, (96, 96)), looks(2)
    goal = torch.ones(1, 12, dtype=torch.bool)
    fixations = torch.tensor([[10.0, 10.0], [80.0, 80.0]])
    assert hit_rate(Semantic(5), seen, fixations, grid, torch.tensor([1]), goal) is None
