"""Patches of a frame that are followed into the next one, each by a motion of its own, as objects have it.

    frame before:  a box with its surroundings ──► tile ──┐
                                                          ├── flow of the tile's middle ──► where the box is now
    next frame:    where the box is expected  ───► tile ──┘

All tiles have one size, so that one call of the flow follows small objects and large ones, and each by its whole box.
"""

from functools import cached_property
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semfov.errors import needing
from semfov.motion.frames import reduced_grey

_Bytes = NDArray[np.uint8]
_Floats = NDArray[np.float64]
_Points = NDArray[np.float32]

_LONGER = 960  # most pixels of the longer side of the copies of frames in which patches are followed
_TILE = 32  # side of a tile in its own pixels
_AT_ONCE = 512  # most tiles one below the other: OpenCV resamples to less than 32,767 rows
_SURROUNDINGS = 2  # sides of a tile in those of its box
_MIDDLE = slice(_TILE // 4, 3 * _TILE // 4)  # rows or columns of a tile that its box fills
_WINDOW = (15, 15)  # window of the flow in pixels of a tile: nearly all of the box
_PYRAMID = 1  # further levels of the flow's pyramid
_STEPS = 10  # most steps of the flow at a level, which end below the next number
_LEAST_STEP = 0.03  # pixels of a tile
_SMALLEST = 4.0  # pixels: least side of a box
_FARTHEST = 12.0  # pixels of a tile by which a patch may be off where it is expected: beyond, it leaves the tile
_BACK = 0.5  # pixels of a tile within which the flow back ends at the patch
_OFF = 0.5  # share of its contrast by which a patch may have changed: two that have nothing in common differ by 1.4
_LEAST_CONTRAST = 3.0  # least mean difference of a patch from its mean, in grey values


class FollowedPatches(NamedTuple):
    """Where patches are in the next frame.

    Attributes:
        places: `(N, 2)`, the centres of their boxes in pixels; those that were not followed are where they were
            expected.
        are_followed: `(N,)` boolean, those that were followed.
        changes: `(N,)`, how much those have changed, as a share of their contrast; infinite for the others.
    """

    places: _Floats
    are_followed: NDArray[np.bool_]
    changes: _Floats


class _Copy(NamedTuple):
    """A frame reduced in size and to grey, `(h, w)` bytes, and `(x, y)`, pixels of the frame for one of it."""

    grey: _Bytes
    ratio: _Floats


class _Frame:
    """A frame, whose copy is made when a patch is followed: no other frame takes its time."""

    def __init__(self, cv2: ModuleType, pixels: _Bytes) -> None:
        self._cv2 = cv2
        self._pixels = pixels

    @cached_property
    def copy(self) -> _Copy:
        """The frame, reduced."""
        grey, ratio = reduced_grey(self._cv2, self._pixels, _LONGER)
        return _Copy(grey, np.array(ratio))


class PatchFlow:
    """Follows the boxes of objects from one frame to the next by pyramidal Lucas–Kanade flow (Bouguet, 2001).

    A box is left out if the border of a frame cuts it, if it has too little contrast, if the flow back into the frame
    before does not end where it began (Kalal et al., 2010), or if its patch looks otherwise than before, as where it is
    hidden.

    Private attributes: `_before` and `_present` are the last two frames, None before they were shown.

    Raises:
        InputError: OpenCV is not installed.
    """

    def __init__(self) -> None:
        with needing("OpenCV", "motion of objects", "opencv-python-headless"):
            import cv2
        self._cv2: ModuleType = cv2
        self._before: _Frame | None = None
        self._present: _Frame | None = None

    def step(self, frame: _Bytes) -> None:
        """Take the next frame, which must stay as it is until the one after the next is taken.

        Args:
            frame: `(h, w, 3)` bytes, or `(h, w)` of a grey one.
        """
        self._before = self._present
        self._present = _Frame(self._cv2, frame)

    def follow(self, boxes: _Floats, expected: _Floats) -> FollowedPatches:
        """Follow boxes from the frame before into the present one.

        Args:
            boxes: `(N, 4)`, `(x1, y1, x2, y2)` in pixels of the frame before.
            expected: `(N, 2)`, where their centres are expected in the present frame.

        Returns:
            Where they are.
        """
        places = expected.copy()
        changes = np.full(len(boxes), np.inf)
        if self._before is None or self._present is None or not len(boxes):
            return FollowedPatches(places, np.isfinite(changes), changes)
        before = self._before.copy
        present = self._present.copy
        if before.grey.shape != present.grey.shape:
            return FollowedPatches(places, np.isfinite(changes), changes)
        ratio = present.ratio
        centres = (boxes[:, :2] + boxes[:, 2:]) / 2 / ratio
        sides = (boxes[:, 2:] - boxes[:, :2]) / ratio
        guesses = expected / ratio
        size = np.array(present.grey.shape[::-1])
        is_whole = _lie_inside(centres, sides, size) & _lie_inside(guesses, sides, size)
        rows = np.flatnonzero(is_whole & (sides >= _SMALLEST).all(-1))
        for start in range(0, len(rows), _AT_ONCE):
            part = rows[start : start + _AT_ONCE]
            ends, changes[part] = self._flow(before.grey, present.grey, centres[part], sides[part], guesses[part])
            is_followed = np.isfinite(changes[part])
            places[part[is_followed]] = (ends * ratio)[is_followed]
        return FollowedPatches(places, np.isfinite(changes), changes)

    def _flow(
        self, before: _Bytes, present: _Bytes, centres: _Floats, sides: _Floats, guesses: _Floats
    ) -> tuple[_Floats, _Floats]:
        """Follow boxes that both frames show, in their pixels; returns their centres and changes, infinite for none."""
        steps = sides * (_SURROUNDINGS / _TILE)  # pixels of the frame for one of a tile
        first = self._tiles(before, centres, steps)
        second = self._tiles(present, guesses, steps)
        # The middles of the tiles, one below the other: where boxes are, and where they are expected.
        middles = np.full((len(sides), 2), (_TILE - 1) / 2, np.float32)
        middles[:, 1] += _TILE * np.arange(len(sides))
        ends, is_found, change = self._followed(first, second, middles, middles)
        back, is_found_back, _ = self._followed(second, first, ends, ends)
        shifts = ends - middles
        contrast = _contrast(first)
        is_near = np.abs(shifts).max(-1) < _FARTHEST
        share = change / np.maximum(contrast, _LEAST_CONTRAST)
        is_same = (np.linalg.norm(back - middles, axis=-1) < _BACK) & (share < _OFF)
        are_followed = is_found & is_found_back & is_near & is_same & (contrast >= _LEAST_CONTRAST)
        return guesses + shifts * steps, np.where(are_followed, share, np.inf)

    def _tiles(self, frame: _Bytes, centres: _Floats, steps: _Floats) -> _Bytes:
        """Resample parts of a frame, with some of its pixels for one of a tile `(N, 2)`, to tiles, `(32 N, 32)`."""
        count = len(centres)
        offsets = np.arange(_TILE) - (_TILE - 1) / 2
        # The centre of the first pixel of a frame is 0 for OpenCV.
        x, y = ((centres - 0.5)[:, :, None] + steps[:, :, None] * offsets).astype(np.float32).transpose(1, 0, 2)
        across = np.broadcast_to(x[:, None], (count, _TILE, _TILE)).reshape(-1, _TILE)
        down = np.broadcast_to(y[:, :, None], (count, _TILE, _TILE)).reshape(-1, _TILE)
        cv2 = self._cv2
        tiles = cv2.remap(frame, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(tiles, np.uint8)

    def _followed(
        self, first: _Bytes, second: _Bytes, begin: _Points, guess: _Points
    ) -> tuple[_Points, NDArray[np.bool_], _Points]:
        """Follow a point of each tile: where it is, whether it was found, and how much its window has changed."""
        cv2 = self._cv2
        end, status, change = cv2.calcOpticalFlowPyrLK(
            first,
            second,
            begin[:, None],
            guess[:, None].copy(),
            winSize=_WINDOW,
            maxLevel=_PYRAMID,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _STEPS, _LEAST_STEP),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return end[:, 0], status[:, 0] == 1, change[:, 0]


def _lie_inside(centres: _Floats, sides: _Floats, size: NDArray[np.int_]) -> NDArray[np.bool_]:
    """Tell which boxes lie in a frame of a size `(width, height)`, `(N,)`."""
    return np.asarray(((centres - sides / 2 >= 0) & (centres + sides / 2 <= size)).all(-1))


def _contrast(tiles: _Bytes) -> _Floats:
    """Mean difference of the middle of each tile from its mean, in grey values, `(N,)`."""
    middles = tiles.reshape(-1, _TILE, _TILE)[:, _MIDDLE, _MIDDLE].astype(np.float64)
    return np.asarray(np.abs(middles - middles.mean((1, 2), keepdims=True)).mean((1, 2)))
