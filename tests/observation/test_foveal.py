"""The observation model: likelihoods, calibration and fit against explicit Dirichlets; files; compatibility.

Equations are those of Luzio, Bernardino and Moreno (2024), with the labels of the paper's source.
"""

import math
import warnings

import numpy as np
import pytest
import scipy.optimize
import scipy.stats
import torch

from semfov import DirichletStatistics, FovealObservationModel, InputError, dirichlet
from semfov.io.compatibility import NETWORKS, check_same_detector
from semfov.observation.fitting import _estimate_prior, fit_tables
from tests.pretended import GPU, a_gpu, waits
from tests.refusals import refused

CLASSES = ["cup", "cat", "dog"]
EDGES = [0.1, 0.25]
DETECTOR = {
    "name": "toy",
    "digest": "ab" * 32,
    "input_size": [416, 416],
    "background": "residual",
    "selection": {"threshold": 0.02, "iou": 0.5},
}


def table(dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return (torch.randn(4, 3, 4, generator=generator, dtype=torch.float64) * 1.2 + 0.5).exp().to(dtype)


def looks(shape=(5, 7), dtype=torch.float64, seed=1):
    generator = torch.Generator().manual_seed(seed)
    scores = torch.rand(*shape, 4, generator=generator, dtype=torch.float64) ** 3
    scores = scores / scores.sum(-1, keepdim=True)
    return scores.to(dtype), (torch.rand(*shape, generator=generator, dtype=torch.float64) * 0.5).to(dtype)


def draw(alpha, counts, seed=0):
    """Samples of every class and level, and their statistics."""
    rng = np.random.default_rng(seed)
    statistics = DirichletStatistics(alpha.shape[:2], alpha.shape[2])
    for k in range(alpha.shape[0]):
        for d in range(alpha.shape[1]):
            rows = torch.from_numpy(rng.dirichlet(alpha[k, d].numpy(), int(counts[k, d])))
            here = torch.ones(len(rows), dtype=torch.int64)
            statistics.update(rows, (here * k, here * d))
    return statistics


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-4), (torch.float64, 1e-11)])
def test_likelihoods_match_dirichlets_of_scipy(dtype, tolerance):
    model = FovealObservationModel(table(dtype), EDGES, CLASSES)
    scores, distance = looks(dtype=dtype)
    got = model.log_likelihood(scores, distance).detach()
    assert got.dtype == dtype
    assert got.shape == (5, 7, 4)
    for i, j in np.ndindex(5, 7):
        level = int(np.searchsorted(EDGES, float(distance[i, j])))
        point = np.maximum(scores[i, j].double().numpy(), 1e-6)
        for k in range(4):
            alpha = model.alpha[k, level].detach().double().numpy()
            expected = scipy.stats.dirichlet.logpdf(point / point.sum(), alpha)
            assert float(got[i, j, k]) == pytest.approx(expected, rel=tolerance, abs=tolerance)


def test_calibration_with_a_prior_and_tempering_follows_bayes_rule():
    """Equation 11 (eq:corrected_scores), in which the prior is uniform and τ is 1, and beyond."""
    alpha, scores, distance = table(), *looks()
    log_prior = torch.randn(4, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    model = FovealObservationModel(alpha, EDGES, CLASSES, log_prior=log_prior, tempering=0.3)
    level = torch.bucketize(distance, torch.tensor(EDGES, dtype=torch.float64))
    density = torch.distributions.Dirichlet(alpha[:, level].movedim(0, -2)).log_prob(scores[..., None, :])
    joint = (0.3 * density + log_prior[:, level].movedim(0, -1)).exp()
    torch.testing.assert_close(model.calibrate(scores, distance), joint / joint.sum(-1, keepdim=True))
    torch.testing.assert_close(model(scores, distance), model.calibrate(scores, distance))


def test_expected_scores_match_the_means_of_equation_16_and_extremes_neither_overflow_nor_vanish(dtype):
    alpha = torch.full((4, 3, 4), 0.2)
    alpha += 500 * torch.eye(4)[:, None]
    model = FovealObservationModel(alpha, EDGES, CLASSES)
    scores = torch.tensor([[0.0, 1.0, 0.0, 0.0], [0.25] * 4, [1e-30, 0.0, 1.0, 0.0]])
    got = model.calibrate(scores, torch.zeros(3))
    assert bool(got.isfinite().all())
    torch.testing.assert_close(got.sum(-1), torch.ones(3))
    assert got[0].argmax() == 1
    model = FovealObservationModel.identity(CLASSES, EDGES).to(dtype)
    scores, distance = looks(dtype=dtype)
    torch.testing.assert_close(model.calibrate(scores, distance), dirichlet.floor(scores, 1e-6))
    model, alpha = FovealObservationModel(table(), EDGES, CLASSES), table().tolist()
    means = [[[a / sum(row) for a in row] for row in levels] for levels in alpha]
    torch.testing.assert_close(model.expected_scores(), torch.tensor(means, dtype=torch.float64))
    given = torch.full((4, 3, 4), 0.25, dtype=torch.float64)
    fixed = FovealObservationModel(table(), EDGES, CLASSES, expected=given)
    assert torch.equal(fixed.expected_scores(), given)


def test_levels_follow_the_edges_and_the_table_is_copied():
    model = FovealObservationModel(table(torch.float32), EDGES, CLASSES)
    distance = torch.tensor([0.0, 0.1, 0.1001, 0.25, 0.26, 9.0])
    assert model.level(distance).tolist() == [0, 0, 1, 1, 2, 2]
    alpha = table()
    with torch.no_grad():
        FovealObservationModel(alpha, EDGES, CLASSES).log_alpha.zero_()
    assert torch.equal(alpha, table())
    model = FovealObservationModel(table(), EDGES, CLASSES)
    assert model.calibrate(torch.zeros(2, 0, 4).double(), torch.zeros(2, 0).double()).shape == (2, 0, 4)


def test_learned_exponents_change_a_level_and_their_defaults_change_no_bit():
    scores, distance = looks(dtype=torch.float32)
    prior = torch.randn(4, 3, generator=torch.Generator().manual_seed(2))
    plain = FovealObservationModel(table(torch.float32), EDGES, CLASSES, log_prior=prior, tempering=0.3)
    logits = plain.log_likelihood(scores, distance) * plain.tempering + plain.log_prior.t()[plain.level(distance)]
    assert torch.equal(plain.calibrate(scores, distance), logits.softmax(-1))
    changed = torch.tensor([1.0, 0.5, 1.0])
    model = FovealObservationModel(
        table(torch.float32), EDGES, CLASSES, log_prior=prior, tempering=0.3, exponents=changed
    )
    weak = FovealObservationModel(table(torch.float32), EDGES, CLASSES, log_prior=prior, tempering=0.15)
    middle = plain.level(distance) == 1
    assert middle.any()
    torch.testing.assert_close(model.calibrate(scores, distance)[middle], weak.calibrate(scores, distance)[middle])
    assert torch.equal(model.calibrate(scores, distance)[~middle], plain.calibrate(scores, distance)[~middle])


@pytest.mark.parametrize(
    ("cell", "expected"),
    [
        ("abc", "three positive numbers, got 'abc'"),
        (None, "three positive numbers, got None"),
        ((0.1, "1", 0.2), "three positive numbers"),
        ((0.1, 1.0), r"shape \(3,\), got \(2,\)"),
        ((0.1, 1.0, 0.0), r"numbers from e\^-50 to e\^50"),
        ((0.1, math.nan, 0.1), r"numbers from e\^-50 to e\^50"),
        ((0.1, 1.0, 1e23), r"numbers from e\^-50 to e\^50, got .*e\+22"),
    ],
)
def test_numbers_of_cells_that_no_file_could_hold_are_refused(cell, expected):
    refused(f"^cell: expected {expected}", FovealObservationModel, table(), EDGES, CLASSES, cell=cell)


def test_parameters_of_a_search_are_saved_and_files_without_them_are_read(tmp_path):
    model = FovealObservationModel(
        table(), EDGES, CLASSES, exponents=torch.tensor([1.0, 0.5, 2.0]), miss_odds=table()[:, :, 0], refutation=0.7
    )
    model.save(tmp_path / "new.safetensors")
    again = FovealObservationModel.from_pretrained(tmp_path / "new.safetensors")
    for name, value in model.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])
    distance = torch.tensor([0.0, 0.2]).double()
    expected = table()[:, [0, 1], 0].T.index_fill(1, torch.tensor(0), 1.0)
    torch.testing.assert_close(again.miss_odds(distance).detach(), expected)
    old = FovealObservationModel.from_pretrained("yolox-nano-published")
    assert old.log_miss is None
    assert not old.log_exponents.any()
    for name, settings in {
        "exponents": {"exponents": torch.zeros(3)},
        "miss_odds": {"miss_odds": -table()[:, :, 0]},
        "refutation": {"refutation": 1.5},
    }.items():
        refused(name, lambda given=settings: FovealObservationModel(table(), EDGES, CLASSES, **given))


def test_calls_use_the_current_parameters():
    model = FovealObservationModel(table(), EDGES, CLASSES).eval()
    scores, distance = looks()
    with torch.inference_mode():
        first = model.calibrate(scores, distance)
        assert torch.equal(model.calibrate(scores, distance), first)
    optimiser = torch.optim.SGD([model.log_alpha], lr=1.0)
    model.calibrate(scores.requires_grad_(), distance)[..., 0].sum().backward()
    optimiser.step()
    with torch.no_grad():
        changed = model.calibrate(scores, distance)
    assert not torch.allclose(changed, first)
    fresh = FovealObservationModel(model.alpha, EDGES, CLASSES)
    torch.testing.assert_close(changed, fresh.calibrate(scores, distance))
    model.load_state_dict(FovealObservationModel(table(), EDGES, CLASSES).state_dict())
    with torch.no_grad():
        torch.testing.assert_close(model.calibrate(scores, distance), first.clone())
    model.to(torch.float32)
    with torch.no_grad():
        torch.testing.assert_close(model.calibrate(scores.float(), distance.float()), first.float())


@pytest.mark.parametrize("method", ["newton", "fixed_point", "gradient"])
def test_fit_recovers_the_dirichlets_from_many_samples(method):
    alpha = table().clamp(min=0.5)
    statistics = draw(alpha, torch.full((4, 3), 4000))
    model = FovealObservationModel.identity(CLASSES, EDGES).fit(statistics, method=method)
    np.testing.assert_allclose(model.alpha.detach(), alpha, rtol=0.15)
    assert model.metadata["pooled"] == {}
    assert model.metadata["counts"] == statistics.count.tolist()
    assert not model.log_prior.any()
    reference = FovealObservationModel.identity(CLASSES, EDGES).fit(statistics)
    torch.testing.assert_close(model.alpha, reference.alpha, rtol=2e-6, atol=0)


def test_cells_with_few_samples_follow_their_class():
    alpha = table()[:, :1].repeat(1, 3, 1)
    counts = torch.full((4, 3), 3000)
    counts[2, 1] = 0
    counts[3] = 0
    fitted, _, _, record = fit_tables(draw(alpha, counts), shrinkage=10.0)
    assert record["pooled"] == {}
    np.testing.assert_allclose(fitted[2, 1], alpha[2, 1], rtol=0.15)
    torch.testing.assert_close(fitted[3], torch.ones(3, 4, dtype=torch.float64))


def test_fits_without_data_or_of_identical_samples_are_finite():
    model = FovealObservationModel.identity(CLASSES, EDGES)
    with pytest.warns(UserWarning, match="level 0 from levels 0 to 2, level 1 from levels 0 to 2"):
        model.fit(DirichletStatistics((4, 3), 4), prior=True, expected="empirical")
    torch.testing.assert_close(model.alpha, torch.ones(4, 3, 4))
    torch.testing.assert_close(model.expected_scores(), torch.full((4, 3, 4), 0.25))
    torch.testing.assert_close(model.log_prior.exp(), torch.full((4, 3), 0.25))
    statistics = DirichletStatistics((4, 3), 4)
    rows = torch.tensor([[0.0, 1.0, 0.0, 0.0]]).repeat(500, 1)
    statistics.update(rows, (torch.ones(500).long(), torch.zeros(500).long()))
    alpha = fit_tables(statistics, minimum=0)[0]
    assert bool(alpha.isfinite().all())
    assert bool((alpha > 0).all())
    assert alpha[1, 0].argmax() == 1


def test_levels_with_few_objects_are_fitted_with_their_neighbours_and_warn():
    """Level 2 needs level 1; the pool has the sums of both, as if their samples were of one level."""
    counts = torch.full((4, 3), 400)
    counts[1:, 1] = 30
    counts[1:, 2] = 5
    statistics = draw(table(), counts)
    model = FovealObservationModel.identity(CLASSES, EDGES)
    with pytest.warns(UserWarning, match="level 2 from levels 1 to 2$"):
        model.fit(statistics, minimum=90, expected="empirical")
    assert model.metadata["pooled"] == {"2": [1, 2]}
    joint = DirichletStatistics((4, 3), 4)
    joint.count[:, 0], joint.sums[:, :, 0] = statistics.count[:, 0], statistics.sums[:, :, 0]
    joint.count[:, 2], joint.sums[:, :, 2] = statistics.count[:, 1:].sum(1), statistics.sums[:, :, 1:].sum(2)
    alpha, _, expected, _ = fit_tables(joint, minimum=0)
    torch.testing.assert_close(model.alpha[:, 2].double(), alpha[:, 2], rtol=1e-5, atol=0)
    torch.testing.assert_close(model.expected_scores()[:, 2].double(), expected[:, 2], rtol=1e-5, atol=0)
    assert not torch.allclose(model.alpha[:, 1], model.alpha[:, 2], rtol=1e-3)


def test_fewer_objects_than_a_level_needs_are_one_level():
    """Thirteen objects in eight levels: all levels have them all, and none the innermost one's few alone."""
    statistics = DirichletStatistics((4, 8), 4)
    generator = torch.Generator().manual_seed(0)
    rows = torch.rand(13, 4, generator=generator)
    statistics.update(rows / rows.sum(-1, keepdim=True), (torch.arange(13) % 3 + 1, torch.arange(13) % 8))
    with pytest.warns(UserWarning, match="levels with fewer than 100 objects"):
        alpha, _, _, record = fit_tables(statistics, minimum=100)
    assert record["pooled"] == {str(level): list(range(8)) for level in range(8)}
    assert bool((alpha == alpha[:, :1]).all())
    whole = DirichletStatistics((4, 1), 4)
    whole.count, whole.sums = statistics.count.sum(1, keepdim=True), statistics.sums.sum(2, keepdim=True)
    torch.testing.assert_close(alpha[:, :1], fit_tables(whole, minimum=0)[0])


def test_expected_scores_and_prior_are_those_of_the_data():
    statistics = draw(table(), torch.full((4, 3), 500))
    got = fit_tables(statistics, shrinkage=1e-6, minimum=0)[2]
    torch.testing.assert_close(got, statistics.mean, rtol=0, atol=1e-6)
    count = torch.tensor([[9000, 900], [1000, 100], [0, 0]])
    prior = _estimate_prior(count).exp()
    torch.testing.assert_close(prior.sum(0), torch.ones(2, dtype=torch.float64))
    np.testing.assert_allclose(prior[0], [0.9, 0.9], atol=2e-3)
    assert bool((prior > 0).all())


class Toy:
    """The part of a detector that a model needs: its classes and settings."""

    def __init__(self, classes=tuple(CLASSES), **settings):
        self.classes = classes
        self._settings = {**DETECTOR, **settings}

    def settings(self):
        return self._settings


def test_a_matching_detector_is_accepted_and_others_are_not(tmp_path):
    path = tmp_path / "model.safetensors"
    FovealObservationModel(table(), EDGES, CLASSES, metadata={"detector": DETECTOR}).save(path)
    load = FovealObservationModel.from_pretrained
    load(path, detector=Toy())
    load(path, detector=Toy(name="renamed"))
    load(path, detector=Toy(input_size=(416, 416)))
    load(path, detector=Toy(runtime="onnxruntime"))
    refused(r"fitted for 'toy' \(sha256 abab", load, path, detector=Toy(digest="cd" * 32))
    refused("got 'other'", load, path, detector=Toy(name="other", digest=""))
    refused("background policy 'residual' .*, got 'uniform'", load, path, detector=Toy(background="uniform"))
    refused("'cat' as class 2, .*, got 'cow'", load, path, detector=Toy(classes=("cup", "cow", "dog")))
    refused("3 classes, .*, got 2", load, path, detector=Toy(classes=("cup", "cow")))
    with pytest.warns(UserWarning, match=r"input_size is \[320, 320\], the model was fitted with \[416, 416\]"):
        load(path, detector=Toy(input_size=[320, 320]))


def test_settings_of_an_eye_are_checked_too():
    metadata = {"detector": DETECTOR, "sensor": {"sigma": 100.0}}
    model = FovealObservationModel(table(), EDGES, CLASSES, metadata=metadata)
    model.check_compatible({"detector": DETECTOR, "sensor": {"sigma": 100.0}}, CLASSES)
    with pytest.warns(UserWarning, match=r"another sensor: sigma is 50.0"):
        model.check_compatible({"detector": DETECTOR, "sensor": {"sigma": 50.0}}, CLASSES)
    refused("background", model.check_compatible, background="none")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        FovealObservationModel(table(), EDGES, CLASSES).check_compatible({"detector": DETECTOR}, CLASSES)


@pytest.mark.parametrize(
    "call",
    [
        lambda: FovealObservationModel(table()[:, :2], EDGES, CLASSES),
        lambda: FovealObservationModel(table() * 0, EDGES, CLASSES),
        lambda: FovealObservationModel(table(), EDGES, [CLASSES[0], *CLASSES[:2]]),
        lambda: FovealObservationModel.identity(["cup", "cup"], [0.1]),
        lambda: FovealObservationModel(table() * torch.nan, EDGES, CLASSES),
        lambda: FovealObservationModel(table(), [0.3, 0.2], CLASSES),
        lambda: FovealObservationModel(table(), [0.0, 0.2], CLASSES),
        lambda: FovealObservationModel(table(), EDGES, CLASSES, epsilon=0.0),
        lambda: FovealObservationModel(table(), EDGES, CLASSES, tempering=0.0),
        lambda: FovealObservationModel(table(), EDGES, CLASSES, log_prior=torch.zeros(3)),
        lambda: FovealObservationModel(table(), EDGES, CLASSES).calibrate(torch.ones(3) / 3, torch.tensor(0.1)),
        lambda: FovealObservationModel(table(), EDGES, CLASSES).calibrate(torch.ones(2, 4) / 4, torch.tensor(0.1)),
        lambda: FovealObservationModel(table(), EDGES, CLASSES).calibrate(-torch.ones(4), torch.tensor(0.1)),
        lambda: FovealObservationModel(table(), EDGES, CLASSES).fit(DirichletStatistics((4, 2), 4)),
        lambda: FovealObservationModel(table(), EDGES, CLASSES).fit(DirichletStatistics((4, 3), 4, epsilon=1e-4)),
        lambda: FovealObservationModel(table(), EDGES, CLASSES).fit(DirichletStatistics((4, 3), 4), expected="both"),
    ],
)
def test_bad_arguments_are_named(call):
    refused("expected", call)


def test_conversions_of_one_checkpoint_count_as_one_detector():
    pair = sorted(digest for digest, name in NETWORKS.items() if name == "yolox-nano")
    check_same_detector({"name": "yolox-nano", "digest": pair[0]}, {"name": "yolox-nano", "digest": pair[1]}, "model")


@pytest.mark.parametrize(
    ("digest", "said"),
    [
        ("0" * 64, r"got the file of another network under this name; give its own file as weights=, or fit"),
        (
            next(digest for digest, name in NETWORKS.items() if name == "nanodet-plus-m-1.5x"),
            "got the file of 'nanodet-plus-m-1.5x' under this name; name the detector 'nanodet-plus-m-1.5x', with this",
        ),
    ],
)
def test_the_file_of_another_network_is_named(digest, said):
    own = next(digest for digest, name in NETWORKS.items() if name == "yolox-nano")
    with pytest.raises(InputError, match=f"the model was fitted for 'yolox-nano' .*, {said}"):
        check_same_detector({"name": "yolox-nano", "digest": own}, {"name": "yolox-nano", "digest": digest}, "model")


def test_values_of_another_kind_or_unit_are_refused_with_the_conversion():
    model = FovealObservationModel(torch.ones(3, 2, 3), [0.2], ("cup", "cat"))
    scores = torch.tensor([0.2, 0.5, 0.3])
    with pytest.raises(InputError, match=r"^distance: expected units of the image's longer side, got 240; divide"):
        model.log_likelihood(scores, torch.tensor(240.0))
    assert torch.isfinite(model.log_likelihood(scores, torch.tensor(1.5))).all()
    model = FovealObservationModel(torch.ones(3, 2, 3), [0.2], ("cup", "cat"))
    scores, distance = torch.tensor([0.2, 0.5, 0.3]), torch.tensor(0.1)
    with pytest.raises(InputError, match=r"^scores: expected a tensor, got a NumPy array; give torch.as_tensor"):
        model.calibrate(scores.numpy(), distance)
    refused(r"^distance: expected a tensor, got a float; give torch.as_tensor", model.calibrate, scores, 0.1)
    with pytest.raises(InputError, match=r"^scores: expected a floating-point tensor, got torch.int64"):
        model.calibrate(torch.tensor([0, 1, 0]), distance)
    refused(r"^alpha: expected a tensor, got a list", FovealObservationModel, [[[1.0]]], [0.2], ("cup", "cat"))
    with pytest.raises(InputError, match=r"^classes: expected a sequence of names, got 'cup'"):
        FovealObservationModel(torch.ones(3, 2, 3), [0.2], "cup")


def test_a_compiled_model_follows_its_parameters():
    """In evaluation the graph keeps what it derives from them, until they change."""
    model = FovealObservationModel(table(), EDGES, CLASSES).eval()
    scores, distance = torch.rand(1, 5, len(CLASSES) + 1).softmax(-1), torch.linspace(0, 1, 5)[None]
    compiled = torch.compile(model.calibrate, fullgraph=True, backend="eager")
    with torch.no_grad():
        for factor in (1.0, 0.5):
            model.log_alpha.mul_(factor)
            expected = FovealObservationModel(model.alpha, EDGES, CLASSES).calibrate(scores, distance)
            torch.testing.assert_close(compiled(scores, distance), expected)
            torch.testing.assert_close(model.calibrate(scores, distance), expected)


def fused_step(model):
    optimiser = torch.optim.Adam([model.log_alpha], lr=0.5, fused=True)
    model(*looks(dtype=torch.float32)).square().sum().backward()
    optimiser.step()


def averaged(model):
    model.log_alpha.data.mul_(0.9).add_(0.1)


@pytest.mark.parametrize("change", [fused_step, averaged])
def test_likelihoods_are_those_of_the_present_parameters(change):
    """Fused optimisers and changes of the data of a parameter are not counted in its version."""
    scores, distance = looks(dtype=torch.float32)
    model = FovealObservationModel(table(torch.float32), EDGES, CLASSES).eval()
    with torch.no_grad():
        before = model(scores, distance)
    change(model)
    with torch.no_grad():
        after = model(scores, distance)
        fresh = FovealObservationModel(model.alpha, EDGES, CLASSES)(scores, distance)
    torch.testing.assert_close(after, fresh)
    assert not torch.allclose(after, before)


def test_likelihoods_wait_for_a_gpu_no_more_often_in_evaluation_than_in_training():
    scores, distance = looks(dtype=torch.float32)
    found = []
    with torch.no_grad(), a_gpu():
        model = FovealObservationModel(table(torch.float32), EDGES, CLASSES).to(GPU)
        given = scores.to(GPU), distance.to(GPU)
        for is_training in (True, False):
            model.train(is_training)(*given)
            with waits() as operations:
                model(*given)
            found.append(operations)
    assert found[0] == found[1]


def test_models_side_by_side_equal_each_alone():
    """An ensemble in `torch.func`, in evaluation with and without gradients, and the derivative by its parameters."""
    scores, distance = looks()
    models = [FovealObservationModel(table() * factor, EDGES, CLASSES).eval() for factor in (1.0, 0.5)]
    parameters, _ = torch.func.stack_module_state(models)

    def called(parameters):
        return torch.func.functional_call(models[0], parameters, (scores, distance))

    expected = torch.stack([model(scores, distance) for model in models])
    torch.testing.assert_close(torch.func.vmap(called)(parameters), expected)
    with torch.no_grad():
        torch.testing.assert_close(torch.func.vmap(called)(parameters), expected)

    def of_background(log_alpha):
        return called({"log_alpha": log_alpha})[..., 0].sum()

    gradient = torch.func.grad(of_background)(models[0].log_alpha.detach())
    expected[0][..., 0].sum().backward()
    torch.testing.assert_close(gradient, models[0].log_alpha.grad)


@pytest.mark.parametrize("shipped", ["yolox-nano", "yolox-nano-published"])
def test_log_likelihoods_of_hundreds_of_nats_are_not_rounded_to_eight_bits(shipped):
    """By automatic mixed precision, or because the scores come in half precision."""
    model = FovealObservationModel.from_pretrained(shipped).requires_grad_(False)
    generator = torch.Generator().manual_seed(0)
    shares = torch.rand(50, 81, generator=generator) ** 12 + 1e-4
    scores = (shares / shares.sum(-1, keepdim=True)).bfloat16()
    distance = 0.5 * torch.rand(50, generator=generator)
    exact = model.calibrate(scores.float(), distance)
    assert model.log_likelihood(scores.float(), distance).abs().max() > 200
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(model.calibrate(scores.float(), distance), exact)
    assert model.log_likelihood(scores, distance).dtype == torch.bfloat16
    half = model.calibrate(scores, distance)
    torch.testing.assert_close(half.float(), exact, rtol=2**-8, atol=1e-6)
