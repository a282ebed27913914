"""Discriminative training: against a plain logistic regression, on detections that plain Bayes gets wrong."""

import numpy as np
import pytest
import scipy.optimize
import torch
from torch.nn import functional as F

from semfov.observation import DirichletStatistics, FovealObservationModel, dirichlet, fit_discriminative
from tests.refusals import refused

CLASSES = ["cup", "cat", "dog", "bus"]
EDGES = [0.1, 0.2]


def detections(samples, seed, dtype=torch.float64):
    """Overconfident scores with noise shared by all classes, which plain Bayes counts as evidence once per class."""
    generator = torch.Generator().manual_seed(seed)
    labels = torch.multinomial(torch.tensor([8.0, 4, 2, 1, 1]), samples, replacement=True, generator=generator)
    distance = torch.rand(samples, generator=generator, dtype=torch.float64) * 0.3
    noise = torch.randn(samples, 5, generator=generator, dtype=torch.float64) * (1 + 4 * distance)[:, None]
    logits = 2 * F.one_hot(labels, 5) + noise
    logits[:, 1:] -= 3 * torch.rand(samples, 1, generator=generator, dtype=torch.float64)
    return (2.5 * logits).softmax(-1).to(dtype), distance.to(dtype), labels


def cross_entropy(model, scores, distance, labels):
    with torch.no_grad():
        return float(F.nll_loss(model.calibrate(scores, distance).clamp(min=1e-30).log(), labels))


def generative(scores, distance, labels, **settings):
    model = FovealObservationModel.identity(CLASSES, EDGES).to(scores.dtype)
    statistics = DirichletStatistics((5, 3), 5).update(scores, (labels, model.level(distance)))
    return model.fit(statistics, **settings)


def test_trained_model_beats_raw_scores_and_plain_bayes_on_new_detections(dtype):
    train, test = detections(6000, 0, dtype), detections(6000, 1, dtype)
    plain = generative(*train, expected="empirical")
    before = plain.state_dict()["log_alpha"].clone()
    model = fit_discriminative(plain, *train, decay=10.0, level_decay=100.0, bias_decay=1.0)
    assert torch.equal(plain.log_alpha, before)
    assert model.alpha.dtype == dtype
    assert bool((model.alpha > 0).all())
    assert torch.equal(model.expected_scores(), plain.expected_scores())

    raw = float(F.nll_loss(dirichlet.floor(test[0], 1e-6).log(), test[2]))
    trained = cross_entropy(model, *test)
    assert trained < raw - 0.1
    assert trained < cross_entropy(plain, *test) - 0.02
    assert trained < cross_entropy(generative(*train, prior=True, tempering=0.5), *test)

    with torch.no_grad():
        confidence, predicted = model.calibrate(*test[:2]).max(-1)
    correct = (predicted == test[2]).double()
    for low in (0.4, 0.6, 0.8):
        inside = (confidence >= low) & (confidence < low + 0.2)
        assert float((correct[inside] - confidence[inside].double()).mean().abs()) < 0.04


def test_training_with_one_level_equals_logistic_regression_with_scipy():
    scores, _, labels = detections(400, 3)
    distance = torch.zeros(400, dtype=torch.float64)
    decay, bias_decay = 5.0, 2.0
    start = FovealObservationModel.identity(CLASSES, EDGES).double()
    model = fit_discriminative(
        start, scores, distance, labels, decay=decay, level_decay=1e9, bias_decay=bias_decay, iterations=500
    )

    evidence = (dirichlet.floor(scores, 1e-6).log() - np.log(1e-6)).numpy()
    truth, unit = labels.numpy(), np.eye(5)
    weight_decay = np.where(unit > 0, bias_decay, decay)

    def objective(x):
        u, common, own = x[:25].reshape(5, 5), x[25:30], x[30:]
        logits = evidence @ ((1 + unit) * np.exp(u) - 1).T + common + own
        logits = logits - logits.max(1, keepdims=True)
        nll = np.log(np.exp(logits).sum(1)) - logits[np.arange(400), truth]
        prior = (weight_decay * u**2).sum() + bias_decay * ((common**2).sum() + (own**2).sum())
        return (nll.sum() + prior / 2) / 400

    best = scipy.optimize.minimize(objective, np.zeros(35), method="BFGS", options={"gtol": 1e-7, "maxiter": 2000})
    alpha = (1 + unit) * np.exp(best.x[:25].reshape(5, 5))
    np.testing.assert_allclose(model.alpha[:, 0].detach(), alpha, rtol=2e-3)


def test_training_is_deterministic_also_under_no_grad():
    data = detections(800, 4, torch.float32)
    start = FovealObservationModel.identity(CLASSES, EDGES)
    torch.manual_seed(1)
    first = fit_discriminative(start, *data)
    torch.manual_seed(2)
    second = fit_discriminative(start, *data)
    for name, tensor in first.state_dict().items():
        assert torch.equal(tensor, second.state_dict()[name])
    with torch.no_grad():
        model = fit_discriminative(FovealObservationModel.identity(CLASSES, EDGES), *detections(300, 7, torch.float32))
    assert model.metadata["method"] == "discriminative"


def test_strong_priors_leave_the_scores_unchanged():
    scores, distance, labels = detections(500, 5)
    start = FovealObservationModel.identity(CLASSES, EDGES).double()
    model = fit_discriminative(start, scores, distance, labels, decay=1e12, level_decay=1e12, bias_decay=1e12)
    with torch.no_grad():
        got = model.calibrate(scores, distance)
    torch.testing.assert_close(got, dirichlet.floor(scores, 1e-6), rtol=1e-6, atol=1e-9)


def test_levels_without_examples_follow_the_others():
    scores, distance, labels = detections(3000, 6)
    near = distance < 0.1
    start = FovealObservationModel.identity(CLASSES, EDGES).double()
    model = fit_discriminative(start, scores[near], distance[near], labels[near], decay=10.0, level_decay=1000.0)
    alpha = model.alpha.detach()
    difference = (alpha[:, 2] - alpha[:, 0]).abs().max()
    assert 0 < float(difference) < 0.1 * float((alpha[:, 0] - start.alpha[:, 0].detach()).abs().max())


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"labels": torch.full((10,), 5)}, "labels"),
        ({"labels": torch.zeros(9, dtype=torch.int64)}, "labels"),
        ({"distance": torch.zeros(9)}, "distance"),
        ({"scores": torch.ones(10, 4) / 4}, "scores"),
        ({"scores": torch.ones(0, 5)}, "scores"),
        ({"decay": 0.0}, "decay"),
    ],
)
def test_bad_arguments_are_named(change, named):
    good = {"scores": torch.ones(10, 5) / 5, "distance": torch.zeros(10), "labels": torch.zeros(10, dtype=torch.int64)}
    refused(named, fit_discriminative, FovealObservationModel.identity(CLASSES, EDGES), **{**good, **change})
