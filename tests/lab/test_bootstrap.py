"""Errors by bootstrap over groups: against every possible sample, scipy and closed forms."""

from itertools import product

import numpy as np
import pytest
import torch
from scipy.stats import bootstrap, norm

from eval.bootstrap import Bootstrap
from semfov.metrics.episodes import area_under_roc
from tests.refusals import refused

GROUPS = ["a", "b", "a", "c", "b", "b"]
CASES = torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0, 32.0], dtype=torch.float64)


def mean_of(values):
    return lambda index: values[index].mean()


def test_samples_hold_whole_groups_with_all_their_cases():
    drawn = Bootstrap.of(lambda index: torch.bincount(index, minlength=6), GROUPS, samples=200)
    assert drawn.value.tolist() == [1] * 6
    for counts in drawn.samples.tolist():
        assert counts[0] == counts[2]
        assert counts[1] == counts[4] == counts[5]
        assert counts[0] + counts[1] + counts[3] == 3
    assert len(drawn.samples.unique(dim=0)) == 10  # multisets of 3 of 3 groups


def test_error_and_interval_are_those_of_every_possible_sample():
    """All 27 samples of three groups are equally likely."""
    parts = [CASES[[0, 2]], CASES[[1, 4, 5]], CASES[[3]]]
    every = np.array([torch.cat([parts[n] for n in sample]).mean() for sample in product(range(3), repeat=3)])
    drawn = Bootstrap.of(mean_of(CASES), GROUPS, samples=20_000)
    assert set(drawn.samples.numpy().round(9)) == set(every.round(9))
    assert float(drawn.error) == pytest.approx(every.std(), rel=0.02)
    low, high = np.quantile(np.repeat(every, 1000), (0.05, 0.95))
    assert drawn.interval(0.9).tolist() == pytest.approx([low, high])


def test_error_and_interval_agree_with_scipy_where_every_case_is_a_group(dtype):
    values = torch.randn(80, generator=torch.Generator().manual_seed(0), dtype=torch.float64).exp().to(dtype)
    theirs = bootstrap((values.numpy(),), np.mean, n_resamples=4000, method="percentile", rng=0)
    ours = Bootstrap.of(mean_of(values), range(80), samples=4000)
    assert float(ours.error) == pytest.approx(theirs.standard_error, rel=0.05)
    assert ours.interval().tolist() == pytest.approx(list(theirs.confidence_interval), rel=0.02)


def test_error_of_the_area_is_that_of_delong():
    """Cases that are independent: the variance of the structural components (DeLong and others, 1988)."""
    generator = torch.Generator().manual_seed(3)
    present = torch.arange(300) < 150
    score = torch.randn(300, generator=generator, dtype=torch.float64) + present
    hits, misses = score[present].tolist(), score[~present].tolist()
    above = np.array([[(h > m) + (h == m) / 2 for m in misses] for h in hits])
    expected = (above.mean(1).var(ddof=1) / 150 + above.mean(0).var(ddof=1) / 150) ** 0.5
    measure = lambda index: torch.tensor(area_under_roc(score[index], present[index]))  # noqa: E731
    got = Bootstrap.of(measure, range(300))
    assert float(got.value) == pytest.approx(norm.cdf(2**-0.5), abs=3 * expected)
    assert float(got.error) == pytest.approx(expected, rel=0.08)


def test_differences_are_paired():
    """Two figures that differ by a constant differ without an error."""
    drawn = Bootstrap.of(lambda index: torch.stack([CASES[index].mean(), CASES[index].mean() + 3]), GROUPS)
    apart = drawn.less(0)
    assert apart.value.tolist() == [0, 3]
    assert apart.error.tolist() == pytest.approx([0, 0], abs=1e-12)
    assert drawn.error[0] > 1


def test_samples_without_a_figure_do_not_count():
    """The mean of the even cases is NaN in samples that hold none."""
    values = torch.tensor([1.0, torch.nan, 5.0], dtype=torch.float64)
    drawn = Bootstrap.of(lambda index: values[index].nanmean(), range(3), samples=500)
    left = drawn.samples[~drawn.samples.isnan()]
    assert 0 < len(left) < 500
    assert float(drawn.error) == pytest.approx(float(left.std()))
    assert drawn.interval().tolist() == left.quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()


def test_the_seed_decides_the_samples_of_given_cases():
    draws = [Bootstrap.of(mean_of(CASES), GROUPS, seed=seed).samples for seed in (0, 0, 1)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    for groups, samples, told in [([], 10, "groups"), ([1], 1, "samples")]:
        refused(f"{told}: expected", Bootstrap.of, mean_of(CASES), groups, samples=samples)
