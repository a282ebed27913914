"""Peers of belief and gaze: straightforward loops over cells, and brute force with one large tensor.

The published cost of exploration, 9.85 s per decision, is that of loops like these.
"""

from collections.abc import Callable
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import digamma, gammaln
from torch import Tensor
from torch.distributions import Dirichlet, kl_divergence

from benchmarks.timing import Comparison, Run
from semfov import DirichletBelief, FovealObservationModel, Grid, acquisition, fusion
from semfov.belief import fuse

Array = NDArray[np.float64]
CLASSES, LEVELS, DETECTIONS, PRIOR = 80, 8, 30, 0.5


def kaplan(beta: Array, likelihood: Array) -> Array:
    """Kaplan's rule for one cell, as published."""
    expected = beta @ likelihood
    return beta * (1 + likelihood / expected) / (1 + likelihood.min() / expected)


def divergence(beta: Array) -> float:
    """Kullback-Leibler divergence of Dir(β) from the prior."""
    total, base = beta.sum(), PRIOR * len(beta)
    constant = gammaln(base) - len(beta) * gammaln(PRIOR)
    expected = digamma(beta) - digamma(total)
    return float(gammaln(total) - gammaln(beta).sum() - constant + ((beta - PRIOR) * expected).sum())


def divergences(beta: Tensor) -> Tensor:
    """Kullback-Leibler divergences of many cells from the prior, by torch's own formula."""
    prior = Dirichlet(torch.full_like(beta, PRIOR), validate_args=False)
    return kl_divergence(Dirichlet(beta, validate_args=False), prior)


def certainty(beta: Array) -> float:
    """Negative entropy of the mean of Dir(β)."""
    p = beta / beta.sum()
    return float((p * np.log(p)).sum())


def certainties(beta: Tensor) -> Tensor:
    """Negative entropies of the means of many cells."""
    p = beta / beta.sum(-1, keepdim=True)
    return (p * p.log()).sum(-1)


# The value of a cell that exploration sums over the map and maximises: for one cell, and for many.
VALUES: dict[str, tuple[Callable[[Array], float], Callable[[Tensor], Tensor]]] = {
    "KL divergence": (divergence, divergences),
    "negative entropy": (certainty, certainties),
}


def make_model(classes: int = CLASSES, levels: int = LEVELS) -> FovealObservationModel:
    """Return an observation model whose expected scores become flatter with distance."""
    sharp = torch.linspace(8, 0.5, levels)[:, None] * torch.eye(classes + 1)[:, None]
    edges = torch.arange(1, levels) * 50 / 640
    return (
        FovealObservationModel(0.1 + sharp, edges, [f"class {n}" for n in range(classes)]).eval().requires_grad_(False)
    )


def make_belief(cells: int, classes: int = CLASSES, batch: int = 1) -> DirichletBelief:
    """Random beliefs, as they might be after several looks."""
    generator = torch.Generator().manual_seed(0)
    return DirichletBelief(PRIOR + torch.rand(batch, cells, classes + 1, generator=generator).pow(8) * 6)


def unvisited(belief: DirichletBelief) -> Tensor:
    """Return a mask of visited cells in which no cell is visited."""
    return torch.zeros_like(belief.closest, dtype=torch.bool)


def make_look(cells: int, classes: int = CLASSES, batch: int = 1) -> tuple[Tensor, Tensor]:
    """Random likelihoods of detections, and footprints that each cover about a tenth of the cells."""
    generator = torch.Generator().manual_seed(1)
    likelihood = (3 * torch.randn(batch, DETECTIONS, classes + 1, generator=generator)).softmax(-1)
    return likelihood, torch.rand(batch, DETECTIONS, cells, generator=generator) < 0.1


def kaplan_update() -> Comparison:
    """Fusion of 30 detections into a map of 10 × 10 cells and 81 classes."""
    beta, (likelihood, footprint) = make_belief(100).beta, make_look(100)
    cells, scores, covered = beta[0].double().numpy(), likelihood[0].double().numpy(), footprint[0].numpy()

    def loop() -> Array:
        result = cells.copy()
        for vector, mask in zip(scores, covered, strict=True):
            for cell in np.flatnonzero(mask):
                result[cell] = kaplan(result[cell], vector)
        return result

    def brute() -> Tensor:
        result = beta
        for number in range(DETECTIONS):
            updated = fusion.kaplan(result, likelihood[:, number, None])
            result = torch.where(footprint[:, number, :, None], updated, result)
        return result

    def ours() -> Tensor:
        return fuse(beta, likelihood, footprint)

    def agree() -> None:
        torch.testing.assert_close(ours(), brute())
        np.testing.assert_allclose(ours()[0].numpy(), loop(), rtol=1e-4)

    return Comparison(
        "Kaplan's rule, 30 detections", ours, {"loop over cells": loop, "whole map each": brute}, {}, agree
    )


def kaplan_updates(episodes: int = 1000, one_by_one: int = 50) -> Comparison:
    """Fusion of 30 detections into each of many maps at once; the peer fuses some of them one at a time."""
    beta, (likelihood, footprint) = make_belief(100, batch=episodes).beta, make_look(100, batch=episodes)

    def ours() -> Tensor:
        return fuse(beta, likelihood, footprint)

    def singles() -> list[Tensor]:
        maps = zip(beta.split(1), likelihood.split(1), footprint.split(1), strict=True)
        return [fuse(*each) for each in islice(maps, one_by_one)]

    def agree() -> None:
        torch.testing.assert_close(ours()[:one_by_one], torch.cat(singles()), rtol=0, atol=0)

    peers: dict[str, Run] = {"one at a time": singles}
    share = {"one at a time": one_by_one / episodes}
    return Comparison(f"Kaplan's rule, 30 detections in {episodes:,} episodes", ours, peers, share, agree)


def compiled() -> Comparison:
    """Likelihoods of 30 detections fused into a map of 10 × 10 cells and 81 classes, compiled."""
    with torch.inference_mode(False), torch.no_grad():  # tensors of inference count as new at each call
        model, beta = make_model(), make_belief(100).beta
    scores, footprint = make_look(100)
    scores = scores.lerp(torch.full_like(scores, 1 / (CLASSES + 1)), 0.01)  # lower scores have likelihoods below 1e-38
    distance = torch.linspace(0, 0.6, DETECTIONS)[None]

    calibrate, update = (torch.compile(each, fullgraph=True) for each in (model.calibrate, fuse))

    def ours() -> Tensor:
        result: Tensor = update(beta, calibrate(scores, distance), footprint)
        return result

    def eager() -> Tensor:
        return fuse(beta, model.calibrate(scores, distance), footprint)

    def agree() -> None:
        torch.testing.assert_close(ours(), eager())

    return Comparison("calibration and Kaplan's rule, 30 detections, compiled", ours, {"eager": eager}, {}, agree)


def predictive_search() -> Comparison:
    """One decision of predictive search: the expected posterior of a target in every cell."""
    belief, model = make_belief(100), make_model()
    expected, cells = model.expected_scores()[:, 0].double().numpy(), belief.beta[0].double().numpy()
    visited = unvisited(belief)
    value = acquisition.PredictedTargetPosterior(5, model)

    def loop() -> Array:
        result = np.empty(len(cells))
        for cell, row in enumerate(cells):
            after = kaplan(row, (row / row.sum()) @ expected)
            result[cell] = after[5] / after.sum()
        return result

    def ours() -> Tensor:
        return value(belief, visited)

    def agree() -> None:
        np.testing.assert_allclose(ours()[0].numpy(), loop(), rtol=1e-4)

    return Comparison("predictive search, one decision", ours, {"loop over cells": loop}, {}, agree)


def exploration(name: str, belief: DirichletBelief | None = None) -> Comparison:
    """One decision of exploration: the value of every next fixation; the loop evaluates one of the hundred fixations.

    The peers compute the published values, which equal semfov's plus the value of the present map.

    Args:
        name: name of the acquisition function.
        belief: the belief (None: a random one).

    Returns:
        The comparison of semfov with the loop and with brute force.
    """
    grid, model = Grid(10, 10, (640, 480)), make_model()
    belief = belief or make_belief(len(grid))
    visited, wide = unvisited(belief), belief.beta[0].double()
    kinds = {"KL divergence": acquisition.KLDivergence, "negative entropy": acquisition.NegativeEntropy}
    value, (of_cell, of_cells) = kinds[name](model, grid), VALUES[name]
    levels = model.level(grid.cell_distance)
    table, cells = model.expected_scores().double().numpy(), wide.numpy()

    def loop(fixations: int = 1) -> list[float]:
        return [
            sum(of_cell(kaplan(row, (row / row.sum()) @ table[:, levels[cell, f]])) for cell, row in enumerate(cells))
            for f in range(fixations)
        ]

    def brute() -> Tensor:
        mean = wide / wide.sum(-1, keepdim=True)
        scores = torch.einsum("xk,knj->xnj", mean, model.expected_scores().double())
        every = scores[torch.arange(len(wide))[:, None], levels]
        return of_cells(fusion.kaplan(wide[:, None].expand_as(every), every)).sum(0)

    def ours() -> Tensor:
        return value(belief, visited)

    def agree() -> None:
        published = brute()
        gained = published - of_cells(wide).sum()
        precise = value(DirichletBelief(wide[None]), visited)[0]
        torch.testing.assert_close(precise, gained, rtol=0, atol=1e-6)
        torch.testing.assert_close(ours()[0].double(), gained, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(published[:1].numpy(), loop(), rtol=1e-9)

    peers: dict[str, Run] = {"loop over fixations and cells": loop, "all pairs at once": brute}
    share = {"loop over fixations and cells": 1 / len(grid)}
    return Comparison(f"exploration, {name}, one decision", ours, peers, share, agree)
