"""Explorations of one scene, and how many cells of their maps are right."""

from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.episode import StoredLooks, rollout
from semfov.gaze.choice import Greedy, drawn_from
from semfov.metrics.episodes import right_cells
from semfov.runs.protocols import Exploration
from semfov.strategy import Strategy

_Progress = tuple[list[int], dict[str, list[int]]]
"""Result of an exploration: the fixated cells in order, and numbers of right cells after each shift, by name."""


def run_explorations(
    episodes: Sequence[Exploration],
    strategy: Strategy,
    looks: StoredLooks,
    answers: Tensor,
    noise: Tensor,
    *,
    shifts: int,
    batch: int,
) -> list[_Progress]:
    """Run explorations of one scene until their gaze shifts are spent or no cell is left.

    Args:
        episodes: B explorations.
        strategy: the observer, and the policy that chooses fixations.
        looks: the looks from every cell.
        answers: `(X·Y, K+1)` boolean, the classes that each cell holds.
        noise: `(B, shifts+1, X·Y)`, by which ties are broken.
        shifts: largest number of gaze shifts.
        batch: number of explorations that run side by side.

    Returns:
        For each exploration the fixated cells, and the numbers of right cells after each shift (`counts_of`).
    """
    starts = torch.tensor([episode.start for episode in episodes])
    progress: list[_Progress] = []
    for start, noise_of_batch in zip(starts.split(batch), noise.split(batch), strict=True):
        visits = []
        counts = []
        steps = rollout(
            looks,
            strategy.observer,
            lambda _, cell: strategy.acquisition(None, looks.grid, cell),
            start,
            Greedy(drawn_from(noise_of_batch)),
            most=shifts + 1,
        )
        for step in steps:
            visits.append(step.cell)
            counts.append(counts_of(step.belief.class_probabilities(), answers))
        # All episodes have made the same number of shifts and run out of cells together: nothing changes after that.
        counts += [counts[-1]] * (shifts + 1 - len(counts))
        by_name = {name: torch.stack([after[name] for after in counts], 1).tolist() for name in counts[0]}
        for row, cells in enumerate(torch.stack(visits, 1).tolist()):
            progress.append((cells, {name: numbers[row] for name, numbers in by_name.items()}))
    return progress


def counts_of(probabilities: Tensor, answers: Tensor) -> dict[str, Tensor]:
    """Count the right cells of maps.

    Args:
        probabilities: `(B, X·Y, K+1)`, of background and classes.
        answers: `(X·Y, K+1)` boolean, the classes that each cell holds; background never.

    Returns:
        Numbers `(B,)` of cells with objects that are right (`right`), that would be without background as an answer
        (`right_without_background`), and of all cells that are right (`right_everywhere`).
    """
    everywhere = torch.cat([~answers.any(-1, keepdim=True), answers[:, 1:]], -1)
    return {
        "right": right_cells(probabilities, answers).sum(-1),
        "right_without_background": right_cells(probabilities[..., 1:], answers[:, 1:]).sum(-1),
        "right_everywhere": right_cells(probabilities, everywhere).sum(-1),
    }
