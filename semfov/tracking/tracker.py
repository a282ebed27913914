"""A tracker for looks that show only some objects: places and probabilities of all objects.

tracks ── their boxes are followed, ──► predicted ── a look at a window ──► seen: place, velocity, more probable
          the camera moves, time passes                                     not seen there: less probable
                                                                            not looked at: less so with time (ℓ)

`semfov.agents.window_episode.WindowSession` makes the tracker of a stream, and asks another one for the same: `follow`
before a frame, `see` after each look, `tracks` for the list, and `model` for the value of looks
(`semfov.tracking.gain`). The studies compare it with others (`eval.stream`).
"""

from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from semfov.detection.selection import Selection, remaining_rows
from semfov.motion import CameraStep, LostScene, Motion
from semfov.motion.patches import PatchFlow
from semfov.tracking.assignment import cheapest_pairs
from semfov.tracking.kalman import Floats, Kinematics
from semfov.tracking.model import TrackingModel
from semfov.tracking.tracks import Tracks, no_trail

_FOLLOWED = 32  # most objects that are followed from frame to frame
_CLEAR_WAY = 1.0  # pixels between two frames from which on a motion is no noise
_SAME = 0.1  # share of its contrast by which the patch of an object that has stopped changes at most
_AS_CLOSE = 0.9  # of the magnification of a look, from which on another one is as close
_NO_NUMBERS = np.zeros(0, np.int64)
_ONE_OF_CLASS = Selection(iou=0.5, limit=10**9, per_class=True)  # two objects that overlap by more than half are one


@dataclass(frozen=True, eq=False)
class Seen:
    """Detections of a look at a window of a frame.

    Attributes:
        boxes: `(M, 4)`, in pixels of the frame.
        scores: `(M,)`, from 0 to 1.
        labels: `(M,)`, classes 1..K.
        cut: `(M,)` boolean, whether the border of the window cuts a box where the frame goes on beyond it.
        region: `(x1, y1, x2, y2)`, the window in pixels of the frame.
        magnification: canvas pixels for a pixel of the frame.
        number: number of the look.
        entering: `(M,)` boolean, whether the border of the frame cuts a box, which may show more of its object later;
            None for no box.

    >>> box = np.array([[100.0, 100.0, 140.0, 180.0]])
    >>> seen = Seen(box, np.array([0.8]), np.array([1]), np.array([False]), (0.0, 0.0, 400.0, 400.0), 1.0)
    >>> len(seen.scores), seen.number
    (1, 0)
    """

    boxes: Floats
    scores: Floats
    labels: NDArray[np.int64]
    cut: NDArray[np.bool_]
    region: tuple[float, float, float, float]
    magnification: float
    number: int = 0
    entering: NDArray[np.bool_] | None = None


class _Known(NamedTuple):
    """Objects, and the seconds of the stream at which they were predicted last."""

    tracks: Tracks
    time: float


class Tracker:
    r"""Tracks objects through a stream: Kalman filters of constant velocity, and a probability that each is there.

    The probability p follows the recursion of a Bernoulli filter (Ristic et al., 2013, IEEE Transactions on Signal
    Processing 61:3406), in two parts. That by what was shown, q, is after t seconds

    .. math:: q \leftarrow q \, (1 - \ell)^t

    and the odds p / (1 - p) are those of q, times a factor for each look since then that should have shown the object,
    and did not (`TrackingModel`), and times one for an object that is seen to move (`Tracks.moving_odds`).

    Detections belong to the objects at whose predicted places they most probably lie, all of them jointly; others begin
    objects of their own. What no look covers goes on, also out of view: p falls by ℓ a second (`TrackingModel.loss`),
    and below `TrackingModel.least` it is dropped. What is listed is p times the probability that its box still fits,
    which falls as its place becomes uncertain (`Tracks.probability`).

    Attributes:
        model: what is assumed of objects and looks.
        tracks: the objects, where they are in the present frame.

    Private attributes: `_lost` has the objects of a scene that the camera has lost and may find again, where they were
    in its last frame. `_last` is the last number that was given, and `_is_marked` tells whether the trails have a place
    in the present frame. `_followed` has the numbers of the objects that were followed into it.

    Invariant: `tracks` are in the order of their numbers, none of which is given twice; those of `_lost` are lower than
    those that began after it.

    >>> tracker = Tracker()
    >>> box = np.array([[100.0, 100.0, 140.0, 180.0]])
    >>> for step in range(4):
    ...     tracker.follow(0.1)
    ...     tracker.see(Seen(box + 5 * step, np.array([0.8]), np.array([1]), np.array([False]), (0, 0, 400, 400), 1.0))
    >>> tracker.tracks.track_ids.tolist(), tracker.tracks.velocities.round().tolist()
    ([1], [[49.0, 49.0]])
    """

    def __init__(self) -> None:
        self.model = TrackingModel()
        self.tracks = Tracks.none()
        self._now = 0.0  # seconds of the stream
        self._lost: LostScene[_Known] = LostScene()
        self._last = 0
        self._is_marked = False
        self._followed = _NO_NUMBERS

    def follow(self, seconds: float, camera: CameraStep | None = None, flow: PatchFlow | None = None) -> None:
        """Predict the objects at the next frame.

        Args:
            seconds: time since the last frame.
            camera: how the camera moved since the last frame; None for one that stands still.
            flow: follows the boxes of objects from the last frame to this one; None where nothing does.
        """
        step = camera or CameraStep(Motion.still())
        if flow is not None and step.motion is not None and seconds > 0:
            self._followed = self._see_motion(seconds, step.motion, flow)
        else:
            self._followed = _NO_NUMBERS
        known = _Known(self.tracks, self._now)
        self._now += seconds
        self._is_marked = False
        scenes = self._lost.follow([known], step, self._at_present)
        self.tracks = reduce(Tracks.joined, (scene.tracks for scene in scenes)) if scenes else Tracks.none()

    def _see_motion(self, seconds: float, motion: Motion, flow: PatchFlow) -> NDArray[np.int64]:
        """Update the velocities of the most probable objects by how they have moved since the last frame.

        Args:
            seconds: time since the last frame.
            motion: of the camera since then.
            flow: follows the boxes of objects.

        Returns:
            Numbers of the objects that were followed, `(M,)`.
        """
        rows = np.argsort(-self.tracks.log_odds, kind="stable")[:_FOLLOWED]
        tracks = self.tracks[rows]
        places = tracks.place
        way = np.where(tracks.moves[:, None], seconds * tracks.kinematics.velocity, 0.0)
        expected = motion.points(torch.from_numpy(places + way)).numpy()
        found = flow.follow(tracks.corners, expected)
        # Beside the scene, in pixels of the last frame: what the camera's motion does not explain.
        origins = motion.inverse().points(torch.from_numpy(found.places)).numpy()
        shifts = origins - places
        followed = found.are_followed & self._are_objects(tracks, way, shifts, found.changes)
        variance = (self.model.flow * tracks.sides) ** 2 + self.model.unsteady**2
        moved = tracks.kinematics.moved(shifts / seconds, variance / seconds**2)
        kinematics = self.tracks.kinematics.with_rows(rows[followed], moved[followed])
        self.tracks = replace(self.tracks, kinematics=kinematics)
        return tracks.track_ids[followed]

    def _are_objects(self, tracks: Tracks, way: Floats, shifts: Floats, changes: Floats) -> NDArray[np.bool_]:
        """Tell which patches are those of the objects: not the ground where they were, nor what hides them.

        What stays behind is no object, unless the last frame showed just the same of it: then the object has stopped.

        Args:
            tracks: the objects.
            way: `(N, 2)`, how far they were expected to move, in pixels.
            shifts: `(N, 2)`, how far their patches have moved.
            changes: `(N,)`, how much these have changed (`FollowedPatches`).

        Returns:
            `(N,)`.
        """
        far = np.linalg.norm(way, axis=-1)
        stays_behind = (far > _CLEAR_WAY) & (np.linalg.norm(shifts, axis=-1) < far / 2)
        was_shown = (tracks.unseen == 0) | np.isin(tracks.track_ids, self._followed)
        has_stopped = was_shown & (changes < _SAME)
        return np.asarray(has_stopped | ~stays_behind)

    def _at_present(self, scenes: list["_Known"], motion: Motion) -> list["_Known"]:
        """Predict objects at the present frame, to which the camera moved."""
        return [_Known(self._after(tracks, self._now - time, motion), self._now) for tracks, time in scenes]

    def _after(self, tracks: Tracks, seconds: float, motion: Motion) -> Tracks:
        """Predict objects some seconds later, and forget those that are hardly there any more."""
        model = self.model
        if not len(tracks):
            return tracks
        lasting = np.log1p(-model.loss) * seconds
        chance = lasting - np.logaddexp(0, -tracks.shown_odds)
        later = replace(
            tracks.after(seconds, model.acceleration * tracks.sides**2),
            size_variance=tracks.size_variance + model.growth * seconds,
            shown_odds=chance - np.log(-np.expm1(chance)),
        )
        later = later[later.log_odds > np.log(model.least / (1 - model.least))]
        return later if motion.is_still else later.carried(motion)

    def see(self, seen: Seen) -> None:
        """Update the objects by a look at the present frame.

        A box that the border of the window cuts (`Seen.cut`) keeps its object from a miss, but does not update it, and
        begins none: another window may show all of it. One that only the border of the frame cuts (`Seen.entering`)
        updates or begins an object, as no window shows more of it now, but leaves the size open for the next look.

        Args:
            seen: what the look shows.
        """
        noise = self._noise(seen)
        pairs = cheapest_pairs(self._costs(seen, noise))
        # A cut box shows that its object is there, but neither its place nor its size.
        is_whole = ~seen.cut[pairs[:, 1]]
        self._miss(seen, pairs[:, 0])
        self._hit(seen, noise, pairs[is_whole])
        is_unpaired = ~seen.cut
        is_unpaired[pairs[:, 1]] = False
        self._begin(seen, noise, is_unpaired)
        self._merge_doubles()
        # A frame may have several looks, and a trail has one place of each frame.
        self.tracks = self.tracks.marked(anew=self._is_marked)
        self._is_marked = True

    def _noise(self, seen: Seen) -> Floats:
        """Variance of the places of detections, `(M,)`, in square pixels."""
        sides = np.exp(_log_size(seen.boxes).mean(-1))
        return (self.model.place * sides) ** 2 + (self.model.pixel / seen.magnification) ** 2

    def _least_size_variance(self, seen: Seen) -> Floats:
        """Least variance of the logarithm of an object's size after each detection, `(M,)`."""
        entering = np.zeros(len(seen.scores), bool) if seen.entering is None else seen.entering
        # A box that was cut would hold the size back for many looks, so that the next one is to decide.
        return np.where(entering, self.model.entering**2, 0.0)

    def _costs(self, seen: Seen, noise: Floats) -> Floats:
        """Minus the log odds that a detection shows an object rather than another one, `(N, M)`."""
        model = self.model
        tracks = self.tracks
        log_size = _log_size(seen.boxes)
        area = np.exp(log_size.sum(-1))
        variance = tracks.kinematics.variance[:, None] + noise
        distance = _squared_distance(tracks.kinematics.place, _centres(seen.boxes)) / variance
        size_variance = tracks.size_variance[:, None] + model.size**2
        size_distance = _squared_distance(tracks.log_size, log_size) / size_variance
        by_place = -distance / 2 - np.log(2 * np.pi * variance / area)
        by_size = -size_distance / 2 - np.log(size_variance / _SIZE_SPREAD**2)
        apart = (distance > model.gate) | (size_distance > model.gate) | (tracks.labels[:, None] != seen.labels)
        return np.where(apart, np.inf, model.density - by_place - by_size)

    def _miss(self, seen: Seen, shown_rows: NDArray[np.intp]) -> None:
        """Believe less in objects that the look should have shown."""
        model = self.model
        tracks = self.tracks
        inside = _chance_inside(tracks, seen.region)
        by_size = model.miss * np.log1p(-inside * model.detects(tracks.sides * seen.magnification))
        shown = 1 / (1 + np.exp(-tracks.shown_odds))
        by_look = np.log1p(-inside * model.again * shown)
        is_as_close = seen.magnification >= _AS_CLOSE * tracks.magnification
        change = np.where(is_as_close, np.minimum(by_size, by_look), by_size)
        change[shown_rows] = 0
        self.tracks = replace(tracks, missed_odds=tracks.missed_odds + change)

    def _hit(self, seen: Seen, noise: Floats, pairs: NDArray[np.intp]) -> None:
        """Update the objects that the look shows, by pairs `(P, 2)` of objects and detections."""
        rows, columns = pairs.T
        tracks = self.tracks[rows]
        log_size = _log_size(seen.boxes[columns])
        gain = tracks.size_variance / (tracks.size_variance + self.model.size**2)
        evidence = self.model.evidence(seen.scores[columns])
        kinematics = tracks.kinematics.measured(_centres(seen.boxes[columns]), noise[columns])
        updated = replace(
            tracks,
            kinematics=kinematics,
            rest_place=kinematics.place,
            log_size=tracks.log_size + gain[:, None] * (log_size - tracks.log_size),
            size_variance=np.maximum(tracks.size_variance * (1 - gain), self._least_size_variance(seen)[columns]),
            shown_odds=np.maximum(tracks.shown_odds, evidence),
            missed_odds=np.zeros(len(rows)),
            unseen=np.zeros(len(rows)),
            magnification=np.full(len(rows), seen.magnification),
            passes=np.full(len(rows), seen.number),
        )
        self.tracks = self.tracks.with_rows(rows, updated)

    def _begin(self, seen: Seen, noise: Floats, is_new: NDArray[np.bool_]) -> None:
        """Begin an object with each of the detections `(M,)` that show none that is known."""
        if not is_new.any():
            return
        boxes = seen.boxes[is_new]
        log_size = _log_size(boxes)
        count = len(boxes)
        speed = self.model.speed * np.exp(log_size.mean(-1))
        begun = Tracks(
            track_ids=self._last + 1 + np.arange(count),
            labels=seen.labels[is_new],
            kinematics=Kinematics.at(_centres(boxes), noise[is_new], speed),
            rest_place=_centres(boxes),
            speed=speed,
            log_size=log_size,
            size_variance=np.maximum(self.model.size**2, self._least_size_variance(seen)[is_new]),
            shown_odds=self.model.evidence(seen.scores[is_new]),
            missed_odds=np.zeros(count),
            unseen=np.zeros(count),
            magnification=np.full(count, seen.magnification),
            passes=np.full(count, seen.number),
            trail=no_trail(count),
        )
        self._last += count
        self.tracks = self.tracks.joined(begun)

    def _merge_doubles(self) -> None:
        """Drop objects that lie on a more probable one of their class."""
        tracks = self.tracks
        boxes = tracks.corners.astype(np.float32)
        rows = remaining_rows(boxes, tracks.log_odds.astype(np.float32), tracks.labels, _ONE_OF_CLASS)
        if len(rows) < len(tracks):
            # Back in the order of their numbers, as suppression lists them by their odds.
            self.tracks = tracks[np.sort(rows)]


_SIZE_SPREAD = 0.5  # standard deviation of the logarithm of the sizes of other objects


def _centres(boxes: Floats) -> Floats:
    return (boxes[:, :2] + boxes[:, 2:]) / 2


def _log_size(boxes: Floats) -> Floats:
    """Logarithms of the widths and heights of boxes, at least a pixel, `(M, 2)`."""
    return np.log(np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0))


def _squared_distance(rows: Floats, columns: Floats) -> Floats:
    """Squared distances of points `(N, 2)` and `(M, 2)`, `(N, M)`."""
    return ((rows[:, None] - columns) ** 2).sum(-1)


def _chance_inside(tracks: Tracks, region: tuple[float, float, float, float]) -> Floats:
    """Probability that the whole box of each object lies in a window, `(N,)`."""
    half = np.exp(tracks.log_size) / 2
    deviation = np.sqrt(tracks.kinematics.variance)[:, None]
    low = (np.array(region[:2]) + half - tracks.place) / deviation
    high = (np.array(region[2:]) - half - tracks.place) / deviation
    below = torch.special.ndtr(torch.from_numpy(np.stack([low, high]))).numpy()
    return (below[1] - below[0]).clip(0).prod(-1)
