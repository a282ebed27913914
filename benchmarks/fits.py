"""Comparison of maximum-likelihood fits of Dirichlets with the PyPI package `dirichlet` and scipy's optimiser."""

import dirichlet as pypi
import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import digamma, gammaln
from torch import Tensor

from benchmarks.timing import Comparison
from semfov.observation.dirichlet import floor, mle

CLASSES, LEVELS, COMPONENTS = 81, 8, 81


def draw(samples: int, seed: int) -> Tensor:
    """Score vectors drawn from random Dirichlets, `(648, samples, 81)`, with values floored at 1e-6."""
    rng = np.random.default_rng(seed)
    alpha = np.exp(rng.normal(-1.0, 1.0, (CLASSES * LEVELS, COMPONENTS)))
    scores = np.stack([rng.dirichlet(row, samples) for row in alpha])
    return floor(torch.from_numpy(scores), 1e-6)


def dirichlets(samples: int = 100) -> Comparison:
    """Fit of 81 × 8 Dirichlets of 81 dimensions from samples; the peers fit one of the 648."""
    scores = draw(samples, seed=0)
    logs = scores[0].log().mean(0).numpy()

    def lost(log_alpha: np.ndarray) -> tuple[float, np.ndarray]:
        alpha = np.exp(log_alpha)
        value = gammaln(alpha.sum()) - gammaln(alpha).sum() + (alpha - 1) @ logs
        return -value, -alpha * (digamma(alpha.sum()) - digamma(alpha) + logs)

    def with_scipy() -> np.ndarray:
        solution = minimize(
            lost, np.zeros(len(logs)), jac=True, method="L-BFGS-B", options={"ftol": 1e-12, "gtol": 1e-8}
        )
        return np.exp(solution.x)

    def ours() -> Tensor:
        return mle(scores.log().mean(1))

    def agree() -> None:
        np.testing.assert_allclose(with_scipy(), ours()[0].numpy(), rtol=1e-3)

    peers = {"PyPI dirichlet": lambda: pypi.mle(scores[0].numpy()), "scipy L-BFGS-B": with_scipy}
    return Comparison("648 Dirichlets of 81 dimensions", ours, peers, dict.fromkeys(peers, 1 / len(scores)), agree)
