"""A fovea that looks at a stream: one look at every frame, and a belief that continues between frames."""

import sys
from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.agents.fovea import FoveaAgent
from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.data.inputs import Color, ImageLike, as_image
from semfov.decision import MOST_CLOSER, CandidateCells, CloseUp, Decision, Verifier, conclude, decide
from semfov.detection.detections import Detections
from semfov.episode import LiveLooks, Step, Stopwatch, rollout
from semfov.eye import View
from semfov.gaze.choice import Greedy, drawn_by, first_cell
from semfov.live.base import FramePerception
from semfov.paths import FoveaMoment
from semfov.paths.stimulus import in_bytes

RATE = 0.1
"""Default rate at which the belief of a fovea fades, per frame."""

_LONGEST = 640  # longer side of the frames that records keep, in pixels
_MOST = 1000  # largest number of looks whose detections are kept


def _copy(frame: Tensor) -> Tensor:
    """A frame `(1, 3, H, W)` as bytes, reduced by a whole number: resampling a large frame takes as long as a look."""
    side = -(-max(frame.shape[-2:]) // _LONGEST)
    return in_bytes(F.avg_pool2d(frame, side, ceil_mode=True, count_include_pad=False)[0])


class FovealPerception(FramePerception):
    r"""Looks at the frames of a stream by a fovea, with one gaze shift per frame, and keeps its belief between frames.

    The gaze continues from its last position. Each frame multiplies the evidence of earlier frames by :math:`e^{-r}`,
    with the rate r. Without new evidence the map thus returns to the prior, and it can follow a scene that moves.
    Fixated cells are free again after :math:`\ln 2 / r` frames (`semfov.episode.Forgetting`, `Observer.fade`). With
    rate 0, frames of a still picture give the same belief as a search of the picture.

    With a model of verification, the target is found by closer looks alone, as in a search. A frame is then either a
    look of the fovea or a closer look at a place that seems to hold the target, since each costs one pass of the
    detector. What a closer look has told fades, too (`semfov.decision.Verifier`). With rate 0, frames of a
    still picture give the looks, the closer looks and the decision of a search up to its end. Only a place that is
    probable enough, but not enough to end a search at once, is called found earlier, as soon as it was examined.

    Args:
        agent: the part of an agent that looks by a fovea.
        target: class 1..K to search for; None explores.
        rate: r, per frame, 0 or more.
        start: first cell; None draws one at random.
        seed: seed of the generator that draws the start and breaks ties.
        confirm: least probability for `found`; None takes that of the model.
        give_up: probability below which a cell is not worth a look; None takes that of the belief alone, which a belief
            that fades can reach, or with rate 0 that of a search.
        closer: largest number of closer looks in :math:`\ln 2 / r` frames.
        color: order of the channels of frames that are arrays or tensors, `rgb`, or `bgr` as OpenCV reads them.

    Example::

        live = FovealPerception(agent.fovea, agent.classes.index("cup"))
        for frame in frames:
            moment = live.step(frame)
            print(moment.decision.outcome, moment.fixation)
    """

    def __init__(
        self,
        agent: FoveaAgent,
        target: int | None = None,
        *,
        rate: float = RATE,
        start: int | None = None,
        seed: int = 0,
        confirm: float | None = None,
        give_up: float | None = None,
        closer: int = MOST_CLOSER,
        color: Color = "rgb",
    ) -> None:
        super().__init__(agent.classes, target, (), rate, color)
        strategy = agent.exploring if target is None else agent.searching
        self.eye, self.observer, self.policy, self.cells = agent.eye, strategy.observer, strategy.policy, agent.cells
        self.verification, self.closer = None if target is None else agent.deciding(closer), closer
        own = self.observer.thresholds
        chosen = own if self.verification is None else self.verification.thresholds
        usual = own.give_up if rate and own is not None else None
        self.thresholds = None if chosen is None else chosen.changed(give_up=usual).changed(confirm, give_up)
        self._first = first_cell(start, seed, self.cells[0] * self.cells[1])
        self._looks: LiveLooks | None = None
        self._steps: Iterator[Step] = iter(())
        self._verifier: Verifier[Step] | None = None
        self._number = 0
        # The present frame, and the detections of the last closer look.
        self._image: Tensor | None = None
        self._closely: Detections | None = None
        # The last look of the fovea, and the number of its frame.
        self._last: tuple[Step, int] | None = None
        # Detections of the looks of which at least half the evidence is left.
        self._recent: deque[Detections] = deque(maxlen=max(1, int(min(self.forgetting.span, _MOST))))

    def step(self, frame: ImageLike) -> FoveaMoment:
        """Look at the next frame; see `FramePerception.step`."""
        with torch.inference_mode():
            image = as_image(frame, like=self.eye.sensor.like, argument="frame", color=self.color)[None]
            self.check_size((image.shape[-1], image.shape[-2]))
            if self._verifier is not None:
                self._verifier.wait()
            self._image, cell = image, self._candidate
            moment = self._look(image) if cell is None else self._look_closely(cell)
            self._number += 1
            return moment

    @property
    def _candidate(self) -> int | None:
        """Cell of the place that the next frame is spent on; None for a look of the fovea."""
        place = None if self._verifier is None else self._verifier.candidate
        return None if place is None else place.cell

    def _close_up(self, box: Tensor) -> Detections:
        """Look closely at a box of the present frame."""
        assert self._image is not None
        self._closely = self.eye.close_up(self._image, box)
        return self._closely

    def _look(self, image: Tensor) -> FoveaMoment:
        """Spend a frame on a look of the fovea."""
        watch = Stopwatch()
        view = self.eye.open(image)
        watch.lap("open")
        if self._looks is None:
            self._looks = self._begin(image, view)
        self._looks.view = view
        self._looks.frames = 1 if self._last is None else self._number - self._last[1]
        step = next(self._steps)
        self._last = step, self._number
        if self._verifier is not None:
            self._verifier.see(step)
        self._recent.append(step.detections)
        seconds = {**watch.seconds, **step.seconds}
        return self._moment(step, self._looks.grid, int(step.cell), step.detections, seconds)

    def _look_closely(self, cell: int) -> FoveaMoment:
        """Spend a frame on a closer look at a place in a cell."""
        assert self._looks is not None
        assert self._last is not None
        assert self._verifier is not None
        watch = Stopwatch()
        closer = self._verifier.look()
        watch.lap("detect")
        assert self._closely is not None
        return self._moment(self._last[0], self._looks.grid, cell, self._closely, watch.seconds, closer)

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
        if self.verification is not None and self.target is not None:
            places = CandidateCells(grid, self.target, self.forgetting)
            self._verifier = Verifier(self.verification, places, self._close_up, self.thresholds, self.closer)
        return looks

    def _moment(
        self,
        step: Step,
        grid: Grid,
        cell: int,
        detections: Detections,
        seconds: dict[str, float],
        closer: CloseUp | None = None,
    ) -> FoveaMoment:
        return FoveaMoment(
            classes=self.classes,
            target=self.target,
            decision=self._decision(step, grid),
            number=self._number,
            grid=grid,
            cell=cell,
            fixation=grid.centres[cell].to(step.fixation),
            detections=detections,
            probability=_probability(step.belief, self.target),
            belief=step.belief,
            visited=step.visited[0],
            next_cell=int(step.next_cell) if self._candidate is None else self._candidate,
            seconds=seconds,
            closer=None if closer is None else replace(closer, fixation=0),
            photograph=None if self._image is None else _copy(self._image),
        )

    def _decision(self, step: Step, grid: Grid) -> Decision | None:
        if self._verifier is not None:
            return self._verifier.decision()
        if self.target is None or self.thresholds is None:
            return None
        outcome = int(decide(step, self.target, self.thresholds))
        return conclude(outcome, step.belief, tuple(self._recent), grid, self.target)


def _probability(belief: Belief, target: int | None) -> Tensor:
    """Probability that each cell holds the target, or any object, `(X·Y,)`."""
    return 1 - belief.class_probabilities()[0, :, 0] if target is None else belief.probability(target)[0]
