"""How fitted ways to search and to explore do beside raw ones, on photographs that were held out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.agent import Strategy
from semfov.belief.grid import Grid
from semfov.data.scene import legal_targets
from semfov.decision import OUTCOMES, confirms
from semfov.episode import Step, StoredLooks
from semfov.experiments.candidates import Candidate
from semfov.experiments.config import ProtocolConfig
from semfov.experiments.decisions import search_steps
from semfov.experiments.exploration_protocol import explorations_of, explore_noise, run_explorations
from semfov.experiments.progress import track
from semfov.experiments.search_protocol import choose_classes, episodes_of, run_episodes, tie_noise
from semfov.experiments.seeds import generator_for, noise_for
from semfov.metrics.averages import standard_error
from semfov.metrics.exploration import answers_of, success_rate
from semfov.metrics.search import cumulative_performance
from semfov.training.evidence_examples import LookingRun

Array = NDArray[np.float64]
Ways = Mapping[str, Strategy]
"""Ways to go about a task, by what reports call them."""


class Rule(Protocol):
    """Which searches for a class end with a step."""

    def __call__(self, step: Step, target: int, grid: Grid) -> Tensor:
        """Numbers of their outcomes (`semfov.decision.OUTCOMES`), 0 for those that go on."""


@dataclass(frozen=True)
class Difference:
    """How much greater a fitted figure is than the raw one, paired over photographs.

    Attributes:
        mean: over photographs.
        error: its standard error; NaN for fewer than two photographs.
        photographs: how many.
    """

    mean: float
    error: float
    photographs: int

    @classmethod
    def of(cls, fitted: Array, raw: Array) -> Difference:
        """The difference of figures `(P,)`, one for each photograph."""
        paired = np.asarray(fitted, dtype=np.float64) - np.asarray(raw, dtype=np.float64)
        return cls(float(paired.mean()), float(standard_error(paired)), len(paired))

    @property
    def better(self) -> bool:
        """Whether it is greater than its standard error, so that chance alone is an unlikely reason."""
        return math.isfinite(self.error) and self.mean > 0 and self.mean > self.error


def search_curves(
    run: LookingRun, scenes: Sequence[int], ways: Ways, protocol: ProtocolConfig, max_area: float
) -> dict[str, Array]:
    """Cumulative performance of each way to search, `(P, shifts+1)`, of every photograph with a target.

    Args:
        run: that has looked.
        scenes: indices of the photographs.
        ways: to search.
        protocol: starts, shifts and seed.
        max_area: classes that cover a larger share of the image are not searched for.
    """
    columns, rows = run.config.belief.columns, run.config.belief.rows
    curves: dict[str, list[Array]] = {name: [] for name in ways}
    for index in track(scenes, "searching", "scene"):
        targets = legal_targets(run.scenes.annotation(index), max_area)
        episodes = episodes_of(run.scenes, index, columns, rows, protocol, targets)
        if not episodes:
            continue
        grid, detections = run.grid(index), run.detections(index)
        noise = torch.stack([tie_noise(run.scenes, episode, len(grid), protocol) for episode in episodes])
        for name, strategy in ways.items():
            with torch.inference_mode():
                outcomes = run_episodes(
                    episodes,
                    Candidate(strategy),
                    detections,
                    grid,
                    noise,
                    shifts=protocol.shifts,
                    batch=protocol.batch,
                )
            found = np.array([outcome.found_at for outcome in outcomes])
            curves[name].append(cumulative_performance(found, protocol.shifts))
    return {name: np.array(each).reshape(-1, protocol.shifts + 1) for name, each in curves.items()}


def explore_curves(
    run: LookingRun, scenes: Sequence[int], ways: Ways, protocol: ProtocolConfig
) -> dict[str, dict[str, Array]]:
    """Shares of cells that are named right by each way to explore, `(P, shifts+1)`: `objects`, and `all` cells.

    `objects` is the published success rate, over cells with objects; the answer for all cells may be background, which
    is right where no object is. Arguments as for `search_curves`.
    """
    curves: dict[str, dict[str, list[Array]]] = {what: {name: [] for name in ways} for what in ("objects", "all")}
    for index in track(scenes, "exploring", "scene"):
        grid = run.grid(index)
        answers = answers_of(run.scenes.annotation(index), grid, len(run.scenes.classes) + 1)
        if not answers.any():
            continue
        detections = run.detections(index)
        episodes = explorations_of(run.scenes, index, len(grid), protocol)
        noise = torch.stack([explore_noise(run.scenes, episode, len(grid), protocol) for episode in episodes])
        cells = int(answers.any(-1).sum())
        for name, strategy in ways.items():
            with torch.inference_mode():
                progress = run_explorations(
                    episodes,
                    Candidate(strategy),
                    detections,
                    grid,
                    answers,
                    noise,
                    shifts=protocol.shifts,
                    batch=protocol.batch,
                )
            rates = [success_rate(each.right, cells) for each in progress]
            curves["objects"][name].append(np.mean(rates, axis=0))
            rates = [success_rate(each.right_everywhere, len(grid)) for each in progress]
            curves["all"][name].append(np.mean(rates, axis=0))
    return {
        what: {name: np.array(each).reshape(-1, protocol.shifts + 1) for name, each in ways_of.items()}
        for what, ways_of in curves.items()
    }


@dataclass(frozen=True)
class Decided:
    """What searches for classes that are there, and for classes that are not, decided: shares, and mean looks."""

    found: float
    false_alarms: float
    undecided: float
    looks: float
    searches: int


def decisions(
    run: LookingRun,
    scenes: Sequence[int],
    ways: Mapping[str, tuple[Strategy, Rule]],
    protocol: ProtocolConfig,
    classes: int,
    max_area: float,
) -> dict[str, Decided]:
    """What each way to search, with its rule of deciding, decides.

    Args:
        run: that has looked.
        scenes: indices of the photographs.
        ways: to search, with their rules.
        protocol: shifts and seed.
        classes: of each photograph that it holds, and that it does not hold, at most.
        max_area: classes that cover a larger share of the image are left out.
    """
    told: dict[str, list[tuple[bool, str, int]]] = {name: [] for name in ways}
    for index in track(scenes, "deciding", "scene"):
        annotation, grid = run.scenes.annotation(index), run.grid(index)
        chosen = choose_classes(run.scenes, index, annotation, classes, max_area, protocol.seed, classes)
        detections = run.detections(index) if chosen else None
        for target in chosen:
            assert detections is not None
            generator = generator_for("start", protocol.seed, run.scenes.ids[index], target)
            start = torch.randint(len(grid), (1,), generator=generator)
            noise = noise_for(protocol, len(grid), run.scenes.ids[index], target, 0)[None]
            looks = StoredLooks(detections, grid, torch.tensor([target]))
            there = bool((annotation.labels == target).any())
            for name, (strategy, rule) in ways.items():
                ends = partial(rule, target=target, grid=grid)
                outcome, count = _search(looks, strategy, target, start, noise, ends)
                told[name].append((there, outcome, count))
    return {name: _decided(each) for name, each in told.items()}


@torch.inference_mode()
def _search(
    looks: StoredLooks, strategy: Strategy, target: int, start: Tensor, noise: Tensor, rule: Callable[[Step], Tensor]
) -> tuple[str, int]:
    """What one search decides, and after how many looks."""
    steps = search_steps(looks, strategy, target, start, noise, rule)
    return OUTCOMES[int(rule(steps[-1]))], len(steps)


def by_detection(step: Step, target: int, grid: Grid) -> Tensor:
    """The rule of agents without models: found with a detection of a score of 0.5 in the fixated cell."""
    return confirms(step.detections, grid, step.cell, target, 0.5).long()


def _decided(searches: Sequence[tuple[bool, str, int]]) -> Decided:
    def share(outcome: str, which: Sequence[bool]) -> float:
        chosen = [each[1] == outcome for each in searches if each[0] in which]
        return sum(chosen) / len(chosen) if chosen else math.nan

    return Decided(
        share("found", [True]),
        share("found", [False]),
        share("undecided", [True, False]),
        sum(each[2] for each in searches) / max(len(searches), 1),
        len(searches),
    )
