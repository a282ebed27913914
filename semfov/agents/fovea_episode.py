"""Episodes of a fovea: a gaze that moves over the cells of a photograph, or of the frames of a stream.

`GazePlan` says how a gaze moves and what ends it, before there is a picture. `FoveaGaze` is that gaze at a picture:
the loop of fixations, and the stopping criterion. Two short drivers stand on it: `FoveaEpisode` keeps a trace of all
looks at a photograph, whose record is a `Scanpath`; `FoveaStream` has the look at the present frame, a `FoveaMoment`.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn import functional as F

from semfov.agents.episode import EpisodeLimits, Goal, PictureEpisode, StreamEpisode, on_cpu
from semfov.belief import Belief, Grid, Verification
from semfov.belief.prior import Prior, PriorLike
from semfov.data.inputs import Color, ImageLike, as_image, as_pixels
from semfov.decision import MOST_CLOSER, OUTCOMES, CandidateCells, CloseUp, Decision, Verifier
from semfov.decision.stopping import ByCloserLooks, ByPresence, StoppingCriterion
from semfov.detection.detections import Detections
from semfov.episode import Forgetting, LiveLooks, Step, rollout
from semfov.episode.stopwatch import Stopwatch
from semfov.errors import check, check_whole
from semfov.eye import Eye
from semfov.gaze.choice import Choice, Given, Greedy, drawn_by
from semfov.gaze.viewer import Viewer
from semfov.motion import Motion
from semfov.observation.thresholds import Thresholds
from semfov.paths import Ending, FoveaMoment, GazePrediction, Scanpath
from semfov.paths.fovea import FoveaLook, moment_look
from semfov.paths.stimulus import Stimulus, in_bytes, reduced_copy
from semfov.paths.trace import Trace
from semfov.sensor.glimpse import window_around
from semfov.settings import DecisionSettings, Start, value_or
from semfov.strategy import Strategy

_LONGEST = 640  # longer side of the frames that records keep, in pixels


@dataclass(frozen=True)
class GazeParts:
    """The parts of an agent that moves its gaze over a photograph.

    Attributes:
        eye: sensor and detector.
        searching: observer and policy for a search.
        exploring: observer and policy for an exploration.
        verification: model of closer looks; None for none.
        cells: number of columns and of rows of the belief.
    """

    eye: Eye
    searching: Strategy
    exploring: Strategy
    verification: Verification | None
    cells: tuple[int, int]


class GazePlan:
    """Rules for choosing fixations and for ending an episode, for any picture. All models are on the CPU.

    Args:
        agent: the eye, the strategies and the verification.
        target: class 1..K that is searched for; None explores.
        strategy: observer and policy; None takes those of the agent.
        start: first cell; None draws one.
        shifts: largest number of gaze shifts; None for no limit.
        seed: seed of the generator that draws the start and breaks ties.
        decisions: thresholds, number of closer looks, and prior; None takes the usual ones.
        rate: rate at which evidence fades in a stream, per second; None for a picture.
        viewed: prediction of where people look, which the gaze then follows; None follows the policy.
        cells: cells that are looked at one after the other; None follows the policy.

    Attributes:
        thresholds: thresholds of the decision; None if nothing was learned.
        verification: model of the closer looks; None if none are made.
        given_share: share of the pictures that hold the target, as it was given; None for none.
        prior: the share that the probabilities assume, and that of the fit.
        beside: observer of the map of all classes beside the belief of a search; None if the belief is that map.
    """

    def __init__(
        self,
        agent: GazeParts,
        target: int | None = None,
        *,
        strategy: Strategy | None = None,
        start: Start = None,
        shifts: int | None = None,
        seed: int = 0,
        decisions: DecisionSettings | None = None,
        rate: float | None = None,
        viewed: GazePrediction | None = None,
        cells: Sequence[int] | None = None,
    ) -> None:
        decisions = decisions or DecisionSettings()
        usual = agent.exploring if target is None else agent.searching
        self.given_share = decisions.given_share
        chosen, self.prior = _with_prior(strategy or usual, target, decisions.prior)
        self.agent = agent
        self.target = target
        self.strategy = on_cpu(chosen)
        mapper = agent.exploring.observer
        self.beside = None if mapper is chosen.observer else on_cpu(mapper)
        self.forgetting = None if rate is None else Forgetting(rate)
        self.most_closer = value_or(decisions.closer, MOST_CLOSER)
        # The thresholds are those of the verification where there is one.
        self.verification = self._fitted_verification()
        self.thresholds = self._thresholds(decisions)
        self._viewed = viewed
        self._cells: Tensor | None = None
        if cells is not None:
            self._cells = _checked_cells(cells, agent.cells)
            start = cells[0]
            shifts = len(cells) - 1
        self.most = sys.maxsize if shifts is None else shifts + 1
        check_whole(seed, "seed", 0, 2**63 - 1)
        # The draw of the start comes first; later ones break ties.
        self._generator = torch.Generator().manual_seed(int(seed))
        self.start = _first_cell(start, agent.cells, self._generator)

    def _fitted_verification(self) -> Verification | None:
        """Take the model of closer looks to the CPU; None where none are made, and where it was not fitted."""
        model = self.agent.verification
        if self.target is None or self.most_closer == 0 or model is None or model.thresholds is None:
            return None
        return on_cpu(model)

    def _thresholds(self, decisions: DecisionSettings) -> Thresholds | None:
        """Choose the thresholds: those of the settings before fitted ones; None if nothing was learned."""
        of_belief = self.strategy.observer.thresholds
        fitted = of_belief if self.verification is None else self.verification.thresholds
        if fitted is None:
            return None
        if self.forgetting is not None and self.forgetting.rate and of_belief is not None:
            # A belief that fades stays less certain than in a search, and would give up at once.
            fitted = fitted.changed(stop_below=of_belief.stop_below)
        return fitted.changed(decisions.confirm, decisions.stop_below)

    @property
    def goal(self) -> Goal:
        """What is looked for."""
        return Goal.of(("background", *self.agent.eye.detector.classes), self.target)

    def grid(self, image: Tensor) -> Grid:
        """Lay the cells over an image `(1, 3, H, W)`."""
        return Grid(*self.agent.cells, (image.shape[-1], image.shape[-2]))

    def choice(self, grid: Grid, like: Tensor) -> Choice:
        """Make the rule that chooses the next cell: given cells, cells as people choose them, or the best cell."""
        if self._cells is not None:
            return Given(self._cells)
        if self._viewed is not None:
            first = torch.tensor([self.start])
            return Viewer(self._viewed.model, self._viewed.terms, grid, first, self._generator)
        return Greedy(drawn_by(self._generator, len(grid), like))

    def criterion(self, grid: Grid) -> StoppingCriterion:
        """Make the default stopping criterion: by closer looks if a model of them was fitted, else by the presence."""
        if self.target is None or self.thresholds is None:
            return StoppingCriterion()
        if self.verification is not None:
            places = CandidateCells(grid, self.target, self.forgetting, self.prior)
            return ByCloserLooks(Verifier(self.verification, places, self.thresholds, self.most_closer))
        return ByPresence(grid, self.target, self.thresholds, self.forgetting)


class _CloserLook(NamedTuple):
    """A closer look at a place that seems to hold the target.

    Attributes:
        cell: cell of the place.
        region: `[x1, y1, x2, y2]` in pixels, the enlarged window.
        detections: what it shows, a batch of one.
        seconds: seconds by stage.
        value: probability that the target is at the place, before the look.
        verdict: what the look says of the target.
    """

    cell: int
    region: list[float]
    detections: Detections
    seconds: dict[str, float]
    value: float
    verdict: CloseUp


class FoveaGaze:
    """The gaze of one episode at a picture, or at the present frame of a stream.

    Args:
        plan: how it moves.
        image: `(1, 3, H, W)`, the picture or the first frame.
        criterion: makes another stopping criterion than the plan's from the cells; None takes that of the plan.

    Attributes:
        image: the picture, or the present frame.
        grid: the cells.
        criterion: what ends it.
        step: the last fixation; None before the first one.
    """

    def __init__(
        self,
        plan: GazePlan,
        image: Tensor,
        criterion: Callable[[Grid], StoppingCriterion] | None = None,
    ) -> None:
        eye = plan.agent.eye
        self._eye = eye
        self.image = image
        self.grid = plan.grid(image)
        self.criterion = plan.criterion(self.grid) if criterion is None else criterion(self.grid)
        self.step: Step | None = None
        # The belief of one episode is on the CPU, wherever the eye is.
        self._source = LiveLooks(eye, eye.open(image), self.grid, plan.target, device=torch.device("cpu"))
        self._steps: Iterator[Step] = rollout(
            self._source,
            plan.strategy.observer,
            plan.strategy.policy(plan.target, self.grid),
            torch.tensor([plan.start]),
            plan.choice(self.grid, self._source.like),
            most=plan.most,
            forgetting=plan.forgetting,
        )

    def show(self, image: Tensor, passed: float) -> None:
        """Set the frame `(1, 3, H, W)` for the next fixation, and the seconds since the last fixation."""
        self.image = image
        self._source.view = self._eye.open(image)
        self._source.passed = passed

    def fixate(self) -> Step | None:
        """Take a look at the next cell; returns None if no cell is left."""
        step = next(self._steps, None)
        if step is not None:
            self.step = step
            self.criterion.see(step)
        return step

    def look_closely(self) -> _CloserLook:
        """Take a closer look at the place that the stopping criterion wants to check; there must be one."""
        candidate = self.criterion.candidate
        assert candidate is not None
        assert candidate.cell is not None
        watch = Stopwatch()
        detections = self._eye.close_up(self.image, candidate.box)
        watch.lap("detect")
        size = self.image.shape[-1], self.image.shape[-2]
        region = window_around(candidate.box.to(self._eye.sensor.like.dtype), size).tolist()
        verdict = self.criterion.examine(detections)
        return _CloserLook(candidate.cell, region, detections, watch.seconds, candidate.probability, verdict)


class FoveaEpisode(PictureEpisode[Scanpath]):
    """Looks of a fovea at a photograph, with one gaze shift or one closer look for each pass of the detector.

    With a model of verification the target is found by closer looks alone (`semfov.decision.Verifier`).

    Args:
        plan: how the gaze moves.
        image: the photograph, `(1, 3, H, W)`, floats or bytes.
        limits: where the episode ends, unless it decides before.
        criterion: makes another stopping criterion than the plan's from the cells; None takes that of the plan.
    """

    def __init__(
        self,
        plan: GazePlan,
        image: Tensor,
        limits: EpisodeLimits | None = None,
        criterion: Callable[[Grid], StoppingCriterion] | None = None,
    ) -> None:
        super().__init__(plan.goal, limits)
        eye = plan.agent.eye
        self._trace = Trace(plan.grid(image), self.goal.classes, plan.target, plan.beside, eye.detector.score_threshold)
        self._gaze = FoveaGaze(plan, image, criterion)
        self._plan = plan
        self._stimulus = Stimulus.of(eye, image)
        self._photograph = reduced_copy(image[0])
        self._detector = eye.detector.name

    @property
    def looks(self) -> tuple[FoveaLook, ...]:
        return self._trace.looks

    @property
    def criterion(self) -> str | None:
        return self._gaze.criterion.criterion

    @property
    def decision(self) -> Decision | None:
        return self._gaze.criterion.decision

    def look(self) -> FoveaLook | None:
        """Fixate the next cell, or take a closer look at a place that seems to hold the target."""
        criterion = self._gaze.criterion
        if criterion.candidate is not None:
            self._look_closely()
        elif not self._fixate():
            return None
        if criterion.outcome and criterion.candidate is None:
            self.ending = criterion.ending
        return self.looks[-1]

    def _fixate(self) -> bool:
        """Make the next fixation; returns whether one was left."""
        step = self._gaze.fixate()
        if step is not None:
            self._trace.add(step)
        return step is not None

    def _look_closely(self) -> None:
        """Look closely at the place that is due."""
        look = self._gaze.look_closely()
        self._trace.look_closely(look.cell, look.region, look.detections, look.seconds, look.value)

    def _end(self, limit: Ending | None) -> None:
        step = self._gaze.step
        assert step is not None
        criterion = self._gaze.criterion
        # Who stops an episode, or has no time left, does not wait for further looks.
        room = self.limits.room(self.passes) if limit in (None, "passes") else 0
        criterion.end_search()
        while criterion.candidate is not None and room > 0:
            self._look_closely()
            room -= 1
        usual: Ending = "cells" if bool(step.visited.all()) else "shifts"
        self.ending = criterion.ending if criterion.outcome else limit or usual

    def record(self) -> Scanpath:
        criterion = self._gaze.criterion
        decision = criterion.decision
        outcome = OUTCOMES[criterion.outcome] if decision is None else decision.outcome
        target = self.goal.target
        if target is not None and self._gaze.step is not None:
            target = criterion.found_class(self._gaze.step.belief, target)
        return self._trace.scanpath(
            target=target,
            found=target is not None and outcome == "found",
            decision=decision,
            closer=tuple(criterion.looks),
            ending=self.ending,
            prior=self._plan.given_share,
            assumed=self._plan.prior.assumed,
            stimulus=self._stimulus,
            photograph=self._photograph,
            detector=self._detector,
        )


class FoveaStream(StreamEpisode[FoveaMoment]):
    r"""Looks of a fovea at the frames of a stream, with one gaze shift or one closer look for each frame.

    The gaze continues from its last position, and after t seconds :math:`e^{-rt}` of the evidence is left, with the
    rate r (`semfov.episode.Forgetting`). With rate 0, frames of a still picture give the looks and the decision of a
    search of the picture up to its end. The fovea does not follow a camera that moves.

    Args:
        plan: how the gaze moves, with a rate.
        color: order of the channels of frames that are arrays or tensors.
    """

    def __init__(self, plan: GazePlan, color: Color = "rgb") -> None:
        assert plan.forgetting is not None
        super().__init__(plan.goal, plan.forgetting.rate)
        self.plan = plan
        self.color = color
        self._gaze: FoveaGaze | None = None  # from the first frame on
        self._pixels = torch.zeros(0)  # of the present frame, as they came
        self._since_fixation = 0.0  # seconds

    @property
    def looks(self) -> tuple[FoveaLook, ...]:
        """The look at the present frame."""
        return () if self._moment is None else self._moment.looks

    @property
    def criterion(self) -> str | None:
        """What a search needs for the decision `found`, in words, after the first frame."""
        return None if self._gaze is None else self._gaze.criterion.criterion

    def _look_at(self, frame: ImageLike, passed: float, pose: Motion | ArrayLike | None) -> None:
        check(pose is None, "pose", "None for a fovea, or how='windows', whose looks follow the camera", pose)
        image = self._opened(frame)
        self._since_fixation += passed
        if self._gaze is not None:
            self._gaze.criterion.wait(passed)
            if self._gaze.criterion.candidate is not None:
                self._look_closely(self._gaze, image)
                return
        self._fixate(image)

    def _opened(self, frame: ImageLike) -> Tensor:
        """Keep the pixels of a frame; returns its image `(1, 3, H, W)`."""
        self._pixels = as_pixels(frame, argument="frame", color=self.color)
        if isinstance(frame, Tensor):  # of all others this is a copy
            self._pixels = self._pixels.clone()
        image = as_image(self._pixels, like=self.plan.agent.eye.sensor.like, argument="frame")[None]
        self._check_size((image.shape[-1], image.shape[-2]))
        return image

    def _look_closely(self, gaze: FoveaGaze, image: Tensor) -> None:
        """Spend a frame on a closer look; the belief stays, and fades for this time at the next fixation."""
        gaze.image = image
        look = gaze.look_closely()
        self._passes += 1
        self._keep(self._made(gaze, look.cell, look.detections, look.seconds, closer=(look.verdict,)))

    def _fixate(self, image: Tensor) -> None:
        """Spend a frame on a fixation."""
        watch = Stopwatch()
        if self._gaze is None:
            self._gaze = FoveaGaze(self.plan, image)
        else:
            self._gaze.show(image, self._since_fixation)
        self._since_fixation = 0.0
        watch.lap("open")
        step = self._gaze.fixate()
        assert step is not None
        self._passes += 1
        self._keep(self._made(self._gaze, int(step.cell), step.detections, {**watch.seconds, **step.seconds}))

    def _made(
        self,
        gaze: FoveaGaze,
        cell: int,
        detections: Detections,
        seconds: dict[str, float],
        closer: tuple[CloseUp, ...] = (),
    ) -> FoveaMoment:
        """Make the record of the present frame, after its look.

        Args:
            gaze: the gaze, whose belief is that after its last fixation.
            cell: the cell that the look was at.
            detections: what it shows, a batch of one.
            seconds: its time by stage.
            closer: the closer look that it was; empty for a fixation.
        """
        step = gaze.step
        assert step is not None
        belief = step.belief
        target = self.goal.target
        number = self.passes - 1
        probability = _probability(belief, target)
        look = moment_look(gaze.grid, number, cell, detections, probability, seconds)
        decision = gaze.criterion.decision
        candidate = gaze.criterion.candidate
        next_cell = None if candidate is None else candidate.cell
        return FoveaMoment(
            classes=self.goal.classes,
            target=target,
            decision=decision,
            number=number,
            grid=gaze.grid,
            looks=(look,),
            probability=probability,
            belief=belief,
            visited=step.visited[0],
            next_cell=int(step.next_cell) if next_cell is None else next_cell,
            # Of one look, which is that of the frame.
            closer=tuple(replace(close_up, fixation=0, index=0) for close_up in closer),
            found=decision is not None and decision.outcome == "found",
            prior=self.plan.given_share,
            assumed=self.plan.prior.assumed,
            photograph=partial(_reduced, self._pixels, gaze.image),  # type: ignore[arg-type]
            detector=self.plan.agent.eye.detector.name,
        )


def _with_prior(strategy: Strategy, target: int | None, prior: PriorLike) -> tuple[Strategy, Prior]:
    """Give a strategy the share of the searches whose target is there; without a target it stays as it is."""
    if target is None:
        check(prior is None, "prior", "None without a target", prior)
        return strategy, Prior(known=False)
    return strategy.with_prior(prior, target)


def _probability(belief: Belief, target: int | None) -> Tensor:
    """Probability `(X·Y,)` that each cell holds the target, or any object if there is none."""
    if target is None:
        return 1 - belief.class_probabilities()[0, :, 0]
    return belief.probability(target)[0]


def _reduced(pixels: Tensor, image: Tensor) -> Tensor:
    """Reduce a frame to what a moment keeps, `(3, h, w)` bytes.

    Args:
        pixels: `(1, 3, H, W)`, the frame as it came.
        image: the same in [0, 1].
    """
    # Reduced by a whole number: resampling a large frame takes as long as a look.
    factor = -(-max(image.shape[-2:]) // _LONGEST)
    if factor == 1 and pixels.dtype == torch.uint8:
        return pixels[0].cpu()
    small = F.avg_pool2d(image, factor, ceil_mode=True, count_include_pad=False)
    return in_bytes(small[0])


def _checked_cells(cells: Sequence[int], shape: tuple[int, int]) -> Tensor:
    """Check cells that are looked at one after the other, of `(columns, rows)`; returns them as `(1, 1, n)`."""
    columns, rows = shape
    check(len(cells) > 0, "cells", "one cell at least", "none")
    for cell in cells:
        check_whole(cell, "cells", 0, columns * rows - 1)
    return torch.tensor([[*cells]])


def _first_cell(start: Start, shape: tuple[int, int], generator: torch.Generator) -> int:
    """Choose the first cell of `(columns, rows)`: the given one, or one that is drawn."""
    columns, rows = shape
    cell = cell_at(start, shape)
    if cell is None:
        cell = int(torch.randint(columns * rows, (1,), generator=generator))
    check_whole(cell, "start", 0, columns * rows - 1)
    return int(cell)


def cell_at(start: Start, cells: tuple[int, int]) -> int | None:
    """Find the number of the cell at `(column, row)`; numbers and None stay as they are.

    Args:
        start: a cell by its number or its place, or None.
        cells: number of columns and of rows.

    >>> cell_at((3, 2), (10, 10)), cell_at(7, (10, 10))
    (23, 7)
    """
    if not isinstance(start, tuple | list):
        return start
    check(len(start) == 2, "start", "a cell, or its (column, row)", start)
    column, row = start
    columns, rows = cells
    check_whole(column, "start", 0, columns - 1)
    check_whole(row, "start", 0, rows - 1)
    return int(row) * columns + int(column)
