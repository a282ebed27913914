"""Stopping criteria of a fovea: when an episode ends, and what a search decides (the table in `semfov.decision`)."""

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Literal

from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.observers.any_of import class_meant
from semfov.data.inputs import FRAME
from semfov.decision.candidates import CandidatePlace
from semfov.decision.rule import (
    FOUND,
    GO_ON,
    CloseUp,
    Decision,
    decide,
    decision_without_closer_looks,
    detects,
    gains_less,
)
from semfov.decision.state import DecisionState
from semfov.decision.verifier import Verifier
from semfov.detection.detections import Detections
from semfov.episode import Forgetting, Step
from semfov.observation.thresholds import Thresholds

_MOST_RECENT = 1000  # largest number of looks whose detections are kept in a stream


class StoppingCriterion(DecisionState):
    """Base of the stopping criteria, which never ends an episode, and decides nothing.

    Attributes:
        ending: reason for an end that it makes.
    """

    ending: Literal["box", "min_gain", "detection", "decision"] = "min_gain"

    def see(self, step: Step) -> None:
        """Update the criterion with a fixation."""

    def end_search(self) -> None:
        """Let no fixation follow; closer looks may come due that are worth a pass at the end."""

    def examine(self, detections: Detections) -> CloseUp:
        """Judge the candidate by what a closer look shows, a batch of one, and choose the next one."""
        raise NotImplementedError

    def found_class(self, belief: Belief, target: int) -> int:
        """Find the class that a search for one or several classes has found, or searched for."""
        return class_meant(belief, target)

    def wait(self, passed: float = FRAME) -> None:
        """Let seconds pass. In a stream, call it before every frame."""


class AtGoal(StoppingCriterion):
    """Ends a search when the gaze is on one of the cells `goal` `(X·Y,)`, as in the paper's experiments.

    The studies have it for many searches at once (`semfov.runs.protocols.run_episodes`).
    """

    ending = "box"

    def __init__(self, goal: Tensor) -> None:
        self.goal = goal

    def see(self, step: Step) -> None:
        self.outcome = FOUND if bool(self.goal[step.cell]) else GO_ON


class LittleGain(StoppingCriterion):
    """Ends an exploration where no look is expected to gain at least `least` (`gains_less`)."""

    def __init__(self, gain: Callable[[Belief, Tensor], Tensor], least: float) -> None:
        self.gain = gain
        self.least = least

    def see(self, step: Step) -> None:
        self.outcome = int(gains_less(step, gain=self.gain, least=self.least))


class _ByBelief(StoppingCriterion):
    """Base of the criteria of a search without closer looks, whose decision rests on the belief and the detections.

    In a stream, the detections of the looks count of which at least half of the evidence is left.
    """

    _confirm: float | None = None  # least presence for `found`

    def __init__(self, grid: Grid, target: int, forgetting: Forgetting | None = None) -> None:
        self.grid = grid
        self.target = target
        self._span = math.inf if forgetting is None else forgetting.span
        self._now = 0.0  # seconds of the stream
        self._step: Step | None = None
        # The detections of the looks that count, each with its time.
        # With rate 0 none is ever too old, so their number has a limit, too.
        self._recent: deque[tuple[float, Detections]] = deque(maxlen=_MOST_RECENT if forgetting else None)

    def see(self, step: Step) -> None:
        self._step = step
        self._recent.append((self._now, step.detections))
        # The look of now is never so old, so that one is always left.
        while self._now - self._recent[0][0] >= self._span:
            self._recent.popleft()
        self.outcome = self._judge(step)

    def _judge(self, step: Step) -> int:
        """Decide after a fixation."""
        raise NotImplementedError

    def _cell(self, step: Step) -> int | None:
        """Name the cell of a found target; None for the one with the strongest evidence."""
        return None

    @property
    def decision(self) -> Decision | None:
        if self._step is None:
            return None
        looks = [detections for _, detections in self._recent]
        belief = self._step.belief
        target = class_meant(belief, self.target)
        return decision_without_closer_looks(
            self.outcome, belief, looks, self.grid, target, self._cell(self._step), self._confirm
        )

    def wait(self, passed: float = FRAME) -> None:
        self._now += passed


class ByPresence(_ByBelief):
    """Ends a search by the probability that the picture holds the target (`decide`)."""

    ending = "decision"

    def __init__(self, grid: Grid, target: int, thresholds: Thresholds, forgetting: Forgetting | None = None) -> None:
        super().__init__(grid, target, forgetting)
        self.thresholds = thresholds
        self._confirm = thresholds.confirm
        self.criterion = f"p is {thresholds.confirm:g} and the gaze was at the place"

    def _judge(self, step: Step) -> int:
        return int(decide(step, self.target, self.thresholds))


class AtDetection(_ByBelief):
    """Ends a search without thresholds at a fixated cell with a detection of the target (`detects`)."""

    ending = "detection"

    def __init__(self, grid: Grid, target: int, weights: Mapping[int, float], score: float) -> None:
        super().__init__(grid, target)
        self.weights = weights
        self.score = score

    def _judge(self, step: Step) -> int:
        return int(detects(step, grid=self.grid, weights=self.weights, score=self.score))

    def _cell(self, step: Step) -> int | None:
        return int(step.cell)


class ByCloserLooks(StoppingCriterion):
    """Ends a search by closer looks at the places that seem to hold the target (`Verifier`)."""

    ending = "decision"

    def __init__(self, verifier: Verifier[Step]) -> None:
        self.verifier = verifier
        self.criterion = verifier.criterion
        self._has_looked = False
        self._has_ended = False

    def see(self, step: Step) -> None:
        self._has_looked = True
        self.verifier.see(step)
        self._judge()

    def examine(self, detections: Detections) -> CloseUp:
        look = self.verifier.examine(detections)
        self._judge()
        return look

    def _judge(self) -> None:
        """Decide whether the search goes on, unless a closer look is due first, or it has ended."""
        if self.candidate is None and not self._has_ended:
            self.outcome = self.verifier.outcome()

    @property
    def candidate(self) -> CandidatePlace | None:
        return self.verifier.candidate

    @property
    def looks(self) -> list[CloseUp]:
        return self.verifier.looks

    @property
    def decision(self) -> Decision | None:
        if not self._has_looked:
            return None
        return self.verifier.final_decision() if self._has_ended else self.verifier.decision()

    def end_search(self) -> None:
        self.outcome = self.verifier.outcome()
        self._has_ended = True
        self.verifier.end()

    def found_class(self, belief: Belief, target: int) -> int:
        decision = self.decision
        is_found = decision is not None and decision.outcome == "found"
        return self.verifier.best.target if is_found else class_meant(belief, target)

    def wait(self, passed: float = FRAME) -> None:
        self.verifier.wait(passed)
