"""Active perception of a camera or a video: one look at every frame, and a belief that continues between frames."""

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
"""Default rate at which belief fades, per frame."""

_MOST = 1000  # largest number of looks whose detections are kept


@dataclass(frozen=True)
class Moment:
    """Look, belief and decision at one frame.

    Attributes:
        number: number of the frame, from 0.
        grid: the cells.
        target: class 1..K that is searched for; None for exploration.
        cell: the fixated cell.
        fixation: `(2,)`, the centre of the cell as `(x, y)` in pixels.
        detections: detections of the look, a batch of one.
        belief: belief of one episode after the look.
        decision: decision at this frame: `found`, `absent`, or `undecided` as long as it is neither; None for
            exploration and for a belief without thresholds.
        visited: `(X·Y,)` boolean, cells that inhibition of return keeps the gaze from.
        next_cell: the cell to fixate in the next frame.
        seconds: time of the look by stage; `open` is the fitting of the frame into the detector's input.

    Example::

        moment = live.step(frame)
        print(moment.decision.outcome, moment.probability.max())
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
        """Probability that each cell holds the target, or any object in an exploration, `(X·Y,)`."""
        if self.target is None:
            return 1 - self.belief.class_probabilities()[0, :, 0]
        return self.belief.probability(self.target)[0]


class LivePerception:
    r"""Looks at the frames of a stream, with one gaze shift per frame, and keeps its belief between frames.

    The gaze continues from its last position. Each frame multiplies the evidence of earlier frames by :math:`e^{-r}`,
    with the rate r. Without new evidence the map thus returns to the prior, and it can follow a scene that moves.
    Fixated cells are free again after :math:`\ln 2 / r` frames (`semfov.episode.Forgetting`, `Observer.fade`). With
    rate 0, frames of a still picture give the same belief as a search of the picture.

    Args:
        eye: sensor and detector.
        observer: turns looks into a belief.
        policy: chooses the next fixation from the belief.
        classes: names of the classes, background first.
        cells: `(columns, rows)` of the belief.
        target: class 1..K to search for; None explores.
        rate: r, per frame, 0 or more.
        start: first cell; None draws one at random.
        seed: seed of the generator that draws the start and breaks ties.
        thresholds: thresholds at which a search decides; None takes those of the observer.

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
        # Detections of the looks of which at least half the evidence is left.
        self._recent: deque[Detections] = deque(maxlen=max(1, int(min(self.forgetting.span, _MOST))))

    def step(self, frame: ImageLike) -> Moment:
        """Look at the next frame.

        Args:
            frame: a picture of any common kind (`semfov.as_image`), of the same size as the first frame.

        Returns:
            Look, belief and decision at this frame.

        Raises:
            InputError: it is no picture, or has another size.
            DataError: the file of the frame cannot be read.
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
            check(size == wanted, "frame", f"{wanted} pixels, the size of the first frame", size)
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
