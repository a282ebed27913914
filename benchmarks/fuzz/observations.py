"""Fuzz the observation model with scores on and off the simplex and distances of every kind."""

import math

import numpy as np
import torch
from hypothesis import strategies as st

from benchmarks.fuzz.runner import attempt, choose, draw_rng, failed, outcome
from semfov import DirichletStatistics, FovealObservationModel

SCORES = ("ordinary", "corner", "zeros", "unscaled", "tiny", "negative", "nan", "inf")
DISTANCES = ("ordinary", "edge", "far", "pixels", "infinite", "negative", "nan")
EDGES = (0.25, 0.5)


def observations(data: st.DataObject) -> str:
    """`calibrate`: Bayes' rule by `math.lgamma`, or `InputError`; statistics accept only scores on the simplex."""
    rng = draw_rng(data)
    classes = data.draw(st.integers(1, 5), label="classes")
    components, levels = classes + 1, len(EDGES) + 1
    alpha = rng.gamma(1.0, 3.0, (components, levels, components)) + 0.05
    prior = rng.normal(0, 1, (components, levels))
    names = [f"class {n}" for n in range(classes)]
    model = FovealObservationModel(torch.from_numpy(alpha), EDGES, names, log_prior=torch.from_numpy(prior)).eval()
    kind, place = choose(data, SCORES, "scores"), choose(data, DISTANCES, "distance")
    scores = draw_scores(rng, kind, components)
    distance = {
        "ordinary": float(rng.random()), "edge": EDGES[0], "far": 9.5, "pixels": 320.0, "infinite": math.inf,
        "negative": -0.1, "nan": math.nan,
    }[place]  # fmt: skip
    looks = torch.from_numpy(scores)[None], torch.tensor([distance], dtype=torch.float64)
    result = attempt(lambda: model.calibrate(*looks).detach())
    statistics = DirichletStatistics((components, levels), components)
    counted = attempt(lambda: statistics.update(looks[0], (torch.tensor([0]), torch.tensor([0]))))
    assert failed(counted) == (kind in ("zeros", "unscaled", "negative", "nan", "inf")), counted
    bad = kind in ("negative", "nan", "inf") or place in ("pixels", "negative", "nan")
    if failed(result):
        assert bad, result
        return outcome(result)
    assert not bad, (kind, place, result)
    assert isinstance(result, torch.Tensor)
    level = sum(distance > edge for edge in EDGES)
    np.testing.assert_allclose(
        result[0].numpy(), bayes(scores, alpha[:, level], prior[:, level]), rtol=1e-9, atol=1e-12
    )
    return "result"


def bayes(scores: np.ndarray, alpha: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Posterior probabilities of the classes, for scores floored at 1e-6."""
    raised = np.maximum(scores, 1e-6)
    logs = np.log(raised / raised.sum())
    logits = []
    for row, weight in zip(alpha, prior, strict=True):
        normaliser = sum(map(math.lgamma, row)) - math.lgamma(row.sum())
        logits.append(((row - 1) * logs).sum() - normaliser + weight)
    odds = np.exp(np.array(logits) - max(logits))
    return odds / odds.sum()


def draw_scores(rng: np.random.Generator, kind: str, components: int) -> np.ndarray:
    """A random score vector of the given kind."""
    scores = rng.dirichlet(np.ones(components))
    if kind == "corner":
        scores = np.eye(components)[rng.integers(components)]
    if kind == "zeros":
        scores[:] = 0
    if kind == "unscaled":
        scores = scores * 3
    if kind == "tiny":
        scores = np.array([1.0 - 1e-300, *[1e-300] * (components - 1)])
    if kind in ("negative", "nan", "inf"):
        scores[rng.integers(components)] = {"negative": -0.2, "nan": np.nan, "inf": np.inf}[kind]
    return scores
