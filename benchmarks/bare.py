"""YOLOX as its users run it without a library: onnxruntime, OpenCV's letterbox, and its suppression of boxes.

It is what looks are timed against: the shortest honest loop of public libraries, without semfov.
"""

from collections.abc import Callable, Sequence
from os import PathLike, fspath
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
"""A picture, RGB `(H, W, 3)`."""

Boxes = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]
"""Corners `(N, 4)` in pixels of the picture, scores `(N,)` and classes `(N,)`."""

_GREY = 114  # of the padding
_STRIDES = (8, 16, 32)


class BareYolox:
    """YOLOX in a loop of onnxruntime and OpenCV.

    Args:
        path: the ONNX file, which takes BGR from 0 to 255 and returns cells before their places are added.
        threads: threads of onnxruntime.
        least: score from which on a box counts.
        overlap: intersection over union from which on the box with the lower score goes.
    """

    def __init__(self, path: str | PathLike[str], threads: int, least: float = 0.1, overlap: float = 0.45) -> None:
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        self._session = ort.InferenceSession(fspath(path), options, providers=["CPUExecutionProvider"])
        (entry,) = self._session.get_inputs()
        self._name = entry.name
        self.side = int(entry.shape[2])
        self.least = least
        self.overlap = overlap
        self._places, self._steps = _cells(self.side)

    def __call__(self, picture: Pixels) -> Boxes:
        """Detect the objects of a picture."""
        canvas, scale = self.letterbox(picture)
        # As YOLOX's own demo converts it: BGR, channels first, floating point.
        entry = np.ascontiguousarray(canvas[:, :, ::-1].transpose(2, 0, 1), dtype=np.float32)[None]
        (rows,) = self._session.run(None, {self._name: entry})
        return self._selected(rows[0], scale)

    def letterbox(self, picture: Pixels) -> tuple[Pixels, float]:
        """Fit a picture into the canvas, with padding on the right and below; also the scale."""
        height, width = picture.shape[:2]
        scale = min(self.side / height, self.side / width)
        size = round(width * scale), round(height * scale)
        small = cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR)
        canvas = np.full((self.side, self.side, 3), _GREY, dtype=np.uint8)
        canvas[: size[1], : size[0]] = small
        return canvas, scale

    def _selected(self, rows: NDArray[np.float32], scale: float) -> Boxes:
        """Decode the rows of the cells, and keep the best of boxes that overlap, class by class."""
        scores = rows[:, 5:] * rows[:, 4:5]
        classes = scores.argmax(1)
        best = scores[np.arange(len(scores)), classes]
        kept = best >= self.least
        centres = (rows[kept, :2] + self._places[kept]) * self._steps[kept]
        sizes = np.exp(rows[kept, 2:4]) * self._steps[kept]
        corners = (centres - sizes / 2) / scale
        boxes = np.concatenate([corners, sizes / scale], 1)
        best, classes = best[kept], classes[kept]
        best_first = cv2.dnn.NMSBoxesBatched(boxes.tolist(), best.tolist(), classes.tolist(), self.least, self.overlap)
        chosen = np.asarray(best_first, dtype=np.int64).reshape(-1)
        boxes = boxes[chosen]
        boxes[:, 2:] += boxes[:, :2]
        return boxes, best[chosen], classes[chosen]


def _cells(side: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """List the column and row of each cell, and the pixels of its side."""
    places: list[Any] = []
    steps: list[Any] = []
    for stride in _STRIDES:
        count = side // stride
        columns, rows = np.meshgrid(np.arange(count), np.arange(count))
        places.append(np.stack([columns, rows], 2).reshape(-1, 2))
        steps.append(np.full((count * count, 1), stride))
    return np.concatenate(places).astype(np.float32), np.concatenate(steps).astype(np.float32)


def bare_looks(detector: BareYolox, picture: Pixels, windows: Sequence[Sequence[float]]) -> Callable[[], list[Boxes]]:
    """Make the loop over windows of a picture that is in memory.

    Args:
        detector: the detector.
        picture: the picture.
        windows: `x1 y1 x2 y2` of each, in pixels.

    Returns:
        A program that looks at all of them.
    """
    height, width = picture.shape[:2]
    places = []
    for x1, y1, x2, y2 in windows:
        left, top = max(int(x1), 0), max(int(y1), 0)
        places.append((slice(top, min(round(y2), height)), slice(left, min(round(x2), width))))

    def run() -> list[Boxes]:
        return [detector(picture[rows, columns]) for rows, columns in places]

    return run
