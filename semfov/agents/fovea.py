"""Looks of a fovea at a photograph or at the frames of a stream: a gaze that moves over a grid of cells."""

import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.agents.episode import Episode, EpisodeLimits, on_cpu
from semfov.belief import Grid, Verification
from semfov.belief.observers import LearnedMap
from semfov.belief.observers.any_of import TargetLike, class_meant
from semfov.belief.prior import Prior
from semfov.data.inputs import Color, ImageLike, as_image, as_pixels
from semfov.decision import (
    MOST_CLOSER,
    OUTCOMES,
    CandidateCells,
    CloseUp,
    Decision,
    Verifier,
    conclude,
    decide,
    detects,
    gains_less,
)
from semfov.detection.detections import Detections
from semfov.episode import LiveLooks, Step, rollout
from semfov.episode.stopwatch import Stopwatch
from semfov.errors import InputError, check, check_finite, check_shape, check_whole
from semfov.eye import Eye
from semfov.gaze.acquisition import ExpectedGain
from semfov.gaze.choice import Choice, Given, Greedy, drawn_by
from semfov.gaze.viewer import Viewer
from semfov.paths import Ending, FoveaMoment, GazePrediction, RecordedLook, Scanpath
from semfov.paths.scanpath import Trace
from semfov.paths.stimulus import Stimulus, in_bytes, reduced_copy
from semfov.strategy import Strategy

_WORTH = 0.1  # default for the least gain of a look by a learned map, in cells that are classified correctly
_LONGEST = 640  # longer side of the frames that records keep, in pixels
_MOST_RECENT = 1000  # largest number of looks whose detections are kept in a stream
Start = int | tuple[int, int] | None  # first cell of an episode: its number, its column and row, or None to draw one


@dataclass(frozen=True)
class FoveaAgent:
    """The parts of an agent that moves its gaze over a photograph `(1, 3, H, W)`; cells `(columns, rows)`."""

    eye: Eye
    searching: Strategy
    exploring: Strategy
    verification: Verification | None
    cells: tuple[int, int]

    def search(
        self,
        image: Tensor,
        target: TargetLike,
        limits: EpisodeLimits,
        *,
        shifts: int | None = None,
        boxes: Tensor | Sequence[Sequence[float]] | None = None,
        confirm: float | None = None,
        closer: int = 0,
        **settings: Any,
    ) -> Scanpath:
        """Search a photograph for a target, and decide whether it is there (`ActivePerception.search`)."""
        strategy, index, weights = self.searching.sought(target, ("background", *self.eye.detector.classes))
        settings |= {"shifts": _shifts(shifts, 30, limits), "closer": closer if boxes is None else 0}
        episode = FoveaEpisode(self, index, strategy=strategy, limits=limits, confirm=confirm, **settings)
        grid = episode.open(image)
        if boxes is not None:
            goal, episode.to_goal = _goal_cells(boxes, grid, image).long(), True
            episode.ends = lambda step: goal[step.cell]
        elif episode.thresholds is not None:
            episode.ends = partial(decide, target=index, thresholds=episode.thresholds)
        else:
            episode.ends = partial(detects, grid=grid, weights=weights, score=0.5 if confirm is None else confirm)
        return episode.run()

    def explore(
        self,
        image: Tensor,
        limits: EpisodeLimits,
        *,
        shifts: int | None = None,
        worth: float | None = None,
        policy: str | None = None,
        **settings: Any,
    ) -> Scanpath:
        """Explore a photograph, without a target (`ActivePerception.explore`)."""
        observer = on_cpu(self.exploring.observer)
        if worth and not isinstance(observer, LearnedMap):
            raise InputError(
                f"worth: expected None for an agent without a learned map, got {worth}; use the recommended agent"
            )
        check(policy in (None, "people"), "policy", "'people', or None", policy)
        viewed = None if policy is None else GazePrediction.of(self.eye.detector, image[0])
        episode = FoveaEpisode(self, limits=limits, shifts=_shifts(shifts, 20, limits), viewed=viewed, **settings)
        grid = episode.open(image)
        if isinstance(observer, LearnedMap) and (policy is None or worth is not None):
            least = _WORTH if worth is None else worth
            episode.ends = partial(gains_less, gain=ExpectedGain(observer.model, grid), least=least)
        return episode.run()

    def find_all(
        self, image: Tensor, targets: tuple[int, ...], limits: EpisodeLimits, *, shifts: int | None = None
    ) -> Scanpath:
        """Look for all objects of classes 1..K; none stand for all classes (`ActivePerception.find_all`)."""
        one = targets[0] if len(targets) == 1 else None
        episode = FoveaEpisode(self, one, limits=limits, shifts=_shifts(shifts, 20, limits), closer=0)
        episode.open(image)
        return replace(episode.run(), target=None, targets=targets)


class FoveaEpisode(Episode[Scanpath]):
    r"""Looks of a fovea, with one gaze shift or one closer look for each pass of the detector.

    With a model of verification the target is found by closer looks alone (`semfov.decision.Verifier`). In a stream the
    gaze continues from its last position, and after t seconds :math:`e^{-rt}` of the evidence is left,
    with the rate r (`semfov.episode.Forgetting`). With rate 0, frames of a still picture give the looks and the
    decision of a search of the picture up to its end. `ends` tells the outcome of a step (`semfov.decision.OUTCOMES`),
    0 to go on; a search `to_goal` ends on given cells, without a decision.
    """

    def __init__(
        self,
        agent: FoveaAgent,
        target: int | None = None,
        *,
        strategy: Strategy | None = None,
        limits: EpisodeLimits | None = None,
        rate: float | None = None,
        start: Start = None,
        shifts: int | None = None,
        seed: int = 0,
        confirm: float | None = None,
        give_up: float | None = None,
        closer: int = MOST_CLOSER,
        prior: float | None = None,
        color: Color = "rgb",
        viewed: GazePrediction | None = None,
        cells: Sequence[int] | None = None,
    ) -> None:
        super().__init__(("background", *agent.eye.detector.classes), target, (), limits, rate)
        usual = agent.exploring if target is None else agent.searching
        self.agent, self.eye, self.color, self.viewed = agent, agent.eye, color, viewed
        chosen, mapper = usual if strategy is None else strategy, agent.exploring.observer
        self._prior = Prior()
        if prior is not None:
            check(target is not None, "prior", "None without a target", prior)
            assert target is not None
            chosen, self._prior = chosen.with_prior(prior, target)
        # The belief of one episode is on the CPU, wherever the eye is.
        self.strategy = on_cpu(chosen)
        self._beside = None if mapper is chosen.observer else on_cpu(mapper)
        model = None if target is None or not closer else agent.verification
        model = None if model is None or model.thresholds is None else model
        self.verification, self.closer = None if model is None else on_cpu(model), closer
        own = self.strategy.observer.thresholds
        usually = own if self.verification is None else self.verification.thresholds
        fading = own.give_up if rate and own is not None else None
        self.thresholds = None if usually is None else usually.changed(give_up=fading).changed(confirm, give_up)
        if self.thresholds is not None:
            self.criterion = f"p is {self.thresholds.confirm:g} and the gaze was at the place"
        self.ends: Callable[[Step], Tensor] | None = None
        self.to_goal = False
        columns, rows = agent.cells
        if cells is not None:
            check(len(cells) > 0, "cells", "one cell at least", "none")
            for cell in cells:
                check_whole(cell, "cells", 0, columns * rows - 1)
            start, shifts = cells[0], len(cells) - 1
        self._cells = None if cells is None else torch.tensor([[*cells]])
        self._most = sys.maxsize if shifts is None else shifts + 1
        check_whole(seed, "seed", 0, 2**63 - 1)
        self._generator, first = torch.Generator().manual_seed(int(seed)), cell_at(start, agent.cells)
        if first is None:
            first = int(torch.randint(columns * rows, (1,), generator=self._generator))
        check_whole(first, "start", 0, columns * rows - 1)
        self._start = int(first)
        self._looks: LiveLooks | None = None
        self._verifier: Verifier[Step] | None = None
        self._outcome, self._faded, self._now = 0, 0.0, 0.0
        self._concluded: Decision | None = None

    def open(self, image: Tensor) -> Grid:
        """Begin with a picture, or with the first frame of a stream."""
        self._image, grid = image, Grid(*self.agent.cells, (image.shape[-1], image.shape[-2]))
        self._looks = LiveLooks(self.eye, self.eye.open(image), grid, self.target, device=torch.device("cpu"))
        first, viewed = torch.tensor([self._start]), self.viewed
        choice: Choice = Greedy(drawn_by(self._generator, len(grid), self._looks.like))
        if self._cells is not None:
            choice = Given(self._cells)
        elif viewed is not None:
            choice = Viewer(viewed.model, viewed.terms, grid, first, self._generator)
        self._steps: Iterator[Step] = rollout(
            self._looks,
            self.strategy.observer,
            self.strategy.policy(self.target, grid),
            first,
            choice,
            most=self._most,
            forgetting=self.forgetting,
        )
        if self.verification is not None and self.target is not None:
            places = CandidateCells(grid, self.target, self.forgetting, self._prior)
            self._verifier = Verifier(self.verification, places, self._close_up, self.thresholds, self.closer)
            self.criterion = self._verifier.criterion
        elif self.forgetting is not None and self.target is not None and self.thresholds is not None:
            self.ends = partial(decide, target=self.target, thresholds=self.thresholds)
        # A stream has no end, so it keeps the detections of the looks of which at least half the evidence is left.
        self._recent: deque[tuple[float, Detections]] = deque(maxlen=_MOST_RECENT if self.forgetting else None)
        self._last: tuple[Step, int] | None = None  # the last look of the fovea, and its number
        if self.forgetting is None:
            self._trace = Trace(grid, self.classes, self.target, self._beside, self.eye.detector.least)
            self._kept = {
                "stimulus": Stimulus.of(self.eye, image),
                "photograph": reduced_copy(image[0]),
                "detector": self.eye.detector.name,
            }
        return grid

    def look(self, frame: ImageLike | None = None) -> RecordedLook | None:
        """Look by the fovea, or closely at a place that seems to hold the target."""
        if frame is not None:
            with torch.inference_mode():
                return self._look_at(frame)
        return self._fixate({}) if self._candidate is None else self._look_closely(self._candidate)

    def _look_at(self, frame: ImageLike) -> RecordedLook | None:
        """Spend a frame of a stream on a look."""
        check(self.pose is None, "pose", "None for a fovea, or how='windows', whose looks follow the camera", self.pose)
        self._pixels = as_pixels(frame, argument="frame", color=self.color)
        if isinstance(frame, Tensor):  # of all others this is a copy
            self._pixels = self._pixels.clone()
        image = as_image(self._pixels, like=self.eye.sensor.like, argument="frame")[None]
        self._check_size((image.shape[-1], image.shape[-2]))
        self._faded += self.passed
        self._now += self.passed
        if self._verifier is not None:
            self._verifier.wait(self.passed)
        if self._candidate is not None:
            self._image = image
            return self._look_closely(self._candidate)
        watch = Stopwatch()
        if self._looks is None:
            self.open(image)
        else:
            self._image, self._looks.view = image, self.eye.open(image)
            self._looks.passed = self._faded
        self._faded = 0.0
        watch.lap("open")
        return self._fixate(watch.seconds)

    def _fixate(self, opened: dict[str, float]) -> RecordedLook | None:
        step = next(self._steps, None)
        if step is None:
            return None
        self._last = step, self.passes
        self._recent.append((self._now, step.detections))
        while self.forgetting is not None and self._now - self._recent[0][0] >= self.forgetting.span:
            self._recent.popleft()
        self.passes += 1
        if self.forgetting is None:
            self._trace.steps.append(step)
        if self._verifier is not None:
            self._verifier.see(step)
        elif self.ends is not None:
            self._outcome = int(self.ends(step))
        return self._looked(int(step.cell), step.detections, {**opened, **step.seconds}, None)

    def _look_closely(self, cell: int) -> RecordedLook:
        assert self._verifier is not None
        watch = Stopwatch()
        closer = self._verifier.look()
        watch.lap("detect")
        return self._looked(cell, self._closely, watch.seconds, closer)

    def _close_up(self, box: Tensor) -> Detections:
        self.passes += 1
        self._closely = self.eye.close_up(self._image, box)
        return self._closely

    def _looked(
        self, cell: int, detections: Detections, seconds: dict[str, float], closer: CloseUp | None
    ) -> RecordedLook:
        """Keep what the moment tells of the look, and end the episode where it decides."""
        self._present = cell, detections, seconds, closer
        if self._verifier is not None and self._candidate is None:
            self._outcome = self._verifier.outcome()
        if self.forgetting is None and self._outcome and self._candidate is None:
            self.ending = self._decided()
        assert self._looks is not None
        x, y = self._looks.grid.centres[cell].tolist()
        size = self._image.shape[-1], self._image.shape[-2]
        return RecordedLook(
            self.passes - 1, (x, y), (0.0, 0.0, float(size[0]), float(size[1])), detections, sum(seconds.values())
        )

    def _decided(self) -> Ending:
        """The reason for an end by the outcome of a look."""
        if self.to_goal:
            return "box"
        if self.target is None:
            return "worth"
        return "detection" if self.thresholds is None else "decision"

    def _end(self, limit: Ending | None) -> None:
        step = self._last[0] if self._last is not None else None
        assert step is not None
        room = self.limits.room(self.passes) if limit in (None, "passes") else 0
        if self._verifier is not None:
            self._outcome = self._verifier.outcome()
            self._concluded = self._verifier.conclude(room)
        usual: Ending = "cells" if bool(step.visited.all()) else "shifts"
        self.ending = self._decided() if self._outcome else limit or usual

    @property
    def decision(self) -> Decision | None:
        """The decision as it stands; None in an exploration, and in a search that ends on given cells."""
        if self._verifier is not None:
            return self._concluded or self._verifier.decision()
        if self.target is None or self.ends is None or self.to_goal or self._last is None or self._looks is None:
            return None
        step, seen = self._last[0], tuple(detections for _, detections in self._recent)
        # Without thresholds the target was found in the fixated cell.
        cell = None if self.thresholds is not None else int(step.cell)
        meant = class_meant(step.belief, self.target)
        return conclude(self._outcome, step.belief, seen, self._looks.grid, meant, cell)

    def record(self) -> Scanpath:
        decision = self.decision
        if self.target is None or self._last is None:
            return self._trace.scanpath(ending=self.ending, **self._kept)
        outcome = OUTCOMES[self._outcome] if decision is None else decision.outcome
        target = class_meant(self._last[0].belief, self.target)
        if self._verifier is not None and outcome == "found":
            target = self._verifier.best.target
        return self._trace.scanpath(
            ending=self.ending,
            **self._kept,
            target=target,
            found=outcome == "found",
            decision=decision,
            closer=() if self._verifier is None else tuple(self._verifier.looks),
        )

    def moment(self) -> FoveaMoment:
        assert self._last is not None
        assert self._looks is not None
        (step, _), grid, belief = self._last, self._looks.grid, self._last[0].belief
        (cell, detections, seconds, closer), decision = self._present, self.decision
        if self.target is None:
            probability = 1 - belief.class_probabilities()[0, :, 0]
        else:
            probability = belief.probability(self.target)[0]
        # Reduced by a whole number: resampling a large frame takes as long as a look.
        side = -(-max(self._image.shape[-2:]) // _LONGEST)
        if side == 1 and self._pixels.dtype == torch.uint8:
            photograph = self._pixels[0].cpu()
        else:
            small = F.avg_pool2d(self._image, side, ceil_mode=True, count_include_pad=False)
            photograph = in_bytes(small[0])
        return FoveaMoment(
            classes=self.classes,
            target=self.target,
            decision=decision,
            number=self.passes - 1,
            grid=grid,
            cell=cell,
            fixation=grid.centres[cell].to(step.fixation),
            detections=(detections,),
            probability=probability,
            belief=belief,
            visited=step.visited[0],
            next_cell=int(step.next_cell) if self._candidate is None else self._candidate,
            seconds=(seconds,),
            closer=() if closer is None else (replace(closer, fixation=0, number=0),),
            found=decision is not None and decision.outcome == "found",
            photograph=photograph,
            detector=self.eye.detector.name,
        )

    @property
    def _candidate(self) -> int | None:
        """Cell of the place that the next look is spent on; None for a look of the fovea."""
        place = None if self._verifier is None else self._verifier.candidate
        return None if place is None else place.cell


def _shifts(shifts: int | None, usual: int, limits: EpisodeLimits) -> int:
    """The largest number of gaze shifts: as given, else the usual one, or with a limit of passes none."""
    most = 10_000
    if shifts is None:
        shifts = usual if limits.passes is None else most
    check_whole(shifts, "shifts", 0, most)
    return shifts


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


def _goal_cells(boxes: Tensor | Sequence[Sequence[float]], grid: Grid, like: Tensor) -> Tensor:
    """Cells that boxes overlap; by the protocol of the paper a search ends when it fixates one of them.

    Shapes: boxes `(M, 4)` → `(X·Y,)`.
    """
    tensor = torch.as_tensor(boxes).to(like)
    check_shape(tensor, "boxes", None, 4)
    check(tensor.ndim == 2, "boxes", "shape (M, 4)", tuple(tensor.shape))
    check_finite(tensor, "boxes")
    got = "others; convert (x, y, width, height) to (x, y, x + width, y + height)"
    full = bool((tensor[:, 2:] > tensor[:, :2]).all())
    check(full, "boxes", "(x1, y1, x2, y2) with x1 < x2 and y1 < y2", got)
    return grid.footprint(tensor).any(-2)
