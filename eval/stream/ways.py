"""Ways of looking at a stream: of each frame everything, or one pass with a memory."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from itertools import cycle

from eval.stream.bytetrack import ByteTrack
from eval.stream.flights import Frame
from eval.zoom.objects import suppressed
from semfov.agents.window_episode import WindowStream
from semfov.detection.objects import Objects
from semfov.motion import CameraMotion, CameraStep
from semfov.zoom.carrying import inside_frame
from semfov.zoom.episode import KeptLook, carry_along
from semfov.zoom.eye import WindowEye
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import LiveWindowLooks, Window
from semfov.zoom.slices import slices

LIVE, CANDIDATES = "live", "live, all candidates"


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
        return {f"whole frame and {self.passes - 1} slices": suppressed(looks, self.target).objects}


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
    """The agent, for all objects of the class: those that it lists, and all candidates."""

    def __init__(self, eye: WindowEye, target: int, episode: WindowStream, *, poses: bool = False) -> None:
        super().__init__(eye, target)
        self.episode, self.poses = episode, poses

    def step(self, frame: Frame) -> Mapping[str, Objects]:
        moment = self.episode.step(frame.pixels, pose=frame.pose if self.poses else None)
        known = ", pose known" if self.poses else ""
        # All candidates are too many for numbers to be told of them.
        candidates = replace(moment.candidates, track_ids=None)
        return {LIVE + known: moment.objects, CANDIDATES + known: candidates}


def whole_and_slices(lattice: Lattice) -> list[Window]:
    """Return the whole frame, and squares as large as the detector's input at native size, which overlap by a fifth."""
    side = min(lattice.canvas)
    return [Window.overview(lattice), *slices(lattice, side, int(0.8 * side))]
