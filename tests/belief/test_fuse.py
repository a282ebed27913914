"""Fusing many detections into many maps against a loop over detections and cells."""

import pytest
import torch

from semfov import Detections, Grid
from semfov.belief import fuse, fusion, likelihoods
from semfov.belief.observers import Semantic
from semfov.errors import InputError


def fuse_by_loop(beta, likelihood, footprint, rule):
    beta = beta.clone()
    for image in range(beta.shape[0]):
        for detection in range(likelihood.shape[1]):
            for cell in range(beta.shape[1]):
                if footprint[image, detection, cell]:
                    beta[image, cell] = rule(beta[image, cell], likelihood[image, detection])
    return beta


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["kaplan", "product", "sum"])
def test_fuse_equals_the_loop(name, dtype):
    torch.manual_seed(0)
    beta = torch.rand(3, 6, 5, dtype=dtype) + 0.2
    likelihood = torch.rand(3, 7, 5, dtype=dtype)
    footprint = torch.rand(3, 7, 6) < 0.4
    before = beta.clone()
    got = fuse(beta, likelihood, footprint, name)
    torch.testing.assert_close(got, fuse_by_loop(beta, likelihood, footprint, getattr(fusion, name)))
    assert torch.equal(beta, before)


def test_fused_maps_do_not_depend_on_the_size_of_the_batch():
    torch.manual_seed(0)
    beta, likelihood = torch.rand(40, 100, 81) + 0.2, torch.rand(40, 12, 81)
    footprint = torch.rand(40, 12, 100) < 0.2
    whole = fuse(beta, likelihood, footprint)
    for size in (1, 7):
        parts = [
            fuse(b, l, f)
            for b, l, f in zip(beta.split(size), likelihood.split(size), footprint.split(size), strict=True)
        ]
        assert torch.equal(torch.cat(parts), whole)


def test_fuse_changes_nothing_if_detections_cover_no_cell():
    beta = torch.rand(2, 3, 4)
    got = fuse(beta, torch.zeros(2, 5, 4), torch.zeros(2, 5, 3, dtype=torch.bool))
    assert torch.equal(got, beta)
    assert got.data_ptr() != beta.data_ptr()


@pytest.mark.parametrize("name", ["kaplan", "product", "sum"])
@pytest.mark.parametrize("soft", [False, True])
def test_fuse_vectorises(name, soft):
    beta, likelihood, footprint = stacked_maps(soft)
    expected = torch.stack([fuse(b, l, f, name) for b, l, f in zip(beta, likelihood, footprint, strict=True)])
    together = torch.func.vmap(lambda b, l, f: fuse(b, l, f, name))(beta, likelihood, footprint)
    torch.testing.assert_close(together, expected)


def test_fuse_compiles_to_one_graph():
    """For any number of detections."""
    beta, likelihood, footprint = (tensor[0] for tensor in stacked_maps(soft=True))
    torch.compiler.reset()
    compiled = torch.compile(fuse, fullgraph=True, backend="eager")
    for looks in (4, 3):
        given = beta, likelihood[:, :looks], footprint[:, :looks]
        torch.testing.assert_close(compiled(*given), fuse(*given))


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


def test_a_look_of_the_observer_equals_the_loop():
    grid = Grid(4, 3, (100, 60))
    detections, fixation = seen(grid), torch.tensor([[10.0, 10.0]])
    observer = Semantic(3)
    updated = observer(observer.start(1, grid, detections.scores), detections, fixation, grid)
    footprint = grid.footprint(detections.boxes)
    expected = fuse_by_loop(torch.full((1, 12, 3), 0.5), detections.scores[:, :2], footprint[:, :2], fusion.kaplan)
    torch.testing.assert_close(updated.beta, expected)
    torch.testing.assert_close(updated.probabilities.sum(-1), torch.ones(1, 12))


def test_the_observation_model_gets_the_distance_of_each_box():
    grid = Grid(4, 3, (100, 60))
    fixation = torch.tensor([[10.0, 10.0]])
    near = likelihoods(seen(grid), fixation, grid, Sharper())
    torch.testing.assert_close(near[0, 0], torch.tensor([0.01, 0.36, 0.09]))
    torch.testing.assert_close(near[0, 1], torch.ones(3))
    said = Semantic(3, Sharper()).weigh(seen(grid), fixation, grid)
    assert torch.equal(said.likelihood[0, :2], near[0, :2] / near[0, :2].amax(-1, keepdim=True))
    assert torch.equal(said.footprint[0, :2], grid.footprint(seen(grid).boxes)[0, :2])
    assert not said.footprint[0, 2].any()


def test_likelihoods_of_raw_scores_are_the_scores_and_uniform_for_padding():
    grid = Grid(4, 3, (100, 60))
    raw = likelihoods(seen(grid), torch.tensor([[10.0, 10.0]]), grid)
    assert torch.equal(raw[0, :2], seen(grid).scores[0, :2])
    torch.testing.assert_close(raw[0, 2], torch.full((3,), 1 / 3))
    tempered = likelihoods(seen(grid), torch.tensor([[10.0, 10.0]]), grid, tempering=0.25)
    torch.testing.assert_close(tempered, raw.double().pow(0.25).float())


@pytest.mark.parametrize("shape", [(2,), (2, 2), (1, 3)])
def test_likelihoods_need_one_fixation_for_each_look(shape):
    with pytest.raises(InputError, match=r"^fixation: expected a tensor of shape \(..., 1, 2\)"):
        likelihoods(seen(Grid(4, 3, (100, 60))), torch.zeros(shape), Grid(4, 3, (100, 60)))


def test_a_map_starts_with_the_prior_in_the_given_dtype():
    start = Semantic(2, prior=0.25).start(3, Grid(2, 2, (10, 10)), torch.empty(0, dtype=torch.float64))
    assert torch.equal(start.beta, torch.full((3, 4, 2), 0.25, dtype=torch.float64))
    assert torch.equal(start.closest, torch.full((3, 4), torch.inf, dtype=torch.float64))


def test_bad_input():
    beta = torch.ones(1, 4, 3)
    with pytest.raises(InputError, match="footprint"):
        fuse(beta, torch.ones(1, 2, 3), torch.ones(1, 2, 4, dtype=torch.int64))
    with pytest.raises(InputError, match="fusion rule"):
        fuse(beta, torch.ones(1, 2, 3), torch.ones(1, 2, 4, dtype=torch.bool), "kalman")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["kaplan", "product", "sum"])
def test_weights_of_the_footprint_are_exponents_of_the_likelihood(name, dtype):
    """Row by row: λ to the power of its weight, scaled to a largest value of 1."""
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


@pytest.mark.parametrize("batched", [0, 1, 2])
def test_fuse_vectorises_over_one_argument_alone(batched):
    arguments = stacked_maps(soft=True)
    given = [tensor if number == batched else tensor[0] for number, tensor in enumerate(arguments)]
    dims = tuple(0 if number == batched else None for number in range(3))
    together = torch.func.vmap(fuse, in_dims=dims)(*given)
    for row in range(3):
        alone = [tensor[row] if number == batched else tensor for number, tensor in enumerate(given)]
        torch.testing.assert_close(together[row], fuse(*alone))


@pytest.mark.parametrize(
    ("argument", "beta", "likelihood", "footprint"),
    [
        ("beta", (4, 3), (2, 3), (2, 4)),
        ("likelihood", (1, 4, 3), (2, 2, 3), (1, 2, 4)),
        ("likelihood", (1, 4, 3), (2, 3), (1, 2, 4)),
        ("likelihood", (1, 4, 3), (1, 2, 5), (1, 2, 4)),
        ("footprint", (1, 4, 3), (1, 2, 3), (2, 2, 4)),
        ("footprint", (1, 4, 3), (1, 2, 3), (1, 3, 4)),
        ("footprint", (1, 4, 3), (1, 2, 3), (1, 2, 5)),
        ("footprint", (1, 4, 3), (1, 2, 3), (2, 4)),
    ],
)
def test_shapes_that_do_not_fit_are_refused(argument, beta, likelihood, footprint):
    with pytest.raises(InputError, match=rf"^{argument}: expected a tensor of shape"):
        fuse(torch.ones(beta), torch.ones(likelihood), torch.ones(footprint))


@pytest.mark.parametrize("value", [0.0, -1.0, float("inf"), float("nan")])
def test_invalid_dirichlet_parameters_are_refused(value):
    beta = torch.tensor([[[1.0, 2.0], [value, 1.0]]])
    with pytest.raises(InputError, match=r"^beta: expected positive, finite Dirichlet parameters"):
        fuse(beta, torch.ones(1, 1, 2), torch.ones(1, 1, 2))
    for rule in (fusion.kaplan, fusion.product, fusion.sum):
        with pytest.raises(InputError, match=r"^beta: expected positive, finite"):
            rule(beta, torch.ones(2))
        assert rule(torch.zeros(0, 2), torch.zeros(0, 2)).shape == (0, 2)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ([0.0, 0.0], "a row of zeros"),
        ([float("nan"), -1.0], "NaN or infinity"),
        ([float("inf"), 1.0], "NaN or infinity"),
        ([-0.1, 1.0], "a negative value"),
    ],
)
def test_an_error_says_what_is_wrong_with_likelihoods(bad, words):
    with pytest.raises(InputError, match=rf"^likelihood: .*, got {words}$"):
        fusion.scale_likelihood(torch.tensor([[1.0, 2.0], bad]))
