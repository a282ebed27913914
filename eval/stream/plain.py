"""The plainest memory that moves: one native window a frame, by time unseen and expectation, in places of the scene."""

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from eval.stream.flights import Frame
from eval.stream.ways import Way
from semfov.detection.objects import Objects
from semfov.detection.selection import Selection, suppress
from semfov.motion import CameraMotion, Motion
from semfov.observation.matching import inside_frame
from semfov.zoom.eye import WindowEye
from semfov.zoom.looks import LiveWindowLooks, Window

_CELL, _CELLS = 52, 160  # side of a cell of the scene in pixels of the first frame, and cells in a row and a column
_PLACES = 8, 5  # columns and rows of the places of a window in a frame
_POINTS, _MARGIN = 8, 40  # points in a row of a window at which the scene's cells are read, and their border in pixels
_COVERED = 30  # pixels inside a window from which on what was known there is replaced
_FADING = 24.0  # frames
_WHOLE = 16  # each of so many frames is looked at as a whole
_EXPECTED, _LOOKED_AT = 0.02, 0.01  # expectation at first, and after a look
_FAINTEST = 0.05
_RIVALS = Selection(threshold=0.0, iou=0.5, limit=10_000)


class PlainRule(Way):
    """Boxes, expectations and the time of the last look at places of the scene, which the camera's pose carries along.

    Every sixteenth frame is looked at as a whole, and any other by one window. What a look covers replaces what was
    known there. Where the camera loses the scene, all is forgotten.
    """

    def __init__(self, eye: WindowEye, target: int) -> None:
        super().__init__(eye, target)
        self.camera = CameraMotion()
        self.number = -1
        self._begin()

    def _begin(self) -> None:
        self.pose = Motion.still()  # from the scene, which is the first frame, to the present one
        self.expected = np.full((_CELLS, _CELLS), _EXPECTED)
        self.seen = np.full((_CELLS, _CELLS), -np.inf)
        self.boxes, self.scores = torch.zeros(0, 4), torch.zeros(0)  # in pixels of the scene
        self.began = self.number

    def step(self, frame: Frame) -> Mapping[str, Objects]:
        self.number += 1
        motion = self.camera.step(frame.pixels).motion
        if motion is None:
            self._begin()
        else:
            self.pose = self.pose.then(motion)
        source = self.looks_at(frame)
        if (self.number - self.began) % _WHOLE == 0:
            self._look_at_all(source)
        else:
            self._look_closely(source)
        boxes = self.pose.boxes(self.boxes)
        kept = suppress(boxes, self.scores, torch.zeros(len(boxes)), _RIVALS)
        self.boxes, self.scores = self.boxes[kept], self.scores[kept]
        number = torch.zeros(len(kept), dtype=torch.long)
        objects = Objects(boxes[kept], self.scores, torch.full_like(number, self.target), number)
        return {"plain rule": objects[inside_frame(objects.boxes, source.lattice.size)]}

    def _look_at_all(self, source: LiveWindowLooks) -> None:
        """Look at the whole frame: what it shows is expected around its place."""
        boxes, scores = self._see(source, Window.overview(source.lattice))
        for (row, column), score in zip(self._cells(centres(boxes)), scores.tolist(), strict=True):
            around = self.expected[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
            around[:] = np.maximum(around, min(0.5, _EXPECTED + score))
        self._remember(boxes, scores)

    def _look_closely(self, source: LiveWindowLooks) -> None:
        """Look at the window that promises most, in place of what is known there."""
        side = float(min(source.lattice.canvas))
        x, y = self._best_place(source.lattice.size, side)
        boxes, scores = self._see(source, Window.around(source.lattice, (x, y, x + side, y + side)))
        rows, columns = self._cells(_points(x, y, side)).T
        self.seen[rows, columns] = self.number
        self.expected[rows, columns] = _LOOKED_AT
        known = centres(self.pose.boxes(self.boxes)) - torch.tensor([x, y])
        covered = ((known > _COVERED) & (known < side - _COVERED)).all(-1)
        self.boxes, self.scores = self.boxes[~covered], self.scores[~covered]
        for (row, column), score in zip(self._cells(centres(boxes)), scores.tolist(), strict=True):
            self.expected[row, column] = max(self.expected[row, column], 0.3 * score)
        self._remember(boxes, scores)

    def _best_place(self, size: tuple[int, int], side: float) -> tuple[float, float]:
        """Upper left corner of the window with the largest sum of (1 - exp(-unseen / 24)) · expected."""
        promise = (1 - np.exp((self.seen - self.number) / _FADING)) * self.expected
        columns, rows = (np.linspace(0, last, count) for last, count in zip(_rest(size, side), _PLACES, strict=True))
        places = [(float(int(x)), float(int(y))) for y in rows for x in columns]

        def value(place: tuple[float, float]) -> float:
            rows, columns = self._cells(_points(*place, side)).T
            return float(promise[rows, columns].sum())

        return max(places, key=value)

    def _see(self, source: LiveWindowLooks, window: Window) -> tuple[Tensor, Tensor]:
        """Boxes `(N, 4)` in the frame that no border of a window cuts, and their scores `(N,)`."""
        (look,) = source.see([window], hints=False)
        scores = look.detections.class_scores[0, :, self.target - 1]
        kept = ~look.cut & (scores > _FAINTEST)
        return look.detections.boxes[0, kept].float(), scores[kept].float()

    def _remember(self, boxes: Tensor, scores: Tensor) -> None:
        self.boxes = torch.cat([self.boxes, self.pose.inverse().boxes(boxes)])
        self.scores = torch.cat([self.scores, scores])

    def _cells(self, points: Tensor) -> NDArray[np.intp]:
        """Rows and columns `(N, 2)` of the scene's cells at points `(N, 2)` of the frame."""
        there = self.pose.inverse().points(points.double()).numpy() // _CELL + _CELLS // 2
        return there[:, ::-1].clip(0, _CELLS - 1).astype(np.intp)


def centres(boxes: Tensor) -> Tensor:
    """Centres `(N, 2)` of boxes `(N, 4)`."""
    return (boxes[:, :2] + boxes[:, 2:]) / 2


def _points(x: float, y: float, side: float) -> Tensor:
    """Points `(N, 2)` of a window at which the cells of the scene are read."""
    line = torch.linspace(_MARGIN, side - _MARGIN, _POINTS, dtype=torch.float64)
    return torch.cartesian_prod(line, line) + torch.tensor([x, y])


def _rest(size: tuple[int, int], side: float) -> tuple[float, float]:
    return max(size[0] - side, 0), max(size[1] - side, 0)
