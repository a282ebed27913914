"""Compare fitted strategies for search and exploration with raw scores on held-out photographs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import legal_targets
from semfov.decision import OUTCOMES, confirms
from semfov.episode import Step, StoredLooks
from semfov.metrics.averages import FloatArray, standard_error
from semfov.metrics.exploration import answers_of, success_rate
from semfov.metrics.search import cumulative_performance
from semfov.runs.candidates import Candidate
from semfov.runs.config import ProtocolConfig
from semfov.runs.exploration_protocol import explorations_of, explore_noise, run_explorations
from semfov.runs.looking import Looking
from semfov.runs.progress import track
from semfov.runs.search_protocol import choose_searches, episodes_of, looks_of, run_episodes, search_steps, tie_noise
from semfov.strategy import Strategy

_Ways = Mapping[str, Strategy]
"""Strategies for a task, by their names in reports."""


Rule = Callable[..., Tensor]
"""Decides after a `step` which searches for a `target` end: numbers of their outcomes, 0 for those that go on."""


class Difference(NamedTuple):
    """The difference between a measure with fitted models and with raw scores, paired over photographs."""

    mean: float
    error: float
    photographs: int

    @classmethod
    def of(cls, fitted: FloatArray, raw: FloatArray) -> Difference:
        """Compute the paired difference of two measures `(P,)`, with one value for each photograph."""
        paired = np.asarray(fitted, dtype=np.float64) - np.asarray(raw, dtype=np.float64)
        return cls(float(paired.mean()), float(standard_error(paired)), len(paired))

    @property
    def better(self) -> bool:
        """Whether the mean is positive and greater than its standard error."""
        return math.isfinite(self.error) and self.mean > 0 and self.mean > self.error


def search_curves(
    run: Looking, scenes: Sequence[int], ways: _Ways, protocol: ProtocolConfig, max_area: float
) -> dict[str, FloatArray]:
    """Measure the cumulative performance of search strategies on every photograph with a target; → `(P, shifts+1)`."""
    curves: dict[str, list[FloatArray]] = {name: [] for name in ways}
    for index in track(scenes, "searching", "scene"):
        targets = legal_targets(run.scenes.annotation(index), max_area)
        episodes = episodes_of(run.scenes, index, *run.config.cells, protocol, targets)
        if not episodes:
            continue
        grid = run.grid(index)
        looks = looks_of(episodes, run.detections(index), grid)
        noise = torch.stack([tie_noise(run.scenes, episode, len(grid), protocol) for episode in episodes])
        for name, strategy in ways.items():
            with torch.inference_mode():
                outcomes = run_episodes(
                    episodes, Candidate(strategy), looks, noise, shifts=protocol.shifts, batch=protocol.batch
                )
            shifts = np.array([found_at for _, found_at in outcomes])
            curves[name].append(cumulative_performance(shifts, protocol.shifts))
    return {name: np.array(each).reshape(-1, protocol.shifts + 1) for name, each in curves.items()}


def explore_curves(
    run: Looking, scenes: Sequence[int], ways: _Ways, protocol: ProtocolConfig
) -> dict[str, dict[str, FloatArray]]:
    """Measure the share of cells that exploration strategies classify correctly.

    The answer for a cell may be background, which is correct if the cell contains no object.

    Shapes: → `(P, shifts+1)`.
    """
    curves: dict[str, dict[str, list[FloatArray]]] = {what: {name: [] for name in ways} for what in ("objects", "all")}
    for index in track(scenes, "exploring", "scene"):
        grid = run.grid(index)
        answers = answers_of(run.scenes.annotation(index), grid, len(run.scenes.classes) + 1)
        if not answers.any():
            continue
        looks = StoredLooks(run.detections(index), grid)
        episodes = explorations_of(run.scenes, index, len(grid), protocol)
        noise = torch.stack([explore_noise(run.scenes, episode, len(grid), protocol) for episode in episodes])
        cells = int(answers.any(-1).sum())
        for name, strategy in ways.items():
            with torch.inference_mode():
                progress = run_explorations(
                    episodes,
                    Candidate(strategy),
                    looks,
                    answers,
                    noise,
                    shifts=protocol.shifts,
                    batch=protocol.batch,
                )
            rates = [success_rate(counts["right"], cells) for _, counts in progress]
            curves["objects"][name].append(np.mean(rates, axis=0))
            rates = [success_rate(counts["right_everywhere"], len(grid)) for _, counts in progress]
            curves["all"][name].append(np.mean(rates, axis=0))
    return {
        what: {name: np.array(each).reshape(-1, protocol.shifts + 1) for name, each in ways_of.items()}
        for what, ways_of in curves.items()
    }


_DecisionRates = tuple[float, float, float, float, int]
"""Shares of searches that find a present class, find an absent one, and decide nothing; mean looks; searches."""


def decisions(
    run: Looking,
    scenes: Sequence[int],
    ways: Mapping[str, tuple[Strategy, Rule]],
    protocol: ProtocolConfig,
    classes: int,
    max_area: float,
) -> dict[str, _DecisionRates]:
    """Evaluate the decisions of search strategies."""
    results: dict[str, list[tuple[bool, str, int]]] = {name: [] for name in ways}
    for index in track(scenes, "deciding", "scene"):
        annotation, grid = run.scenes.annotation(index), run.grid(index)
        searches = choose_searches(run.scenes, index, grid, protocol, classes, max_area, classes)
        if not searches:
            continue
        detections = run.detections(index)
        for search in searches:
            target = search.target
            looks = StoredLooks(detections, grid, torch.tensor([target]))
            there = bool((annotation.labels == target).any())
            for name, (strategy, rule) in ways.items():
                ends = partial(rule, target=search.target, grid=grid)
                with torch.inference_mode():
                    steps = search_steps(looks, strategy, target, search.start, search.noise, ends)
                    outcome = OUTCOMES[int(ends(steps[-1]))]
                results[name].append((there, outcome, len(steps)))
    return {name: _rates(each) for name, each in results.items()}


def by_detection(step: Step, target: int, grid: Grid) -> Tensor:
    """Decide as agents without fitted models: the target is found by a detection with score 0.5 in the fixated cell."""
    return confirms(step.detections, grid, step.cell, target, 0.5).long()


def _rates(searches: Sequence[tuple[bool, str, int]]) -> _DecisionRates:
    def share(outcome: str, which: Sequence[bool]) -> float:
        chosen = [each[1] == outcome for each in searches if each[0] in which]
        return sum(chosen) / len(chosen) if chosen else math.nan

    return (
        share("found", [True]),
        share("found", [False]),
        share("undecided", [True, False]),
        sum(each[2] for each in searches) / max(len(searches), 1),
        len(searches),
    )
