"""Looks of a fovea at a photograph: the kind of agent that moves its gaze over a grid of cells."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from semfov.agents.limits import EpisodeLimits
from semfov.belief.grid import Grid
from semfov.belief.observers import LearnedMap
from semfov.belief.observers.any_of import TargetLike, class_meant
from semfov.belief.verification import Verification
from semfov.decision import (
    OUTCOMES,
    CandidateCells,
    Decision,
    Verifier,
    conclude,
    goal_cells,
    outcome_by_gain,
    outcome_of,
)
from semfov.episode import LiveLooks, Step, rollout
from semfov.errors import InputError, check, check_whole
from semfov.eye import Eye
from semfov.gaze.acquisition import ExpectedGain
from semfov.gaze.choice import Greedy, drawn_by, first_cell
from semfov.paths import Ending, Scanpath, Stimulus, Trace
from semfov.strategy import Strategy

_WORTH = 0.1
"""Default least gain of a look in an exploration by a learned map: the expected increase in the number of correctly
classified cells for which the exploration continues."""

_MOST_SHIFTS = 10_000
"""Largest number of gaze shifts that can be asked for."""

Start = int | tuple[int, int] | None
"""First cell of an episode: its number, its column and row, or None to draw one."""


@dataclass(frozen=True)
class FoveaAgent:
    """An agent that moves its gaze over a photograph `(1, 3, H, W)`.

    The arguments of its methods are those of `ActivePerception`, which makes it.

    Shapes: cells `(columns, rows)`.
    """

    eye: Eye
    searching: Strategy
    exploring: Strategy
    verification: Verification | None
    cells: tuple[int, int]

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, background first."""
        return ("background", *self.eye.detector.classes)

    def search(
        self,
        image: Tensor,
        target: TargetLike,
        limits: EpisodeLimits,
        *,
        start: Start = None,
        shifts: int | None = None,
        seed: int = 0,
        boxes: Tensor | Sequence[Sequence[float]] | None = None,
        confirm: float | None = None,
        give_up: float | None = None,
        closer: int = 0,
    ) -> Scanpath:
        """Search a photograph for a target, and decide whether it is there (`ActivePerception.search`)."""
        strategy, index, weights = self.searching.sought(target, self.classes)
        grid = self.grid(image)
        goal = None if boxes is None else goal_cells(boxes, grid, image)
        chosen = strategy.observer.thresholds
        thresholds = None if chosen is None else chosen.changed(confirm, give_up)
        verifier, model = None, self.deciding(closer)
        if model is not None and model.thresholds is not None and goal is None:
            at = model.thresholds.changed(confirm, give_up)
            places, close_up = CandidateCells(grid, index), partial(self.eye.close_up, image)
            verifier = Verifier(model, places, close_up, at, closer)
        outcome = outcome_of(weights, grid, goal, thresholds, 0.5 if confirm is None else confirm)
        episode = _Episode(self, image, grid, strategy, index, limits, verifier, outcome)
        scanpath, ended, last = episode.run(start, shifts, 30, seed)
        index = class_meant(last.belief, index)
        scanpath = replace(scanpath, found=OUTCOMES[ended] == "found", target=index)
        if goal is not None:
            return replace(scanpath, ending="box") if ended else scanpath
        decision: Decision
        if verifier is not None:
            decision = verifier.conclude(episode.room)
            found = decision.outcome == "found"
            index = verifier.best.target if found else index
            scanpath = replace(scanpath, found=found, target=index, closer=tuple(verifier.looks))
        else:
            # Without thresholds the target was found in the fixated cell.
            cell = None if thresholds is not None else int(last.cell)
            decision = conclude(ended, last.belief, scanpath.detections, grid, index, cell)
        if ended:
            calibrated = verifier is not None or thresholds is not None
            scanpath = replace(scanpath, ending="decision" if calibrated else "detection")
        return replace(scanpath, decision=decision)

    def explore(
        self,
        image: Tensor,
        limits: EpisodeLimits,
        *,
        start: Start = None,
        shifts: int | None = None,
        seed: int = 0,
        worth: float | None = None,
    ) -> Scanpath:
        """Explore a photograph, without a target (`ActivePerception.explore`)."""
        grid, observer, outcome = self.grid(image), self.exploring.observer, None
        if isinstance(observer, LearnedMap):
            outcome = outcome_by_gain(ExpectedGain(observer.model, grid), _WORTH if worth is None else worth)
        elif worth:
            raise InputError(
                f"worth: expected None for an agent without a learned map, got {worth}; use the recommended agent"
            )
        episode = _Episode(self, image, grid, self.exploring, None, limits, None, outcome)
        scanpath, ended, _ = episode.run(start, shifts, 20, seed)
        return replace(scanpath, ending="worth") if ended else scanpath

    def find_all(
        self, image: Tensor, targets: tuple[int, ...], limits: EpisodeLimits, *, shifts: int | None = None
    ) -> Scanpath:
        """Look for all objects of classes 1..K; none stand for all classes (`ActivePerception.find_all`)."""
        one = targets[0] if len(targets) == 1 else None
        strategy = self.exploring if one is None else self.searching
        episode = _Episode(self, image, self.grid(image), strategy, one, limits, None, None)
        return replace(episode.run(None, shifts, 20, 0)[0], target=None, targets=targets)

    def grid(self, image: Tensor) -> Grid:
        """The grid of the belief over an image `(1, 3, H, W)`."""
        return Grid(*self.cells, (image.shape[-1], image.shape[-2]))

    def deciding(self, closer: int) -> Verification | None:
        """The model for closer looks, if they are wanted and it can decide."""
        model = self.verification
        return model if closer and model is not None and model.thresholds is not None else None


class _Episode:
    """One episode in an image, until an outcome, a limit, or until no shift or cell is left."""

    def __init__(
        self,
        agent: FoveaAgent,
        image: Tensor,
        grid: Grid,
        strategy: Strategy,
        target: int | None,
        limits: EpisodeLimits,
        verifier: Verifier[Step] | None,
        outcome: Callable[[Step], Tensor] | None,
    ) -> None:
        self.agent, self.image, self.grid, self.strategy, self.target = agent, image, grid, strategy, target
        self.limits, self.verifier, self.outcome = limits, verifier, outcome
        mapper = agent.exploring.observer
        beside, least = None if mapper is strategy.observer else mapper, agent.eye.detector.least
        self.trace = Trace(grid, agent.classes, target, beside, least)
        self.stimulus = Stimulus.of(agent.eye, image)
        self.ended: int = 0
        self.limit: Ending | None = None

    @property
    def passes(self) -> int:
        """Number of passes of the detector so far."""
        return len(self.trace.steps) + (0 if self.verifier is None else len(self.verifier.looks))

    @property
    def room(self) -> float:
        """Number of passes that are left; none after another limit was reached."""
        return self.limits.room(self.passes) if self.limit in (None, "passes") else 0

    def run(self, start: Start, shifts: int | None, default: int, seed: int) -> tuple[Scanpath, int, Step]:
        """Move the gaze; returns the scanpath, the number of the outcome and the last step."""
        if shifts is None:
            shifts = default if self.limits.passes is None else _MOST_SHIFTS
        check_whole(shifts, "shifts", 0, _MOST_SHIFTS)
        first, generator = first_cell(cell_at(start, self.agent.cells), seed, len(self.grid))
        eye, grid = self.agent.eye, self.grid
        looks = LiveLooks(eye, eye.open(self.image), grid, self.target)
        begin, choice = (
            torch.tensor([first], device=self.image.device),
            Greedy(drawn_by(generator, len(grid), self.image)),
        )
        policy = self.strategy.policy(self.target, grid)
        for _ in rollout(looks, self.strategy.observer, policy, begin, choice, most=shifts + 1, ends=self._ends):
            pass
        last = self.trace.steps[-1]
        usual: Ending = "cells" if bool(last.visited.all()) else "shifts"
        return replace(self._scanpath(), ending=self.limit or usual), self.ended, last

    def _ends(self, step: Step) -> Tensor:
        self.trace.add(step)
        if self.verifier is not None:
            self.verifier.see(step)
            self.verifier.look_closely(self.limits.room(self.passes))
            self.ended = self.verifier.outcome()
        elif self.outcome is not None:
            self.ended = int(self.outcome(step))
        if not self.ended:
            self.limit = self.limits.reached(self.passes, self._so_far)
        elif self.limits.on_look is not None:
            self.limits.on_look(self._so_far())
        return torch.full_like(step.cell, bool(self.ended or self.limit), dtype=torch.bool)

    def _scanpath(self) -> Scanpath:
        return replace(self.trace.scanpath(), stimulus=self.stimulus)

    def _so_far(self) -> Scanpath:
        """The scanpath so far, with the decision as it stands."""
        verifier = self.verifier
        if verifier is None:
            return self._scanpath()
        return replace(self._scanpath(), decision=verifier.decision(), closer=tuple(verifier.looks))


def cell_at(start: Start, cells: tuple[int, int]) -> int | None:
    """The number of the cell at `(column, row)`; numbers and None stay as they are.

    >>> cell_at((3, 2), (10, 10)), cell_at(7, (10, 10))
    (23, 7)
    """
    if not isinstance(start, tuple | list):
        return start
    check(len(start) == 2, "start", "a cell, or its (column, row)", start)
    column, row = start
    check_whole(column, "start", 0, cells[0] - 1)
    check_whole(row, "start", 0, cells[1] - 1)
    return int(row) * cells[0] + int(column)
