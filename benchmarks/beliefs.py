"""Belief and gaze as one writes them first: loops over cells, and brute force in one tensor.

The published costs of exploration (9.85 s a decision) are those of loops like these.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.timing import Comparison
from semfov import FovealObservationModel, Grid, acquisition, fusion
from semfov.belief import fuse

Array = NDArray[np.float64]
CLASSES, LEVELS, DETECTIONS = 80, 8, 30


def kaplan(beta: Array, likelihood: Array) -> Array:
    """The published rule for one cell."""
    expected = beta @ likelihood
    return beta * (1 + likelihood / expected) / (1 + likelihood.min() / expected)


def make_model(classes: int = CLASSES, levels: int = LEVELS) -> FovealObservationModel:
    """A model whose scores get flatter with the distance."""
    sharp = torch.linspace(8, 0.5, levels)[:, None] * torch.eye(classes + 1)[:, None]
    edges = torch.arange(1, levels) * 50 / 640
    return (
        FovealObservationModel(0.1 + sharp, edges, [f"class {n}" for n in range(classes)]).eval().requires_grad_(False)
    )


def make_belief(cells: int, classes: int = CLASSES, batch: int = 1) -> Tensor:
    """Beliefs after some looks."""
    generator = torch.Generator().manual_seed(0)
    return 0.5 + torch.rand(batch, cells, classes + 1, generator=generator).pow(8) * 6


def make_look(cells: int, classes: int = CLASSES, batch: int = 1) -> tuple[Tensor, Tensor]:
    """Likelihoods of detections, and boxes of about a tenth of the cells."""
    generator = torch.Generator().manual_seed(1)
    likelihood = (3 * torch.randn(batch, DETECTIONS, classes + 1, generator=generator)).softmax(-1)
    return likelihood, torch.rand(batch, DETECTIONS, cells, generator=generator) < 0.1


def kaplan_update() -> Comparison:
    """30 detections into a map of 10 × 10 cells and 81 classes."""
    beta, (likelihood, footprint) = make_belief(100), make_look(100)
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


def predictive_search() -> Comparison:
    """Expected posterior of a target in every cell."""
    beta, model = make_belief(100), make_model()
    expected, cells = model.expected_scores()[:, 0].double().numpy(), beta[0].double().numpy()
    value = acquisition.PredictedTargetPosterior(5, model)

    def loop() -> Array:
        result = np.empty(len(cells))
        for cell, row in enumerate(cells):
            after = kaplan(row, (row / row.sum()) @ expected)
            result[cell] = after[5] / after.sum()
        return result

    def ours() -> Tensor:
        return value(beta)

    def agree() -> None:
        np.testing.assert_allclose(ours()[0].numpy(), loop(), rtol=1e-4)

    return Comparison("predictive search, one decision", ours, {"loop over cells": loop}, {}, agree)


def exploration(name: str) -> Comparison:
    """Value of every next fixation; the loop does one fixation of the hundred."""
    grid, model, beta = Grid(10, 10, (640, 480)), make_model(), make_belief(100)
    value = {"KL divergence": acquisition.KLDivergence, "negative entropy": acquisition.NegativeEntropy}[name](
        model, grid
    )
    levels = model.level(grid.cell_distance)
    table, cells = model.expected_scores().double().numpy(), beta[0].double().numpy()

    def gain(before: Array, after: Array) -> float:
        p, q = before / before.sum(), after / after.sum()
        if name == "KL divergence":
            return float((q * np.log(q / p)).sum())
        return float((q * np.log(q)).sum() - (p * np.log(p)).sum())

    def loop(fixations: int = 1) -> list[float]:
        return [
            sum(gain(row, kaplan(row, (row / row.sum()) @ table[:, levels[cell, f]])) for cell, row in enumerate(cells))
            for f in range(fixations)
        ]

    def brute() -> Tensor:
        wide = beta[0].double()
        mean = wide / wide.sum(-1, keepdim=True)
        scores = torch.einsum("xk,knj->xnj", mean, model.expected_scores().double())
        every = scores[torch.arange(len(wide))[:, None], levels]
        after = fusion.kaplan(wide[:, None].expand_as(every), every)
        after = after / after.sum(-1, keepdim=True)
        if name == "KL divergence":
            return (after * (after / mean[:, None]).log()).sum((-1, 0))
        return (after * after.log()).sum((-1, 0)) - (mean * mean.log()).sum()

    def ours() -> Tensor:
        return value(beta)

    def agree() -> None:
        torch.testing.assert_close(ours()[0].double(), brute(), rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(brute()[:1].numpy(), loop(), rtol=1e-6)

    peers = {"loop over fixations and cells": loop, "all pairs at once": brute}
    share = {"loop over fixations and cells": 1 / len(grid)}
    return Comparison(f"exploration, {name}, one decision", ours, peers, share, agree)
