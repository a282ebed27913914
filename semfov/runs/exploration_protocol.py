"""The protocol of explorations: the episodes of a scene, and their results."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.data.scene import Scenes
from semfov.episode import StoredLooks, rollout
from semfov.gaze.choice import Greedy, drawn_from
from semfov.metrics.episodes import right_cells
from semfov.runs.config import ProtocolConfig
from semfov.runs.seeds import generator_for
from semfov.strategy import Strategy


class Exploration(NamedTuple):
    """One exploration of a scene."""

    scene: int
    repetition: int
    start: int


def explorations_of(scenes: Scenes, index: int, cells: int, protocol: ProtocolConfig) -> list[Exploration]:
    """All explorations of a scene; their starts differ as long as there are enough cells."""
    generator = generator_for("start", protocol.seed, scenes.ids[index])
    rounds = -(-protocol.starts // cells)
    order = torch.cat([torch.randperm(cells, generator=generator) for _ in range(rounds)])
    return [Exploration(index, number, start) for number, start in enumerate(order[: protocol.starts].tolist())]


def run_explorations(
    episodes: Sequence[Exploration],
    strategy: Strategy,
    looks: StoredLooks,
    answers: Tensor,
    noise: Tensor,
    *,
    shifts: int,
    batch: int,
) -> list[tuple[list[int], dict[str, list[int]]]]:
    """Run explorations of one scene, `batch` at a time, until their gaze shifts are spent or no cell is left.

    Shapes: noise `(episodes, shifts+1, X·Y)`.
    """
    starts = torch.tensor([episode.start for episode in episodes])
    progress = []
    for start, random in zip(starts.split(batch), noise.split(batch), strict=True):
        choice = Greedy(drawn_from(random))
        visits, counts = [], []
        for step in rollout(
            looks,
            strategy.observer,
            lambda _, cell: strategy.acquisition(None, looks.grid, cell),
            start,
            choice,
            most=shifts + 1,
        ):
            probabilities = step.belief.class_probabilities()
            visits.append(step.cell)
            counts.append(counts_of(probabilities, answers))
        # All episodes have made the same number of shifts and run out of cells together: nothing changes after that.
        counts += [counts[-1]] * (shifts + 1 - len(counts))
        tables = {name: torch.stack([each[name] for each in counts], 1).tolist() for name in counts[0]}
        rows = [dict(zip(tables, row, strict=True)) for row in zip(*tables.values(), strict=True)]
        progress += list(zip(torch.stack(visits, 1).tolist(), rows, strict=True))
    return progress


def counts_of(probabilities: Tensor, answers: Tensor) -> dict[str, Tensor]:
    """Numbers of right cells of maps `(B, X·Y, K+1)`, each `(B,)`."""
    everywhere = torch.cat([~answers.any(-1, keepdim=True), answers[:, 1:]], -1)
    return {
        "right": right_cells(probabilities, answers).sum(-1),
        "right_without_background": right_cells(probabilities[..., 1:], answers[:, 1:]).sum(-1),
        "right_everywhere": right_cells(probabilities, everywhere).sum(-1),
    }
