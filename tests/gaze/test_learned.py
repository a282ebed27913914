"""The soft choice of a fixation, and the learned policy: against loops, frequencies and its initial policy."""

import math

import pytest
import torch

from semfov import DataError, Grid, InputError
from semfov.belief import DirichletBelief
from semfov.gaze.acquisition import TargetPosterior
from semfov.gaze.learned import LearnedGaze, gaze_features
from semfov.gaze.policies import Learned, Means, named_policy
from semfov.gaze.relaxation import soft_fixation

CELLS, CLASSES, COLUMNS = 12, 5, 4


@pytest.fixture
def belief():
    torch.manual_seed(0)
    return DirichletBelief(torch.rand(3, CELLS, CLASSES, dtype=torch.float64) * 2 + 0.1, torch.rand(3, CELLS).double())


@pytest.fixture
def visited():
    visited = torch.zeros(3, CELLS, dtype=torch.bool)
    visited[0, 5] = visited[1, [0, 7]] = True
    return visited


def test_hard_fixations_are_draws_from_the_softmax():
    torch.manual_seed(0)
    logits = torch.tensor([0.0, 1.0, 5.0, -1.0]).expand(20000, 4)
    visited = torch.tensor([False, False, True, False]).expand_as(logits)
    _, cell = soft_fixation(logits, visited, torch.zeros(4, 2), torch.rand(20000, 4))
    share = torch.bincount(cell, minlength=4) / len(cell)
    torch.testing.assert_close(share, torch.tensor([0.0, 1.0, -torch.inf, -1.0]).softmax(0), atol=0.015, rtol=0)
    assert share[2] == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_hard_fixation_has_the_gradient_of_the_soft_one(visited, dtype):
    torch.manual_seed(0)
    centres, noise = Grid(COLUMNS, 3, (64, 48)).centres.to(dtype), torch.rand(3, CELLS, dtype=dtype)
    logits = torch.randn(3, CELLS, dtype=dtype, requires_grad=True)
    hard, cell = soft_fixation(logits, visited, centres, noise, temperature=0.7)
    soft, same = soft_fixation(logits, visited, centres, noise, temperature=0.7, hard=False)
    assert torch.equal(hard, centres[cell])
    assert torch.equal(cell, same)
    assert not visited.gather(1, cell[:, None]).any()
    weight = torch.randn(3, 2, dtype=dtype)
    gradients = [torch.autograd.grad((point * weight).sum(), logits)[0] for point in (hard, soft)]
    assert torch.equal(*gradients)
    assert gradients[0].abs().max() > 0.1


def test_soft_fixation_gradcheck(visited):
    torch.manual_seed(0)
    centres, noise = Grid(COLUMNS, 3, (64, 48)).centres.double(), torch.rand(3, CELLS).double()
    logits = torch.randn(3, CELLS, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: soft_fixation(x, visited, centres, noise, hard=False)[0], logits)


def test_soft_fixations_at_low_temperature_are_cell_centres(visited):
    torch.manual_seed(0)
    centres, noise = Grid(COLUMNS, 3, (64, 48)).centres, torch.rand(3, CELLS)
    noise[0, 0], noise[1, 1] = 0.0, 1.0  # ends of the range
    soft, cell = soft_fixation(torch.randn(3, CELLS), visited, centres, noise, temperature=1e-4, hard=False)
    torch.testing.assert_close(soft, centres[cell])


def test_features_equal_a_loop(belief, visited):
    target = torch.tensor([1, 4, 2])
    features = gaze_features(belief, visited, target, COLUMNS)
    for b in range(3):
        t = int(target[b])
        p = [[float(v / row.sum()) for v in row] for row in belief.beta[b]]
        least = min(float(row.sum()) for row in belief.beta[b])
        best = max(math.log(p[x][t]) for x in range(CELLS) if not visited[b, x])
        for x in range(CELLS):
            u, v = (2 * (x % COLUMNS) + 1) / COLUMNS - 1, (2 * (x // COLUMNS) + 1) / 3 - 1
            expected = [
                math.log(CLASSES * p[x][t]),
                math.log(CLASSES * p[x][0]),
                math.log(CLASSES * max(p[x][k] for k in range(1, CLASSES) if k != t)),
                math.log(p[x][t]) - best,
                1 + sum(q * math.log(q) for q in p[x]) / math.log(CLASSES),
                float(belief.beta[b, x].sum()) - least,
            ]
            expected = [math.asinh(100 * value) / 2 for value in expected]
            expected += [
                4 * float(belief.closest[b, x]),
                float(visited[b, x]),
                int(visited[b].sum()) / 5,
                u * u + v * v,
                v,
                1.0,
            ]
            assert features[b, x].tolist() == pytest.approx(expected, abs=1e-6)


def test_a_new_gaze_orders_cells_as_non_predictive_search(belief, visited):
    gaze = LearnedGaze().double()
    target = torch.tensor([1, 4, 2])
    grid = Grid(COLUMNS, 3, (64, 48))
    values = Learned(gaze)(target, grid)(belief, visited)
    assert torch.equal(named_policy("learned", "search", Means(gaze=gaze))(target, grid)(belief, visited), values)
    assert values.shape == (3, CELLS)
    assert torch.equal(values.argsort(), TargetPosterior(target)(belief, visited).argsort())


def test_values_do_not_depend_on_the_order_of_classes(belief, visited):
    torch.manual_seed(1)
    gaze = LearnedGaze().double()
    torch.nn.init.normal_(gaze.network[-1].weight)
    order = torch.tensor([0, 3, 1, 4, 2])
    renamed = DirichletBelief(belief.beta[..., order], belief.closest)
    torch.testing.assert_close(gaze(renamed, visited, 1, COLUMNS), gaze(belief, visited, 3, COLUMNS))
    assert not torch.allclose(gaze(belief, visited, 1, COLUMNS), gaze(belief, visited, 3, COLUMNS))


def test_values_are_finite_when_all_cells_are_visited(belief):
    single = DirichletBelief(belief.beta.float(), belief.closest.float())
    assert LearnedGaze()(single, torch.ones(3, CELLS, dtype=torch.bool), 1, COLUMNS).isfinite().all()


def test_save_and_load(tmp_path, belief, visited):
    torch.manual_seed(2)
    gaze = LearnedGaze(6, belief={"tempering": 0.5}, metadata={"detector": {"name": "d", "digest": "x"}})
    torch.nn.init.normal_(gaze.network[-1].weight)
    gaze.save(tmp_path / "g.safetensors")
    again = LearnedGaze.from_pretrained(tmp_path / "g.safetensors")
    assert again.metadata == gaze.metadata
    assert again.observer(3).tempering == 0.5
    assert torch.equal(again.double()(belief, visited, 1, COLUMNS), gaze.double()(belief, visited, 1, COLUMNS))
    with pytest.raises(InputError, match="learned gaze policy was fitted for 'd'"):
        again.check_compatible({"detector": {"name": "d", "digest": "y"}, "sensor": {}})
    (tmp_path / "g.safetensors").write_bytes(b"no")
    with pytest.raises(DataError, match="readable"):
        LearnedGaze.from_pretrained(tmp_path / "g.safetensors")


def test_wrong_arguments():
    with pytest.raises(InputError, match="target"):
        Learned(LearnedGaze())(None, Grid(2, 2, (4, 4)))
    with pytest.raises(InputError, match="policy 'learned': expected a learned gaze policy"):
        named_policy("learned", "search")
    zeros = torch.zeros(1, 3)
    with pytest.raises(InputError, match="temperature"):
        soft_fixation(zeros, zeros > 0, torch.zeros(3, 2), zeros, temperature=0.0)
    with pytest.raises(InputError, match="centres"):
        soft_fixation(zeros, zeros > 0, torch.zeros(4, 2), zeros)
