"""Active perception of a camera or a video: one look at every frame, and a belief that continues between frames."""

import sys
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from time import perf_counter
from typing import get_args

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.agents.windows import pays
from semfov.belief.grid import Grid
from semfov.belief.observers import Observer
from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import Verification
from semfov.data.inputs import Color, ImageLike, as_image
from semfov.decision import MOST_CLOSER, CandidateCells, CloseUp, Decision, Verifier, conclude, decide
from semfov.detection.detections import Detections
from semfov.episode import Forgetting, LiveLooks, Step, Stopwatch, rollout
from semfov.errors import check, check_whole, lookup
from semfov.eye import Eye, View
from semfov.gaze.choice import Greedy, drawn_by, first_cell
from semfov.gaze.policies import Policy
from semfov.paths import Moment
from semfov.paths.stimulus import in_bytes

RATE = 0.1
"""Default rate at which belief fades, per frame."""

_LONGEST = 640  # longer side of the frames that records keep, in pixels
_MOST = 1000  # largest number of looks whose detections are kept


WARM_UP = 3
"""Number of first frames of a stream that take longer than the others, because the detector gets ready."""


class FrameRate:
    """Counts the frames per second of a stream, without its first frames, in which the detector gets ready.

    Args:
        warm_up: number of first frames that do not count.
        recent: number of frames over which the present rate is taken.
        clock: gives the time in seconds.

    Attributes:
        frames: number of frames so far, the first ones included.

    >>> rate = FrameRate(warm_up=1, clock=iter([2.5, 2.6, 2.8]).__next__)
    >>> for _ in range(3):
    ...     rate.add()
    ...     print(rate)
    warming up
    10.0 frames/s
    6.7 frames/s
    >>> rate.summary()
    '3 frames, 6.7 per second after the first'
    """

    def __init__(self, warm_up: int = WARM_UP, *, recent: int = 20, clock: Callable[[], float] = perf_counter) -> None:
        check_whole(warm_up, "warm_up", 1, 1_000_000)
        check_whole(recent, "recent", 1, 1_000_000)
        self.warm_up, self.frames, self._clock = warm_up, 0, clock
        self._warm = 0.0
        self._ends: deque[float] = deque(maxlen=recent + 1)

    def add(self) -> None:
        """Count a frame that was looked at."""
        now = self._clock()
        self.frames += 1
        if self.frames >= self.warm_up:
            self._warm = now if self.frames == self.warm_up else self._warm
            self._ends.append(now)

    @property
    def now(self) -> float | None:
        """Frames per second of late; None before the first frame that counts."""
        return _rate(len(self._ends) - 1, self._ends[-1] - self._ends[0]) if self._ends else None

    @property
    def mean(self) -> float | None:
        """Frames per second of all frames that count; None before the first."""
        return _rate(self.frames - self.warm_up, self._ends[-1] - self._warm) if self._ends else None

    def __str__(self) -> str:
        """The present rate in words."""
        return "warming up" if self.now is None else f"{self.now:.1f} frames/s"

    def summary(self) -> str:
        """Describe the whole stream in words, and say which frames do not count.

        Returns:
            The words.
        """
        frames = f"{self.frames} frame{'' if self.frames == 1 else 's'}"
        if self.mean is None:
            return f"{frames}, all of them while the detector got ready"
        first = "the first" if self.warm_up == 1 else f"the first {self.warm_up}"
        return f"{frames}, {self.mean:.1f} per second after {first}"


def _copy(frame: Tensor) -> Tensor:
    """A frame `(1, 3, H, W)` as bytes, reduced by a whole number: resampling a large frame takes as long as a look."""
    side = -(-max(frame.shape[-2:]) // _LONGEST)
    return in_bytes(F.avg_pool2d(frame, side, ceil_mode=True, count_include_pad=False)[0])


def _rate(frames: int, seconds: float) -> float | None:
    return frames / seconds if frames > 0 and seconds > 0 else None


class LivePerception:
    r"""Looks at the frames of a stream, with one gaze shift per frame, and keeps its belief between frames.

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
        eye: sensor and detector.
        observer: turns looks into a belief.
        policy: chooses the next fixation from the belief.
        classes: names of the classes, background first.
        cells: `(columns, rows)` of the belief.
        target: class 1..K to search for; None explores.
        rate: r, per frame, 0 or more.
        start: first cell; None draws one at random.
        seed: seed of the generator that draws the start and breaks ties.
        thresholds: thresholds at which a search decides; None takes those of the model of verification, or without
            closer looks those of the observer.
        verification: probabilities after closer looks; None decides from the looks of the fovea alone.
        closer: largest number of closer looks in :math:`\ln 2 / r` frames.
        color: order of the channels of frames that are arrays or tensors, `rgb`, or `bgr` as OpenCV reads them.

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
        verification: Verification | None = None,
        closer: int = MOST_CLOSER,
        color: Color = "rgb",
    ) -> None:
        self.color = lookup(color, get_args(Color), "order of channels")
        self.eye, self.observer, self.policy = eye, observer, policy
        self.classes, self.cells, self.target = classes, cells, target
        self.forgetting = Forgetting(rate)
        usual = observer if verification is None else verification
        self.thresholds = usual.thresholds if thresholds is None else thresholds
        self.verification, self.closer = verification, closer
        self._first = first_cell(start, seed, cells[0] * cells[1])
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
            image = as_image(frame, like=self.eye.sensor.like, argument="frame", color=self.color)[None]
            self._check_size(image)
            if self._verifier is not None:
                self._verifier.wait()
            self._image, cell = image, self._candidate
            moment = self._look(image) if cell is None else self._look_closely(cell)
            self._number += 1
            return moment

    def _check_size(self, image: Tensor) -> None:
        """Raise `InputError` unless the frame has the size of the first one."""
        if self._looks is not None:
            wanted = " × ".join(f"{side:.0f}" for side in self._looks.grid.extent.tolist())
            size = f"{image.shape[-1]} × {image.shape[-2]}"
            check(size == wanted, "frame", f"{wanted} pixels, the size of the first frame", size)

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

    def _look(self, image: Tensor) -> Moment:
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

    def _look_closely(self, cell: int) -> Moment:
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
        size, canvas = (image.shape[-1], image.shape[-2]), self.eye.detector.input_size
        if pays(size, canvas):
            warnings.warn(
                f"frames of {size[0]} × {size[1]} px are reduced to {canvas[0]} × {canvas[1]} px, where small objects "
                "do not show; give a part of the frames, or search single frames by windows (ActivePerception.search)",
                stacklevel=4,
            )
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
    ) -> Moment:
        return Moment(
            classes=self.classes,
            target=self.target,
            decision=self._decision(step, grid),
            number=self._number,
            grid=grid,
            cell=cell,
            fixation=grid.centres[cell].to(step.fixation),
            detections=detections,
            belief=step.belief,
            visited=step.visited[0],
            next_cell=int(step.next_cell) if self._candidate is None else self._candidate,
            seconds=seconds,
            closer=closer,
            photograph=None if self._image is None else _copy(self._image),
        )

    def _decision(self, step: Step, grid: Grid) -> Decision | None:
        if self._verifier is not None:
            return self._verifier.decision()
        if self.target is None or self.thresholds is None:
            return None
        outcome = int(decide(step, self.target, self.thresholds))
        return conclude(outcome, step.belief, tuple(self._recent), grid, self.target)
