"""Cells of a grid, and what a look does to the belief about them: the rules of fusion."""

import itertools
import math
import pickle
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import Detections, Grid, InputError
from semfov.belief import fuse, fusion, likelihoods
from semfov.belief.grid import check_cells
from semfov.belief.observers import Semantic
from tests.refusals import refused

positive = st.floats(0.05, 20.0)
score_lists = st.lists(st.floats(0.0, 1.0), min_size=2, max_size=6).filter(lambda values: max(values) > 1e-3)


def exact_posterior_mean(beta: list[float], likelihood: list[float]) -> list[float]:
    """Mean of the exact posterior, which section III-B says the rule matches.

    By Bayes it is Dir(p | β) Σ_k p_k λ_k, a mixture of the Dirichlets Dir(β + e_k) with weights β_k λ_k.
    """
    total, weights = sum(beta), [b * l for b, l in zip(beta, likelihood, strict=True)]
    return [(b + w / sum(weights)) / (total + 1) for b, w in zip(beta, weights, strict=True)]


def scalar_kaplan(beta: list[float], likelihood: list[float]) -> list[float]:
    """Equation 7 (eq:kaplanrule), in scalars."""
    expected = sum(b * l for b, l in zip(beta, likelihood, strict=True))
    return [b * (1 + l / expected) / (1 + min(likelihood) / expected) for b, l in zip(beta, likelihood, strict=True)]


@given(score_lists, st.data())
def test_kaplan_matches_the_formula_and_the_exact_mean(likelihood, data):
    beta = data.draw(st.lists(positive, min_size=len(likelihood), max_size=len(likelihood)))
    b, l = torch.tensor(beta, dtype=torch.float64), torch.tensor(likelihood, dtype=torch.float64)
    after = fusion.kaplan(b, l)
    torch.testing.assert_close(after, torch.tensor(scalar_kaplan(beta, likelihood), dtype=torch.float64))
    mean = torch.tensor(exact_posterior_mean(beta, likelihood), dtype=torch.float64)
    torch.testing.assert_close(after / after.sum(), mean)
    assert (after >= b).all()
    assert after[l.argmin()] == b[l.argmin()]


@given(score_lists, st.data())
def test_the_rule_of_semba_divides_only_the_second_term(likelihood, data):
    beta = np.array(data.draw(st.lists(positive, min_size=len(likelihood), max_size=len(likelihood))))
    scores = np.array(likelihood)
    expected = beta * (1 + scores / sum(scores * beta) / (1 + min(scores) / sum(scores * beta)))
    scaled = fusion._scale_likelihood(torch.from_numpy(scores))
    after = fusion.RULES["semba"](torch.from_numpy(beta), scaled)
    torch.testing.assert_close(after, torch.from_numpy(expected))
    if min(likelihood) == 0:  # then the two forms are equal
        torch.testing.assert_close(after, fusion.kaplan(torch.from_numpy(beta), torch.from_numpy(scores)))


@pytest.mark.parametrize("rule", [fusion.kaplan, fusion.product, fusion.sum])
def test_rules_ignore_scale_and_order_of_classes_have_gradients_and_refuse_other_likelihoods(rule):
    torch.manual_seed(1)
    beta, likelihood = torch.rand(7, 4).double() + 0.1, torch.rand(7, 4).double()
    after = rule(beta, likelihood)
    torch.testing.assert_close(rule(beta, likelihood * 1e-30), after)
    for order in itertools.permutations(range(4)):
        torch.testing.assert_close(rule(beta[:, order], likelihood[:, order]), after[:, order])
    torch.manual_seed(2)
    beta = (torch.rand(3, 4, dtype=torch.float64) + 0.2).requires_grad_()
    likelihood = (torch.rand(3, 4, dtype=torch.float64) + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(rule, (beta, likelihood))
    beta, likelihood = torch.rand(5, 4) + 0.1, torch.rand(5, 4)
    compiled = torch.compile(rule, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(beta, likelihood), rule(beta, likelihood))
    with pytest.raises(InputError, match=r"^likelihood: expected a tensor of shape \(..., 3\), got \(4, 2\)$"):
        rule(torch.ones(4, 3), torch.ones(4, 2))
    beta, likelihood = np.ones(3), np.array([0.5, 0.2, 0.3])
    with pytest.raises(InputError, match=r"^beta: expected a tensor, got a NumPy array; give torch\.as_tensor\(beta\)"):
        rule(beta, torch.from_numpy(likelihood))
    refused(r"^likelihood: expected a tensor, got a NumPy array", rule, torch.from_numpy(beta), likelihood)


@given(st.lists(score_lists.filter(lambda values: min(values) > 1e-3), min_size=1, max_size=5), st.data())
def test_product_is_bayes_and_sum_is_an_average(looks, data):
    """Over several looks: p_k Π λ, normalised, and the mean of the normalised λ with the prior counting Σβ times."""
    classes = min(len(look) for look in looks)
    looks = [look[:classes] for look in looks]
    beta = data.draw(st.lists(positive, min_size=classes, max_size=classes))
    multiplied = added = start = torch.tensor(beta, dtype=torch.float64)
    joint, shares = list(beta), list(beta)
    for look in looks:
        likelihood = torch.tensor(look, dtype=torch.float64)
        multiplied, added = fusion.product(multiplied, likelihood), fusion.sum(added, likelihood)
        joint = [j * l for j, l in zip(joint, look, strict=True)]
        shares = [s + l / sum(look) for s, l in zip(shares, look, strict=True)]
    torch.testing.assert_close(multiplied / multiplied.sum(), start.new_tensor(joint) / sum(joint))
    torch.testing.assert_close(added / added.sum(), start.new_tensor(shares) / (sum(beta) + len(looks)))


def test_product_and_sum_by_hand():
    beta, likelihood = torch.tensor([1.0, 3.0]), torch.tensor([0.5, 0.25])
    torch.testing.assert_close(fusion.product(beta, likelihood), 5 * torch.tensor([0.5, 0.75]) / 1.25)
    torch.testing.assert_close(fusion.sum(beta, likelihood), beta + torch.tensor([2 / 3, 1 / 3]))


@pytest.mark.parametrize("rule", [fusion.kaplan, fusion.product, fusion.sum])
@pytest.mark.parametrize(
    ("bad", "word"),
    [
        ([0.0, 0.0], "a row of zeros"),
        ([float("nan"), -1.0], "NaN or infinity"),
        ([float("inf"), 1.0], "NaN or infinity"),
        ([-0.1, 1.0], "a negative value"),
    ],
)
def test_unusable_likelihoods_are_refused(rule, bad, word):
    refused(rf"^likelihood: .*, got {word}$", rule, torch.ones(2, 2), torch.tensor([[1.0, 2.0], bad]))


def test_extreme_likelihoods_stay_finite():
    likelihood = torch.tensor([1e-38, 1.0, 3e38])
    for rule in fusion.RULES.values():
        beta = torch.full((3,), 0.5)
        for _ in range(300):
            beta = rule(beta, fusion._scale_likelihood(likelihood))
        assert torch.isfinite(beta).all()
        assert (beta > 0).all()


def fuse_by_loop(beta, likelihood, footprint, rule):
    beta = beta.clone()
    for image in range(beta.shape[0]):
        for detection in range(likelihood.shape[1]):
            for cell in range(beta.shape[1]):
                if footprint[image, detection, cell]:
                    beta[image, cell] = rule(beta[image, cell], likelihood[image, detection])
    return beta


@pytest.mark.parametrize("name", ["kaplan", "product", "sum"])
def test_fuse_equals_the_loop_and_weights_of_the_footprint_are_exponents_of_the_likelihood(name, dtype):
    torch.manual_seed(0)
    beta = torch.rand(3, 6, 5, dtype=dtype) + 0.2
    likelihood = torch.rand(3, 7, 5, dtype=dtype)
    footprint = torch.rand(3, 7, 6) < 0.4
    before = beta.clone()
    got = fuse(beta, likelihood, footprint, name)
    torch.testing.assert_close(got, fuse_by_loop(beta, likelihood, footprint, getattr(fusion, name)))
    assert torch.equal(beta, before)
    beta, likelihood, footprint = (tensor[0] for tensor in stacked_maps(soft=True))
    expected = beta.clone()
    for image, detection, cell in footprint.nonzero().tolist():
        said = (likelihood[image, detection] / likelihood[image, detection].max()) ** footprint[image, detection, cell]
        expected[image, cell] = getattr(fusion, name)(expected[image, cell], said)
    got = fuse(beta, likelihood, footprint.to(dtype), name)
    torch.testing.assert_close(got, expected)
    rows = torch.func.vmap(lambda b, l, f: fuse(b[None], l[None], f[None], name)[0])(
        beta, likelihood, footprint.to(dtype)
    )
    torch.testing.assert_close(rows, expected)


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("rule", sorted(fusion.RULES))
def test_fuse_gives_the_bits_of_each_episode_alone_in_blocks_of_any_size(monkeypatch, rule, soft):
    """Blocks of one episode, of two with one left over, of all; the maps may be strided, and stay as they are."""
    beta = (torch.rand(9, 7, 5).transpose(0, 1) + 0.5)[:, ::2]
    likelihood, footprint = torch.rand(7, 4, 5), torch.rand(7, 4, 5) < 0.5
    footprint[3] = False
    cells = footprint * torch.rand(7, 4, 5) if soft else footprint
    before = beta.clone()
    alone = torch.cat([fuse(*(part[n : n + 1] for part in (beta, likelihood, cells)), rule) for n in range(7)])
    for block in (0, 2 * beta[0].numel(), 1 << 19):
        monkeypatch.setattr(fusion, "_BLOCK", block)
        assert torch.equal(fuse(beta, likelihood, cells, rule), alone)
        learned = beta.clone().requires_grad_()
        fused = fuse(learned, likelihood, cells, rule)
        assert torch.equal(fused.detach(), alone)
        fused.sum().backward()
        assert bool(torch.isfinite(learned.grad).all())
    assert torch.equal(beta, before)
    assert fuse(beta[:0], likelihood[:0], cells[:0], rule).shape == (0, 5, 5)


def test_fuse_changes_nothing_if_detections_cover_no_cell():
    beta = torch.rand(2, 3, 4)
    got = fuse(beta, torch.zeros(2, 5, 4), torch.zeros(2, 5, 3, dtype=torch.bool))
    assert torch.equal(got, beta)
    assert got.data_ptr() != beta.data_ptr()


def stacked_maps(soft):
    """Three batches of two maps, four detections each, the last of which is padding."""
    torch.manual_seed(2)
    beta, likelihood = torch.rand(3, 2, 6, 5) + 0.2, torch.rand(3, 2, 4, 5)
    footprint = torch.rand(3, 2, 4, 6) * (torch.rand(3, 2, 4, 6) < 0.5)
    footprint[:, :, 3] = 0
    likelihood[:, :, 3] = 0
    return beta, likelihood, footprint if soft else footprint > 0


def seen(grid: Grid) -> Detections:
    boxes = torch.tensor([[[0.0, 0, 30, 30], [20, 20, 90, 60], [0, 0, 0, 0]]])
    scores = torch.tensor([[[0.1, 0.6, 0.3], [0.5, 0.1, 0.4], [0, 0, 0]]])
    return Detections(boxes, scores, torch.tensor([[True, True, False]]))


class Sharper:
    """An observation model that squares scores near the fovea and ignores those far away."""

    def calibrate(self, scores, distance):
        return torch.where(distance[..., None] < 0.3, scores**2, torch.ones_like(scores))


def test_likelihoods_of_raw_scores_and_of_a_model_at_the_distance_of_each_box():
    grid = Grid(4, 3, (100, 60))
    fixation = torch.tensor([[10.0, 10.0]])
    near = likelihoods(seen(grid), fixation, grid, Sharper())
    torch.testing.assert_close(near[0, 0], torch.tensor([0.01, 0.36, 0.09]))
    torch.testing.assert_close(near[0, 1], torch.ones(3))
    said = Semantic(3, Sharper()).weigh(seen(grid), fixation, grid)
    assert torch.equal(said.likelihood[0, :2], near[0, :2] / near[0, :2].amax(-1, keepdim=True))
    assert torch.equal(said.footprint[0, :2], grid.footprint(seen(grid).boxes)[0, :2])
    assert not said.footprint[0, 2].any()
    grid = Grid(4, 3, (100, 60))
    raw = likelihoods(seen(grid), torch.tensor([[10.0, 10.0]]), grid)
    assert torch.equal(raw[0, :2], seen(grid).scores[0, :2])
    torch.testing.assert_close(raw[0, 2], torch.full((3,), 1 / 3))
    tempered = likelihoods(seen(grid), torch.tensor([[10.0, 10.0]]), grid, tempering=0.25)
    torch.testing.assert_close(tempered, raw.double().pow(0.25).float())


@pytest.mark.parametrize("batched", [0, 1, 2])
def test_fuse_vectorises_over_one_argument_alone(batched):
    arguments = stacked_maps(soft=True)
    given = [tensor if number == batched else tensor[0] for number, tensor in enumerate(arguments)]
    dims = tuple(0 if number == batched else None for number in range(3))
    together = torch.func.vmap(fuse, in_dims=dims)(*given)
    for row in range(3):
        alone = [tensor[row] if number == batched else tensor for number, tensor in enumerate(given)]
        torch.testing.assert_close(together[row], fuse(*alone))


def test_shapes_and_numbers_that_do_not_fit_are_refused():
    for shape in [(2,), (2, 2), (1, 3)]:
        with pytest.raises(InputError, match=r"^fixation: expected a tensor of shape \(..., 1, 2\)"):
            likelihoods(seen(Grid(4, 3, (100, 60))), torch.zeros(shape), Grid(4, 3, (100, 60)))
    for argument, beta, likelihood, footprint in [
        ("beta", (4, 3), (2, 3), (2, 4)),
        ("likelihood", (1, 4, 3), (2, 2, 3), (1, 2, 4)),
        ("likelihood", (1, 4, 3), (2, 3), (1, 2, 4)),
        ("likelihood", (1, 4, 3), (1, 2, 5), (1, 2, 4)),
        ("footprint", (1, 4, 3), (1, 2, 3), (2, 2, 4)),
        ("footprint", (1, 4, 3), (1, 2, 3), (1, 3, 4)),
        ("footprint", (1, 4, 3), (1, 2, 3), (1, 2, 5)),
        ("footprint", (1, 4, 3), (1, 2, 3), (2, 4)),
    ]:
        with pytest.raises(InputError, match=rf"^{argument}: expected a tensor of shape"):
            fuse(torch.ones(beta), torch.ones(likelihood), torch.ones(footprint))
    refused(".", lambda: Grid(0, 3, (10, 10)))
    for columns, rows in ((2.5, 2), (2, 2.0), (3, -1), (float("inf"), 2)):
        refused("columns, rows: expected whole numbers from 1", lambda cells=(columns, rows): Grid(*cells, (10, 10)))
    for side in (0, -1, float("inf"), float("nan")):
        refused("size: expected a positive width and height", lambda side=side: Grid(3, 3, (10, side)))
    assert len(Grid(np.int64(2), 3, (10, 10))) == 6
    refused(".", lambda: Grid(3, 3, (10, 10, 10)))
    refused(".", lambda: Grid(3, 3, (10, 10)).footprint(torch.zeros(1, 4), "all"))


@pytest.mark.parametrize("value", [0.0, -1.0, float("inf"), float("nan")])
def test_invalid_dirichlet_parameters_are_refused(value):
    beta = torch.tensor([[[1.0, 2.0], [value, 1.0]]])
    with pytest.raises(InputError, match=r"^beta: expected positive, finite Dirichlet parameters"):
        fuse(beta, torch.ones(1, 1, 2), torch.ones(1, 1, 2))
    for rule in (fusion.kaplan, fusion.product, fusion.sum):
        refused(r"^beta: expected positive, finite", rule, beta, torch.ones(2))
        assert rule(torch.zeros(0, 2), torch.zeros(0, 2)).shape == (0, 2)


def test_rules_with_and_without_checks_are_pickled_by_their_names():
    for name, rule in fusion.RULES.items():
        assert pickle.loads(pickle.dumps(rule)) is rule
        assert pickle.loads(pickle.dumps(getattr(fusion, name))) is getattr(fusion, name)


def overlap_by_loop(grid: Grid, size: tuple[int, int], box: list[float]) -> list[bool]:
    width, height = size
    covered = []
    for row in range(grid.rows):
        for column in range(grid.columns):
            left, right = column * width / grid.columns, (column + 1) * width / grid.columns
            top, bottom = row * height / grid.rows, (row + 1) * height / grid.rows
            across = min(right, box[2]) - max(left, box[0])
            down = min(bottom, box[3]) - max(top, box[1])
            covered.append(across > 0 and down > 0)
    return covered


@given(
    st.integers(1, 7),
    st.integers(1, 7),
    st.tuples(st.sampled_from([64, 100, 640]), st.sampled_from([48, 77, 427])),
    st.lists(st.floats(-20, 700, width=32), min_size=4, max_size=4),
)
def test_overlap_equals_the_loop(columns, rows, size, corners):
    (x1, x2), (y1, y2) = sorted(corners[::2]), sorted(corners[1::2])
    box = [x1, y1, x2, y2]
    grid = Grid(columns, rows, size)
    got = grid.footprint(torch.tensor([box], dtype=torch.float64))[0].tolist()
    expected = overlap_by_loop(grid, size, box) if x2 > x1 and y2 > y1 else [False] * len(grid)
    assert got == expected


@pytest.mark.parametrize("rule", ["overlap", "centre", "box_centre"])
def test_footprint_rules(rule):
    grid = Grid(10, 10, (100, 100))
    box = torch.tensor([[12.0, 12, 38, 28], [41, 41, 43, 43], [5, 5, 5, 9], [8, 18, 27, 32]])
    expected = {
        "overlap": [{11, 12, 13, 21, 22, 23}, {44}, set(), {10, 11, 12, 20, 21, 22, 30, 31, 32}],
        "centre": [{11, 12, 13, 21, 22, 23}, {44}, set(), {21, 22}],
        "box_centre": [{22}, {44}, set(), {21}],
    }[rule]
    got = [set(row.nonzero()[:, 0].tolist()) for row in grid.footprint(box, rule)]
    assert got == expected


@pytest.mark.parametrize("size", [(96, 56), torch.tensor([100.0, 60.0]).double()], ids=["exact", "rounded"])
def test_a_cell_as_a_box_covers_only_itself(size):
    """Also where the size of the image has more digits than the box, so that borders are rounded."""
    grid = Grid(6, 7, size)
    assert torch.equal(grid.footprint(grid.edges.float()), torch.eye(42, dtype=torch.bool))


def test_a_centre_on_the_left_or_upper_border_of_a_box_is_inside_and_on_the_others_outside(dtype):
    """The image is a pixel wide, so that errors of half a pixel would show."""
    grid = Grid(6, 7, torch.tensor([1.0, 0.6], dtype=dtype))
    centres, row, column = (grid.centres + 0.5).float(), torch.arange(42) // 6, torch.arange(42) % 6
    far = torch.tensor([1.0, 0.6]).expand(42, 2)
    inside = (column >= column[:, None]) & (row >= row[:, None])
    assert torch.equal(grid.footprint(torch.cat([centres, far], -1), "centre"), inside)
    before = (column < column[:, None]) & (row < row[:, None])
    some = before.any(-1)
    assert torch.equal(grid.footprint(torch.cat([0 * far, centres], -1), "centre")[some], before[some])


def test_soft_weights_are_a_normal_window_inside_the_box():
    grid = Grid(10, 5, (100, 100))
    box = torch.tensor([[12.0, 12.0, 38.0, 58.0], [5.0, 5.0, 5.0, 9.0]], dtype=torch.float64)
    weights = grid.footprint(box, "soft")
    assert torch.equal(weights > 0, grid.footprint(box))
    for cell in grid.footprint(box)[0].nonzero()[:, 0].tolist():
        x, y = 10 * (cell % 10) + 5 - 25, 20 * (cell // 10) + 10 - 35
        expected = math.exp(-(x**2) / (2 * (13**2 + 5**2) / 3) - y**2 / (2 * (23**2 + 10**2) / 3))
        assert float(weights[0, cell]) == pytest.approx(expected)


def test_batch_of_sizes_equals_single_grids():
    sizes = [(640, 480), (300, 500), (90, 90)]
    torch.manual_seed(0)
    corner = torch.rand(3, 5, 2) * 300
    boxes = torch.cat([corner, corner + torch.rand(3, 5, 2) * 200], -1)
    fixation = torch.rand(3, 2) * 300
    batch = Grid(5, 4, torch.tensor(sizes))
    for rule in ("overlap", "centre", "box_centre", "soft"):
        singles = [Grid(5, 4, size).footprint(b, rule) for size, b in zip(sizes, boxes, strict=True)]
        torch.testing.assert_close(batch.footprint(boxes, rule), torch.stack(singles))
    for name in ("centres", "edges", "cell_distance"):
        torch.testing.assert_close(getattr(batch, name)[1], getattr(Grid(5, 4, sizes[1]), name))
    single = Grid(5, 4, sizes[1]).box_distance(boxes[1], fixation[1])
    torch.testing.assert_close(batch.box_distance(boxes, fixation)[1], single)
    torch.testing.assert_close(batch.distance(fixation)[1], Grid(5, 4, sizes[1]).distance(fixation[1]))


def test_centres_edges_and_distances():
    grid = Grid(2, 2, (8, 4))
    assert grid.centres.tolist() == [[1.5, 0.5], [5.5, 0.5], [1.5, 2.5], [5.5, 2.5]]
    assert grid.edges[3].tolist() == [4, 2, 8, 4]
    assert torch.equal(grid.cell_of(grid.centres), torch.arange(4))
    assert Grid(2, 1, (1, 0.5)).centres.tolist() == [[-0.25, -0.25], [0.25, -0.25]]
    grid = Grid(2, 1, (200, 100))
    assert grid.cell_distance.tolist() == [[0, 0.5], [0.5, 0]]
    box = torch.tensor([[90.5, 40.5, 110.5, 60.5]])
    assert grid.box_distance(box, torch.tensor([100.0, 80.0])).tolist() == [pytest.approx(0.15)]


@pytest.mark.parametrize("shape", [(4,), (2, 3), (2, 5)])
def test_boxes_of_the_wrong_shape_are_refused_by_name(shape):
    grid, fixation = Grid(3, 2, (30, 20)), torch.zeros(2)
    for call in (lambda: grid.footprint(torch.zeros(shape)), lambda: grid.box_distance(torch.zeros(shape), fixation)):
        refused(r"^boxes: expected a tensor of shape", call)


@pytest.mark.parametrize("shape", [(), (3,), (2, 1)])
def test_points_of_the_wrong_shape_are_refused_by_name(shape):
    grid, point = Grid(3, 2, (30, 20)), torch.zeros(shape)
    for name, call in (
        ("points", lambda: grid.cell_of(point)),
        ("fixation", lambda: grid.distance(point)),
        ("fixation", lambda: grid.box_distance(torch.zeros(2, 4), point)),
    ):
        refused(rf"^{name}: expected a tensor of shape", call)


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_nan_and_infinity_are_refused_by_name(number):
    grid, box, point = Grid(3, 2, (30, 20)), torch.tensor([[1.0, 2.0, 3.0, 4.0]]), torch.tensor([1.0, number])
    bad = torch.where(box == 3, number, box)
    for name, call in (
        *(("boxes", partial(grid.footprint, bad, rule)) for rule in ("overlap", "centre", "box_centre", "soft")),
        ("boxes", lambda: grid.box_distance(bad, torch.zeros(2))),
        ("fixation", lambda: grid.box_distance(box, point)),
        ("points", lambda: grid.cell_of(point)),
    ):
        refused(rf"^{name}: expected finite numbers", call)


@pytest.mark.parametrize("size", [torch.float32, torch.float64])
def test_results_have_the_dtype_of_the_boxes_and_points(dtype, size):
    grid, boxes = Grid(3, 2, torch.tensor([31.0, 17.0], dtype=size)), torch.tensor([[1.0, 2, 20, 15]], dtype=dtype)
    assert grid.footprint(boxes, "soft").dtype == dtype
    assert grid.distance(boxes[0, :2]).dtype == dtype
    assert grid.box_distance(boxes, boxes[0, :2]).dtype == dtype
    assert grid.footprint(boxes).dtype == grid.footprint(boxes, "centre").dtype == torch.bool
    assert Grid(3, 2, (31, 17)).extent.dtype == torch.get_default_dtype()


@pytest.mark.parametrize("grid", [(1, 1), [200, 1], (3, 200)])
def test_grids_have_two_sides_of_1_to_200_cells(grid):
    check_cells(grid)
    for bad in (grid[:1], (*grid, 1), (0, grid[1]), (grid[0], 201), (1.5, 2), 7):
        refused(r"^grid:", check_cells, bad)


def test_points_and_boxes_near_borders_and_outside():
    grid = Grid(4, 3, (40, 30))
    inside = [[9.4, 5], [9.6, 5], [29.4, 19.4], [29.6, 19.6]]
    assert grid.cell_of(torch.tensor(inside)).tolist() == [0, 1, 6, 11]
    outside = [[-99, -99], [99, -99], [-99, 99], [99, 99], [15, -99], [15, 99], [-99, 15], [99, 15]]
    assert grid.cell_of(torch.tensor(outside).float()).tolist() == [0, 3, 8, 11, 1, 9, 4, 7]
    # Edges of boxes are counted from the image's edge: a centre at 9.9 is in the first cell, at 10.1 in the second.
    boxes = torch.tensor([[8.9, 4, 10.9, 6], [9.1, 4, 11.1, 6], [14, 8.9, 16, 10.9], [14, 9.1, 16, 11.1]])
    assert grid.footprint(boxes, "box_centre").int().argmax(-1).tolist() == [0, 1, 1, 5]
    assert (grid.footprint(boxes, "box_centre").sum(-1) == 1).all()


@pytest.mark.parametrize("rule", fusion.RULES)
@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_the_belief_keeps_its_kind_of_numbers(rule, kind):
    """Whatever those of likelihoods and footprints are."""
    random = torch.Generator().manual_seed(0)
    beta = torch.rand(2, 6, 3, generator=random) + 0.5
    likelihood = torch.rand(2, 4, 3, generator=random)
    footprint = torch.rand(2, 4, 6, generator=random)
    expected = fuse(beta, likelihood, footprint, rule)
    found = fuse(beta.to(kind), likelihood.double(), footprint.double(), rule)
    assert found.dtype == kind
    torch.testing.assert_close(found.float(), expected, rtol=1e-5, atol=1e-6)
