"""Active perception of a camera or a video: a look at every frame, and a belief that goes on from one to the next."""

import sys
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.observers import Observer
from semfov.belief.target_evidence import Thresholds
from semfov.data.inputs import ImageLike, as_image
from semfov.decision import Decision, conclude, decide
from semfov.detection.detections import Detections
from semfov.episode import Forgetting, LiveLooks, Step, Stopwatch, rollout
from semfov.errors import check
from semfov.eye import Eye, View
from semfov.gaze.choice import Greedy, drawn_by, first_cell
from semfov.gaze.policies import Policy

RATE = 0.1
"""Rate at which belief fades from frame to frame, unless another is asked for."""

_MOST = 1000  # looks that are kept where nothing is forgotten


@dataclass(frozen=True)
class Moment:
    """What is seen and believed at one frame.

    Attributes:
        number: of the frame, from 0.
        grid: the cells.
        target: class that is searched for; None for exploration.
        cell: that is fixated.
        fixation: `(2,)`, its centre `(x, y)`.
        detections: what is seen from there, a batch of one.
        belief: after the look, of one episode.
        decision: what a search makes of the frame: `found`, `absent` or, as long as it is neither, `undecided`; None
            for exploration, and where the belief is none to decide by.
        visited: `(X·Y,)` boolean, cells that the gaze is kept from.
        next_cell: that the gaze goes to for the next frame.
        seconds: that the look took, by stage; `open` is fitting the frame into the detector's input.
    """

    number: int
    grid: Grid
    target: int | None
    cell: int
    fixation: Tensor
    detections: Detections
    belief: Belief
    decision: Decision | None
    visited: Tensor
    next_cell: int
    seconds: dict[str, float]

    @property
    def probability(self) -> Tensor:
        """Probability of the target in each cell, `(X·Y,)`; in an exploration, that the cell holds any object."""
        if self.target is None:
            return 1 - self.belief.class_probabilities()[0, :, 0]
        return self.belief.probability(self.target)[0]


class LivePerception:
    r"""Looks at the frames of a stream, one gaze shift a frame, and keeps its belief from frame to frame.

    The gaze goes on from where it was. What earlier frames showed is discounted by :math:`e^{-r}` a frame, r the rate,
    so that the map returns to what is known without looking, and follows a scene that moves; cells that were fixated
    are free again after :math:`\ln 2 / r` frames (`semfov.episode.Forgetting`, `Observer.fade`). With rate 0 the frames
    of a still picture give the belief of a search of it.

    Args:
        eye: sensor and detector.
        observer: turns looks into belief.
        policy: chooses where to look by it.
        classes: names, background first.
        cells: `(columns, rows)` of the belief.
        target: class 1..K to search for; None explores.
        rate: r, per frame.
        start: first cell; None draws one.
        seed: of the generator that draws the start and breaks ties.
        thresholds: at which a search decides; None takes those of the observer.

    Example::

        live = ActivePerception.recommended().live("cup")
        for frame in frames:
            moment = live.step(frame)
            print(moment.decision.outcome, moment.fixation)
    """

    def __init__(
        self,
        eye: Eye,
        observer: Observer,
        policy: Policy,
        classes: tuple[str, ...],
        cells: tuple[int, int],
        *,
        target: int | None = None,
        rate: float = RATE,
        start: int | None = None,
        seed: int = 0,
        thresholds: Thresholds | None = None,
    ) -> None:
        self.eye, self.observer, self.policy = eye, observer, policy
        self.classes, self.cells, self.target = classes, cells, target
        self.forgetting = Forgetting(rate)
        self.thresholds = observer.thresholds if thresholds is None else thresholds
        self._first = first_cell(start, seed, cells[0] * cells[1])
        self._looks: LiveLooks | None = None
        self._steps: Iterator[Step] = iter(())
        # What was seen while half of it is left.
        self._recent: deque[Detections] = deque(maxlen=max(1, int(min(self.forgetting.span, _MOST))))

    def step(self, frame: ImageLike) -> Moment:
        """Look at the next frame.

        Args:
            frame: a picture of any common kind (`semfov.as_image`), of the same size as the first.

        Raises:
            InputError: it is no picture, or of another size.
        """
        with torch.inference_mode():
            image = as_image(frame, like=self.eye.sensor.like, argument="frame")[None]
            watch = Stopwatch()
            view = self.eye.open(image)
            watch.lap("open")
            if self._looks is None:
                self._looks = self._begin(image, view)
            grid = self._looks.grid
            wanted = " × ".join(f"{side:.0f}" for side in grid.extent.tolist())
            size = f"{image.shape[-1]} × {image.shape[-2]}"
            check(size == wanted, "frame", f"{wanted} pixels as the first", size)
            self._looks.view = view
            step = next(self._steps)
            self._recent.append(step.detections)
            return self._moment(step, grid, watch.seconds)

    def _begin(self, image: Tensor, view: View) -> LiveLooks:
        """Start the episode at the first frame."""
        grid = Grid(*self.cells, (image.shape[-1], image.shape[-2]))
        start, generator = self._first
        looks = LiveLooks(self.eye, view, grid, self.target)
        self._steps = rollout(
            looks,
            self.observer,
            self.policy(self.target, grid),
            torch.tensor([start], device=image.device),
            Greedy(drawn_by(generator, len(grid), image)),
            most=sys.maxsize,
            forgetting=self.forgetting,
        )
        return looks

    def _moment(self, step: Step, grid: Grid, seconds: dict[str, float]) -> Moment:
        decision = None
        if self.target is not None and self.thresholds is not None:
            outcome = int(decide(step, self.target, self.thresholds))
            decision = conclude(outcome, step.belief, tuple(self._recent), grid, self.target)
        return Moment(
            step.shift,
            grid,
            self.target,
            int(step.cell),
            step.fixation[0],
            step.detections,
            step.belief,
            decision,
            step.visited[0],
            int(step.next_cell),
            {**seconds, **step.seconds},
        )
