"""Log-linear choice models against scipy's minimiser, closed forms, and choices drawn with known weights."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.special import logsumexp

from eval.human.habits.log_linear import fit_log_linear, log_probability
from semfov.errors import DataError, InputError


def draw(count=400, alternatives=6, features=4, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    phi = torch.randn(count, alternatives, features, generator=generator, dtype=torch.float64)
    weights = torch.linspace(-1.5, 1, features, dtype=torch.float64)
    chosen = (phi @ weights).softmax(-1).multinomial(1, generator=generator)[:, 0]
    return phi.to(dtype), chosen, weights


@pytest.mark.parametrize("ridge", [1e-6, 1.0, 50.0])
def test_equals_scipys_minimum(ridge):
    phi, chosen, _ = draw()
    array, taken = phi.numpy(), chosen.numpy()

    def loss(w):
        utility = array @ w
        return ridge / 2 * w @ w - (utility[np.arange(len(taken)), taken] - logsumexp(utility, axis=1)).sum()

    expected = minimize(loss, np.zeros(4), method="BFGS", options={"gtol": 1e-7}).x
    np.testing.assert_allclose(fit_log_linear(phi, chosen, ridge=ridge).numpy(), expected, atol=1e-5)


def test_probabilities_equal_the_shares_of_alternatives():
    """With one weight for each alternative, the maximum likelihood probabilities are the shares."""
    chosen = torch.tensor([0] * 50 + [1] * 30 + [2] * 20)
    phi = torch.eye(3).expand(100, 3, 3)
    weights = fit_log_linear(phi, chosen, ridge=1e-9)
    torch.testing.assert_close(weights.softmax(0), torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64))
    log = log_probability(phi, chosen, weights)
    assert float(log.mean()) == pytest.approx(sum(p * np.log(p) for p in (0.5, 0.3, 0.2)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_known_weights_are_recovered(dtype, device):
    phi, chosen, weights = draw(count=20_000, dtype=dtype)
    got = fit_log_linear(phi.to(device), chosen.to(device), ridge=1e-6)
    assert got.dtype == torch.float64
    assert got.device.type == device.type
    torch.testing.assert_close(got.cpu(), weights, rtol=0, atol=0.06)


def test_weights_do_not_depend_on_the_chunk_size():
    phi, chosen, _ = draw()
    torch.testing.assert_close(fit_log_linear(phi, chosen, chunk=7), fit_log_linear(phi, chosen))


def test_weights_of_uninformative_features_are_zero():
    phi, chosen, _ = draw()
    never = torch.cat([phi, torch.zeros(400, 6, 1, dtype=torch.float64), torch.ones(400, 6, 1)], -1)
    weights = fit_log_linear(never, chosen)
    torch.testing.assert_close(weights[4:], torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-9)
    torch.testing.assert_close(weights[:4], fit_log_linear(phi, chosen))


def test_fit_converges_when_all_choices_are_equal():
    """Without the ridge penalty the weights would be infinite."""
    phi = torch.eye(2).expand(1000, 2, 2)
    weights = fit_log_linear(phi, torch.zeros(1000, dtype=torch.int64), ridge=1e-3)
    assert float((weights[0] - weights[1]).exp()) > 1e4


def test_invalid_arguments_are_refused():
    phi, chosen, _ = draw()
    with pytest.raises(InputError, match="chosen"):
        fit_log_linear(phi, chosen[:5])
    with pytest.raises(InputError, match="ridge"):
        fit_log_linear(phi, chosen, ridge=0.0)
    with pytest.raises(InputError, match="at least one choice"):
        fit_log_linear(phi[:0], chosen[:0])
    with pytest.raises(InputError, match="weights"):
        log_probability(phi, chosen, torch.zeros(3))
    with pytest.raises((DataError, RuntimeError)):
        fit_log_linear(phi * torch.nan, chosen)
