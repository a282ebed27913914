"""Ways of looking at a stream: of each frame everything, or one pass with a memory."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from itertools import cycle

import torch
from torch import Tensor

from eval.stream.bytetrack import ByteTrack
from eval.stream.flights import Frame
from eval.stream.misses import Misses
from eval.zoom.objects import suppressed
from semfov.agents.window_episode import LIKELY, WindowStream
from semfov.agents.window_objects import seen_by
from semfov.data.inputs import FRAME
from semfov.detection.objects import Objects
from semfov.motion import CameraMotion, CameraStep
from semfov.observation.matching import box_iou, inside_frame
from semfov.paths import WindowMoment
from semfov.tracking import Tracker
from semfov.zoom.episode import KeptLook, carry_along
from semfov.zoom.eye import WindowEye
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import LiveWindowLooks, Window, half_steps
from semfov.zoom.slices import slices

LIVE, CANDIDATES = "live", "live, all candidates"
SLICES = "whole frame and "
"""Beginning of the row of all slices, whose number depends on the frame."""
_SAME = 0.5  # intersection over union from which on a box fits an object
_FADING = 24.0  # frames after which an oracle looks at a place again


class Way(ABC):
    """Base of ways of looking at the frames of a stream for objects of a class; `passes` of the detector a frame.

    `remembers` says whether what a frame shows counts later, so that all frames must be looked at.
    """

    remembers = True
    passes = 1

    def __init__(self, eye: WindowEye, target: int) -> None:
        self.eye, self.target = eye, target

    @abstractmethod
    def step(self, frame: Frame) -> Mapping[str, Objects]:
        """Look at the next frame, and tell the objects that are known then, by the name of the row in tables."""

    def looks_at(self, frame: Frame) -> LiveWindowLooks:
        """Open a frame."""
        return LiveWindowLooks(self.eye, self.eye.open(frame.pixels))


class WholeFrame(Way):
    """One pass at the whole frame."""

    remembers = False

    def step(self, frame: Frame) -> Mapping[str, Objects]:
        source = self.looks_at(frame)
        looks = source.see([Window.overview(source.lattice)], hints=False)
        return {"whole frame": suppressed(looks, self.target).objects}


class AllSlices(Way):
    """The whole frame, and slices of it at native size."""

    remembers = False

    def step(self, frame: Frame) -> Mapping[str, Objects]:
        source = self.looks_at(frame)
        windows = whole_and_slices(source.lattice)
        self.passes = len(windows)
        looks = [look for window in windows for look in source.see([window], hints=False)]
        return {f"{SLICES}{self.passes - 1} slices": suppressed(looks, self.target).objects}


class TrackedSlices(AllSlices):
    """The whole frame and slices of it, whose detections ByteTrack joins to tracks."""

    remembers = True

    def __init__(self, eye: WindowEye, target: int) -> None:
        super().__init__(eye, target)
        self.tracker = ByteTrack()

    def step(self, frame: Frame) -> Mapping[str, Objects]:
        (objects,) = super().step(frame).values()
        return {f"{self.passes - 1} slices and ByteTrack": self.tracker.step(objects)}


class RoundRobin(Way):
    """The whole frame and slices of it in turn, one a frame; looks of the last round count, carried along or not."""

    def __init__(self, eye: WindowEye, target: int, *, carries: bool) -> None:
        super().__init__(eye, target)
        self.camera = CameraMotion() if carries else None
        self.name = f"slices in turn, {'carried along' if carries else 'where they were'}"
        self.kept: list[KeptLook] = []

    def step(self, frame: Frame) -> Mapping[str, Objects]:
        source = self.looks_at(frame)
        if self.camera is not None:
            self._carry(self.camera.step(frame.pixels), source.lattice)
        if not self.kept:
            self.windows = cycle(windows := whole_and_slices(source.lattice))
            self.round = len(windows)
        (look,) = source.see([next(self.windows)], hints=False)
        self.kept = [*self.kept, KeptLook(look, 0, 0.0)][-self.round :]
        objects = suppressed([kept.current for kept in self.kept], self.target).objects
        return {self.name: objects[inside_frame(objects.boxes, source.lattice.size)]}

    def _carry(self, camera: CameraStep, lattice: Lattice) -> None:
        if camera.motion is None:
            self.kept = []
        else:
            carry_along(self.kept, camera.motion, lattice)


class Live(Way):
    """The agent, for all objects of the class: those that it lists, and all candidates.

    Attributes:
        name: of the row of what it lists.
        misses: why it does not list objects.
    """

    def __init__(self, eye: WindowEye, target: int, episode: WindowStream, *, poses: bool = False) -> None:
        super().__init__(eye, target)
        self.episode, self.poses = episode, poses
        self.passes = episode.passes_of_frame
        self._known = ", pose known" if poses else ""
        self._known += f", {self.passes} passes" if self.passes > 1 else ""
        self.name = LIVE + self._known
        self.misses = Misses()
        self._moment: WindowMoment | None = None  # of the present frame

    def step(self, frame: Frame) -> Mapping[str, Objects]:
        self._moment = moment = self.episode.step(frame.pixels, pose=frame.pose if self.poses else None)
        # All candidates are too many for numbers to be told of them.
        candidates = replace(moment.candidates, track_ids=None)
        return {self.name: moment.objects, CANDIDATES + self._known: candidates}

    def find_misses(self, frame: Frame, *, counts: bool) -> None:
        """Find out which objects of the present frame are not listed, where their numbers are known.

        Args:
            frame: the frame.
            counts: whether the frame counts, or is only remembered.
        """
        if frame.identities is None or self._moment is None:
            return
        annotation = frame.annotation
        chosen = annotation.labels == self.target
        self.misses.step(
            frame.identities[chosen],
            annotation.boxes[chosen],
            self._moment.tracks,
            [look.region for look in self._moment.looks[-self.passes :]],
            annotation.size,
            moving=None if frame.moving is None else frame.moving[chosen],
            counts=counts,
        )


class Oracle(Way):
    r"""One look a frame where the annotated objects are that the tracker knows least; the rest is that of the agent.

    A window is worth the annotated objects in it, each by the share that no box fits, the probability that a look from
    there shows it (`TrackingModel.detects`), and the time since a look showed its place, :math:`1 - \exp(-n / 24)`
    after n frames. It says how much a better choice of windows could bring, and not how much is possible: an object
    that the detector misses is looked at again, too.
    """

    def __init__(self, eye: WindowEye, target: int) -> None:
        super().__init__(eye, target)
        self.camera = CameraMotion()
        self.tracker = Tracker()
        self.number = 0
        self.seen_at: dict[int, int] = {}  # number of the frame in which a look last showed each annotated object

    def step(self, frame: Frame) -> Mapping[str, Objects]:
        source = self.looks_at(frame)
        lattice = source.lattice
        camera = self.camera.step(frame.pixels)
        if self.number:
            self.tracker.follow(FRAME, camera)
        window = self._best_window(frame, lattice) if self.number else Window.overview(lattice)
        (look,) = source.see([window], hints=False)
        self.tracker.see(seen_by(KeptLook(look, 0, 0.0, self.number), lattice, (self.target,)))
        for identity in self._identities(frame)[_inside(frame.annotation.boxes, window.region(lattice))].tolist():
            self.seen_at[identity] = self.number
        self.number += 1
        objects = self.tracker.tracks.objects()
        objects = objects[inside_frame(objects.boxes, lattice.size)]
        return {"oracle": objects[objects.scores >= LIKELY], "oracle, all candidates": replace(objects, track_ids=None)}

    def _best_window(self, frame: Frame, lattice: Lattice) -> Window:
        """Choose the window of any level that is worth most."""
        annotation = frame.annotation
        chosen = annotation.labels == self.target
        boxes = annotation.boxes[chosen]
        objects = self.tracker.tracks.objects()
        fits = (box_iou(boxes, objects.boxes) >= _SAME) * objects.scores
        known = torch.cat([fits, torch.zeros(len(boxes), 1)], 1).amax(1)
        ages = [self.number - self.seen_at.get(identity, -100) for identity in self._identities(frame)[chosen].tolist()]
        worth = (1 - known) * (1 - (-torch.tensor(ages) / _FADING).exp())
        sides = (boxes[:, 2:] - boxes[:, :2]).prod(-1).sqrt().double().numpy()
        windows = list(half_steps(lattice))
        values = []
        for window in windows:
            shown = torch.from_numpy(self.tracker.model.detects(sides * window.fixation[2]))
            values.append(float((worth * shown)[_inside(boxes, window.region(lattice))].sum()))
        return windows[values.index(max(values))]

    def _identities(self, frame: Frame) -> Tensor:
        """Numbers of the annotated objects; where they are not known those in the frame."""
        return torch.arange(len(frame.annotation.boxes)) if frame.identities is None else frame.identities


def _inside(boxes: Tensor, region: tuple[float, float, float, float]) -> Tensor:
    """Tell which boxes `(N, 4)` lie in a region, `(N,)` boolean."""
    x1, y1, x2, y2 = region
    low, high = boxes.new_tensor([x1, y1]), boxes.new_tensor([x2, y2])
    return (boxes[:, :2] >= low).all(-1) & (boxes[:, 2:] <= high).all(-1)


def whole_and_slices(lattice: Lattice) -> list[Window]:
    """Return the whole frame, and squares as large as the detector's input at native size, which overlap by a fifth."""
    side = min(lattice.canvas)
    return [Window.overview(lattice), *slices(lattice, side, int(0.8 * side))]
