"""ByteTrack, plainly: detections of each frame joined to tracks by overlap, the confident ones first, then the others.

Zhang et al. (2022, ECCV): "ByteTrack: Multi-object tracking by associating every detection box".
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from semfov.detection.objects import Objects
from semfov.observation.matching import box_iou
from semfov.tracking.assignment import cheapest_pairs

_Floats = NDArray[np.float64]

_FAINT = 0.1  # score from which on a detection may keep a track alive
_FIRST, _SECOND, _NEW = 0.2, 0.5, 0.3  # least overlap of a pair, of the first round times the score
_KEPT = 30  # frames for which a lost track is kept
_PLACE, _SPEED = 1 / 20, 1 / 160  # standard deviations of the noise, in heights of the box and heights a frame


@dataclass
class _Track:
    """A track: mean and covariance of (x, y, width / height, height) and of their velocities, `(8,)` and `(8, 8)`."""

    number: int
    mean: _Floats
    covariance: _Floats
    score: float
    unseen: int = 0
    is_confirmed: bool = False

    @property
    def box(self) -> _Floats:
        """Box `(4,)`."""
        x, y, shape, high = self.mean[:4]
        return np.array([x - shape * high / 2, y - high / 2, x + shape * high / 2, y + high / 2])


class ByteTrack:
    """Tracks of the detections of successive frames.

    Args:
        confident: score from which on detections are joined to tracks first, and begin new ones .1 above it.
    """

    def __init__(self, confident: float = 0.5) -> None:
        self.confident = confident
        self._tracks: list[_Track] = []
        self._frames = 0
        self._last = 0  # the last number that was given

    def step(self, objects: Objects) -> Objects:
        """Take the detections of the next frame, and tell the tracks that it shows, with their numbers."""
        self._frames += 1
        for track in self._tracks:
            _predict(track)
        boxes = _as_measured(objects.boxes.double().numpy())
        scores = objects.scores.double().numpy()
        confirmed = [track for track in self._tracks if track.is_confirmed]
        fresh = [track for track in self._tracks if not track.is_confirmed]
        high = np.flatnonzero(scores >= self.confident)
        low = np.flatnonzero((scores >= _FAINT) & (scores < self.confident))
        lonely, high = _join(confirmed, high, boxes, scores, _FIRST, fuses=True)
        followed = [track for track in lonely if track.unseen == 1]
        _join(followed, low, boxes, scores, _SECOND, fuses=False)
        unconfirmed, high = _join(fresh, high, boxes, scores, _NEW, fuses=True)
        dropped = {id(track) for track in unconfirmed}
        self._tracks = [track for track in self._tracks if id(track) not in dropped and track.unseen <= _KEPT]
        for number in high[scores[high] >= self.confident + 0.1]:
            self._last += 1
            track = _begun(self._last, boxes[number], float(scores[number]))
            track.is_confirmed = self._frames == 1
            self._tracks.append(track)
        return self._shown(objects)

    def _shown(self, objects: Objects) -> Objects:
        """List the confirmed tracks that were joined to a detection of this frame."""
        shown = [track for track in self._tracks if track.is_confirmed and track.unseen == 0]
        boxes = torch.tensor(np.array([track.box for track in shown]).reshape(-1, 4), dtype=torch.float32)
        scores = torch.tensor([track.score for track in shown])
        labels = torch.full((len(shown),), int(objects.labels[0]) if len(objects) else 1)
        numbers = torch.tensor([track.number for track in shown], dtype=torch.long)
        return Objects(boxes, scores, labels, torch.zeros_like(labels), track_ids=numbers)


def _join(
    tracks: list[_Track],
    rows: NDArray[np.intp],
    boxes: _Floats,
    scores: _Floats,
    least: float,
    *,
    fuses: bool,
) -> tuple[list[_Track], NDArray[np.intp]]:
    """Join tracks to detections by overlap, and update them; returns the tracks and detections that are left."""
    if not tracks or not len(rows):
        return tracks, rows
    own = torch.from_numpy(np.stack([track.box for track in tracks]))
    overlap = box_iou(own, torch.from_numpy(_corners(boxes[rows]))).numpy()
    if fuses:
        overlap = overlap * scores[rows]
    pairs = cheapest_pairs(np.where(overlap >= least, -overlap, np.inf))
    for track, row in pairs:
        _update(tracks[track], boxes[rows[row]], float(scores[rows[row]]))
    alone = np.setdiff1d(np.arange(len(tracks)), pairs[:, 0])
    return [tracks[number] for number in alone], np.delete(rows, pairs[:, 1])


def _begun(number: int, box: _Floats, score: float) -> _Track:
    high = box[3]
    place, speed = 2 * _PLACE * high, 10 * _SPEED * high
    deviations = np.array([place, place, 1e-2, place, speed, speed, 1e-5, speed])
    return _Track(number, np.concatenate([box, np.zeros(4)]), np.diag(deviations**2), score)


def _predict(track: _Track) -> None:
    """Predict a track one frame later; one that was not seen does not grow."""
    track.unseen += 1
    if track.unseen > 1:
        track.mean[7] = 0
    place, speed = _PLACE * track.mean[3], _SPEED * track.mean[3]
    noise = np.diag(np.array([place, place, 1e-2, place, speed, speed, 1e-5, speed]) ** 2)
    step = np.eye(8) + np.eye(8, k=4)
    track.mean = step @ track.mean
    track.covariance = step @ track.covariance @ step.T + noise


def _update(track: _Track, box: _Floats, score: float) -> None:
    """Update a track by a detection."""
    place = _PLACE * track.mean[3]
    noise = np.diag(np.array([place, place, 1e-1, place]) ** 2)
    gain = np.linalg.solve(track.covariance[:4, :4] + noise, track.covariance[:4]).T
    track.mean = track.mean + gain @ (box - track.mean[:4])
    track.covariance = track.covariance - gain @ track.covariance[:4]
    track.score, track.unseen, track.is_confirmed = score, 0, True


def _as_measured(boxes: _Floats) -> _Floats:
    """Convert boxes `(N, 4)` to centres, shapes and heights `(N, 4)`."""
    x1, y1, x2, y2 = boxes.T
    high = np.maximum(y2 - y1, 1e-6)
    return np.stack([(x1 + x2) / 2, (y1 + y2) / 2, (x2 - x1) / high, high], -1)


def _corners(measured: _Floats) -> _Floats:
    """Convert centres, shapes and heights `(N, 4)` to boxes `(N, 4)`."""
    x, y, shape, high = measured.T
    return np.stack([x - shape * high / 2, y - high / 2, x + shape * high / 2, y + high / 2], -1)
