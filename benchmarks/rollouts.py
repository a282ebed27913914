"""Comparison of searches run as one batch of tensors with the same searches run one after another."""

from collections.abc import Callable

import torch

from benchmarks.timing import Comparison
from semfov import Detections, Grid, observers, policies
from semfov.episode import StoredLooks
from semfov.runs.protocols import Trial, run_episodes
from semfov.strategy import Strategy

CLASSES, SHIFTS = 80, 30


def episode(number: int) -> Trial:
    """Return the search of this number; successive searches have different targets and starts."""
    target = 1 + number % CLASSES
    start = 1 + number % 99
    return Trial(scene=0, target=target, cue=target, repetition=number, start=start, goal=(0,), commonest=False)


def searches(episodes: int) -> tuple[Detections, Callable[[int, int], object]]:
    """Make detections from each cell of a scene, and a function that runs `count` searches in it, `batch` at a time."""
    generator = torch.Generator().manual_seed(0)
    grid = Grid(10, 10, (640, 480))
    corner = torch.rand(100, 12, 2, generator=generator) * torch.tensor([560.0, 400.0])
    boxes = torch.cat([corner, corner + 20 + 60 * torch.rand(100, 12, 2, generator=generator)], -1)
    scores = (3 * torch.randn(100, 12, CLASSES + 1, generator=generator)).softmax(-1)
    detections = Detections(boxes, scores, torch.ones(100, 12, dtype=torch.bool))
    todo = [episode(n) for n in range(episodes)]
    noise = torch.rand(episodes, SHIFTS + 1, 100, generator=generator)
    strategy = Strategy(observers.Semantic(CLASSES + 1), policies.Policy("non-predictive"))

    def run(count: int, batch: int) -> object:
        looks = StoredLooks(detections, grid, torch.tensor([episode.cue for episode in todo[:count]]))
        return run_episodes(todo[:count], strategy, looks, noise[:count], shifts=SHIFTS, batch=batch)

    return detections, run


def rollouts(episodes: int = 40) -> Comparison:
    """Return searches of 30 gaze shifts in one scene; the peer runs a quarter of them, one at a time."""
    run = searches(episodes)[1]

    def agree() -> None:
        assert run(episodes, episodes) == run(episodes, 1)

    peers = {"one at a time": lambda: run(episodes // 4, 1)}
    name = f"{episodes} searches of {SHIFTS} shifts"
    return Comparison(name, lambda: run(episodes, episodes), peers, {"one at a time": 1 / 4}, agree)
