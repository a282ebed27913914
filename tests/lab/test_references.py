"""Maps from one unfoveated pass: painted and fused maps, and counts of right cells, against loops."""

import numpy as np
import pytest
import torch

from eval.explore.episodes import counts_of
from eval.explore.run import FUSED, PAINTED, _sharp_maps
from semfov import Detections, Grid
from tests.small import kaplan

GRID = Grid(5, 4, (100, 60))


def random_detections(seed=0, most=6, dtype=torch.float32, device=None):
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(1, most, 2, generator=generator) * torch.tensor([75.0, 45])
    boxes = torch.cat([corner, corner + 2 + torch.rand(1, most, 2, generator=generator) * 35], -1)
    scores = (5 * torch.rand(1, most, 4, generator=generator)).softmax(-1)
    mask = torch.rand(1, most, generator=generator) < 0.7
    return Detections(boxes.to(device, dtype), scores.to(device, dtype), mask.to(device))


def covers(box, cell):
    left, top = cell % 5 * 20, cell // 5 * 15
    return box[0] < left + 20 and box[2] > left and box[1] < top + 15 and box[3] > top


def valid_detections(sharp):
    rows = zip(sharp.boxes[0].tolist(), sharp.scores[0].tolist(), sharp.mask[0].tolist(), strict=True)
    return [(box, scores) for box, scores, real in rows if real]


@pytest.mark.parametrize("seed", range(4))
def test_maps_equal_loops_over_cells_and_detections(seed, dtype, device):
    sharp = random_detections(seed, dtype=dtype, device=device)
    maps = _sharp_maps(sharp, GRID)
    assert set(maps) == {FUSED, PAINTED}
    for probabilities in maps.values():
        assert probabilities.shape == (1, 20, 4)
        assert probabilities.dtype == dtype
        assert probabilities.device.type == device.type
    for cell in range(20):
        painted, beta = [0.2, 0.0, 0.0, 0.0], np.full(4, 0.5)
        for box, scores in valid_detections(sharp):
            if covers(box, cell):
                painted[1:] = [max(pair) for pair in zip(painted[1:], scores[1:], strict=True)]
                beta = kaplan(beta, np.array(scores))
        assert maps[PAINTED][0, cell].tolist() == pytest.approx(painted, abs=1e-6)
        assert maps[FUSED][0, cell].tolist() == pytest.approx((beta / beta.sum()).tolist(), abs=1e-5)


@pytest.mark.parametrize("most", [0, 3])
def test_maps_without_detections_are_background_or_uniform(most):
    nothing = Detections(torch.zeros(1, most, 4), torch.rand(1, most, 4), torch.zeros(1, most, dtype=torch.bool))
    maps = _sharp_maps(nothing, GRID)
    expected = torch.tensor([0.2, 0, 0, 0]).expand(1, 20, -1)
    torch.testing.assert_close(maps[PAINTED], expected)
    torch.testing.assert_close(maps[FUSED], torch.full((1, 20, 4), 0.25))


def counts_by_loop(probabilities, answers):
    """Right cells with background as an answer, without it, and over the whole grid; ties give no answer."""
    totals = [0, 0, 0]
    for p, right in zip(probabilities.tolist(), answers.tolist(), strict=True):

        def best(values):
            return values.index(max(values)) if values.count(max(values)) == 1 else None

        named, without = best(p), best(p[1:])
        totals[0] += named is not None and right[named]
        totals[1] += without is not None and right[without + 1]
        totals[2] += named is not None and (right[named] if named else not any(right))
    return totals


@pytest.mark.parametrize("seed", range(5))
def test_counts_equal_a_loop_over_cells(seed, device):
    """Ties are included: rounded probabilities often share the maximum."""
    generator = torch.Generator().manual_seed(seed)
    probabilities = (torch.rand(6, 40, 4, generator=generator) * 4).round() / 4
    probabilities[0] = torch.rand(40, 4, generator=generator)
    answers = torch.rand(40, 4, generator=generator) < 0.3
    answers[:, 0] = False
    got = counts_of(probabilities.to(device), answers.to(device))
    assert [tuple(each.shape) for each in got.values()] == [(6,)] * 3
    expected = [counts_by_loop(rows, answers) for rows in probabilities]
    assert torch.stack([*got.values()], 1).tolist() == expected
    assert all(sum(column) > 0 for column in zip(*expected, strict=True))
