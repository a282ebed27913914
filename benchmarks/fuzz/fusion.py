"""Fuzz fusion rules with likelihoods and parameters of any value."""

import numpy as np
import torch
from hypothesis import strategies as st

from benchmarks.fuzz.runner import attempt, choose, draw_rng, failed, outcome
from semfov import fusion
from semfov.belief import fuse

KINDS = (
    "ordinary",
    "ordinary",
    "one zero",
    "sharp",
    "sharp",
    "zeros",
    "one zero",
    "tiny",
    "huge",
    "negative",
    "nan",
    "inf",
)
BETAS = ("prior", "prior", "grown", "grown", "tiny", "large", "zero", "negative", "nan", "inf")


def fusion_rules(data: st.DataObject) -> str:
    """`kaplan`, `product`, `sum` and `fuse`: the formulas in extended precision, or `InputError`."""
    rng = draw_rng(data)
    classes = data.draw(st.integers(2, 9), label="classes")
    rule = choose(data, ("kaplan", "product", "sum"), "rule")
    kind, start = choose(data, KINDS, "likelihood"), choose(data, BETAS, "beta")
    dtype = choose(data, (torch.float32, torch.float64), "dtype")
    likelihood = draw_likelihood(rng, kind, classes)
    beta = draw_beta(rng, start, classes)
    tensors = [torch.from_numpy(array).to(dtype) for array in (beta, likelihood)]
    result = attempt(lambda: getattr(fusion, rule)(*tensors))
    whole = attempt(lambda: fuse(tensors[0][None, None], tensors[1][None, None], torch.ones(1, 1, 1).bool(), rule))
    assert failed(result) == failed(whole), (result, whole)
    bad = kind in ("zeros", "negative", "nan", "inf") or start in ("zero", "negative", "nan", "inf")
    if failed(result):
        assert bad, result
        return outcome(result)
    assert not bad, result
    assert isinstance(result, torch.Tensor)
    assert isinstance(whole, torch.Tensor)
    torch.testing.assert_close(whole[0, 0], result, rtol=20 * torch.finfo(dtype).eps, atol=torch.finfo(dtype).tiny)
    wide = [tensor.double().numpy().astype(np.longdouble) for tensor in tensors]
    exact = formula(rule, *wide).astype(np.float64)
    # The product rule raises parameters to the smallest positive number before it scales them.
    scale = (1 + beta.sum()) / (beta * likelihood / likelihood.max()).sum()
    least = 10 * torch.finfo(dtype).tiny * max(scale, 1.0)
    np.testing.assert_allclose(result.numpy(), exact, rtol=20 * torch.finfo(dtype).eps, atol=least)
    return "result"


def formula(rule: str, beta: np.ndarray, likelihood: np.ndarray) -> np.ndarray:
    """The rules as in their published formulas."""
    expected = (beta * likelihood).sum()
    if rule == "kaplan":
        return beta * (1 + likelihood / expected) / (1 + likelihood.min() / expected)
    if rule == "product":
        return (1 + beta.sum()) * beta * likelihood / expected
    return beta + likelihood / likelihood.sum()


def draw_likelihood(rng: np.random.Generator, kind: str, classes: int) -> np.ndarray:
    """Random likelihoods of the given kind."""
    values = rng.dirichlet(np.ones(classes)) + 1e-6
    if kind == "sharp":
        values = values**8 + 1e-20
    if kind == "zeros":
        values[:] = 0
    if kind == "one zero":
        values[0] = 0
    if kind in ("tiny", "huge"):
        values = values * (1e-30 if kind == "tiny" else 1e30)
    if kind in ("negative", "nan", "inf"):
        values[rng.integers(classes)] = {"negative": -0.1, "nan": np.nan, "inf": np.inf}[kind]
    return values


def draw_beta(rng: np.random.Generator, start: str, classes: int) -> np.ndarray:
    """Random Dirichlet parameters of the given kind."""
    values = np.full(classes, 0.5)
    if start == "grown":
        values = rng.gamma(2.0, 5.0, classes) + 0.1
    if start in ("tiny", "large"):
        values = rng.random(classes) * (1e-6 if start == "tiny" else 1e6) + 1e-9
    if start in ("zero", "negative", "nan", "inf"):
        values[rng.integers(classes)] = {"zero": 0.0, "negative": -1.0, "nan": np.nan, "inf": np.inf}[start]
    return values
