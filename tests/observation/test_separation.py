"""d' of the observation model against draws from its Dirichlets, scipy, and closed forms."""

import numpy as np
import pytest
import torch
from scipy import integrate, stats
from torch.distributions import Dirichlet

from semfov.errors import InputError
from semfov.observation import FovealObservationModel, visibility
from semfov.observation.separation import _log_ratio_moments


def make_model(dtype=torch.float64, missed=None, levels=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    alpha = 0.5 + 4 * torch.rand(4, levels, 4, generator=generator, dtype=dtype)
    alpha += 6 * torch.eye(4, dtype=dtype)[:, None] * torch.linspace(1, 0.1, levels, dtype=dtype)[:, None]
    missed = torch.rand(4, levels, generator=generator, dtype=dtype) if missed is None else missed
    return FovealObservationModel(alpha, [0.1 * n for n in range(1, levels)], ["a", "b", "c"], miss_rate=missed)


def test_moments_of_the_log_ratio_equal_integrals_with_scipy():
    """With two components the Dirichlet is a beta distribution."""
    source, target, background = (3.0, 2.0), (4.0, 1.5), (1.2, 2.5)
    density, p, q = (stats.beta(*each) for each in (source, target, background))

    def expect(function):
        return integrate.quad(lambda s: density.pdf(s) * function(s), 0, 1, epsabs=1e-10)[0]

    mean = expect(lambda s: p.logpdf(s) - q.logpdf(s))
    variance = expect(lambda s: (p.logpdf(s) - q.logpdf(s) - mean) ** 2)
    got = _log_ratio_moments(*(torch.tensor(each, dtype=torch.float64) for each in (source, target, background)))
    assert [float(each) for each in got] == pytest.approx([mean, variance], rel=1e-6)


def test_visibility_equals_d_prime_of_random_scores():
    """Scores are drawn from the Dirichlets; their log likelihood ratio is set to 0 where the detector misses."""
    model, count = make_model(), 200_000
    alpha, missed = model.alpha.detach(), model.miss_rate
    rng = np.random.default_rng(0)
    for target, level in ((1, 0), (2, 1), (3, 2)):
        ratio = {}
        for source in (0, target):
            scores = torch.as_tensor(rng.dirichlet(alpha[source, level].numpy(), count))
            log_densities = [Dirichlet(alpha[k, level], validate_args=False).log_prob(scores) for k in (target, 0)]
            seen = rng.random(count) >= float(missed[source, level])
            ratio[source] = np.where(seen, (log_densities[0] - log_densities[1]).numpy(), 0)
        apart = ratio[target].mean() - ratio[0].mean()
        expected = apart / np.sqrt((ratio[target].var() + ratio[0].var()) / 2)
        assert float(visibility(model)[target, level].detach()) == pytest.approx(expected, rel=0.02)


def test_visibility_is_zero_where_nothing_is_ever_detected():
    missed = torch.full((4, 3), 0.3, dtype=torch.float64)
    missed[:, 2] = 1
    seen = visibility(make_model(missed=missed)).detach()
    assert torch.equal(seen[:, 2], torch.zeros(4, dtype=torch.float64))
    assert torch.equal(seen[0], torch.zeros(3, dtype=torch.float64))
    assert bool((seen[1:, :2] > 0).all())


def test_a_model_without_miss_rates_is_refused():
    with pytest.raises(InputError, match="model: expected an observation model with miss rates"):
        visibility(FovealObservationModel.identity(["a"], [0.1]))
    with pytest.raises(InputError, match="target"):
        _log_ratio_moments(torch.ones(3), torch.ones(2), torch.ones(3))
