"""How corners of one frame moved to another, and the similarities that describe it."""

from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from semfov.motion.frames import GreyFrame

_STILL = np.eye(3)
_WINDOW = (15, 15)  # window of the flow around a corner, in reduced pixels
_PYRAMID = 3  # further levels of the flow's pyramid: it follows shifts of about 15 · 2³ reduced pixels
_NEAR = 1  # the same where the motion is likely to be nearly the expected one, in half of the time
_SURE = 0.8  # share of the followed corners that agree from which on the near levels are enough
_RESIDUAL = 1.5  # reduced pixels within which a corner agrees with a motion

LEAST_CORNERS = 12
"""Fewer corners that agree are no evidence."""
_NEARLY_ALL = 0.95  # least share of the corners that stay before a camera that stands still
_LEAST_SHARE = 0.4  # least share of the followed corners that agree
_RIVALS = 6  # least number of corners of a rival
_RIVAL_SHIFT = 1.5  # reduced pixels by which a rival moves its corners otherwise
_MOST_SCALE = 1.3  # largest change of scale between two frames
_MOST_TURN = 25.0  # largest turn between two frames, in degrees


def flow_between(
    cv2: ModuleType, first: GreyFrame, second: GreyFrame, guess: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Follow the corners of a frame into another one, and fit a similarity to them by RANSAC.

    Args:
        cv2: OpenCV.
        first: the frame whose corners are followed.
        second: the other one.
        guess: `(3, 3)`, the motion from which the search for the corners begins; near it fewer levels are enough.

    Returns:
        `(3, 3)`, maps pixels of the first frame to those of the second; None where too few corners agree with it, or it
        is a leap of scale or turn.
    """
    if first.grey.shape != second.grey.shape or len(first.corners) < LEAST_CORNERS:
        return None
    for levels, least_share in ((_NEAR, _SURE), (_PYRAMID, _LEAST_SHARE)):
        before, after = _followed(cv2, first.corners, first, second, guess, levels)
        if len(before) < LEAST_CORNERS:
            continue
        similarity, agree = _fit(cv2, before, after)
        has_support = agree.sum() >= max(LEAST_CORNERS, least_share * len(before))
        if has_support and _is_plausible(similarity):
            return similarity
    return None


def corners_stay(cv2: ModuleType, first: GreyFrame, second: GreyFrame, most: float) -> bool:
    """Tell whether nearly all corners of a frame are still there in another one, in a quarter of the flow's time.

    Args:
        cv2: OpenCV.
        first: the frame whose corners are followed.
        second: the other one.
        most: largest shift of a corner that stays, in reduced pixels.

    Returns:
        False also where there are too few corners.
    """
    if first.grey.shape != second.grey.shape or len(first.corners) < LEAST_CORNERS:
        return False
    before, after = _followed(cv2, first.corners, first, second, _STILL, levels=0)
    stays = np.linalg.norm(after - before, axis=-1) < most
    return int(stays.sum()) >= _NEARLY_ALL * len(first.corners)


def rival_between(
    cv2: ModuleType,
    first: GreyFrame,
    second: GreyFrame,
    similarity: NDArray[np.float64],
    part: NDArray[np.uint8],
) -> NDArray[np.float64] | None:
    """Find the motion that corners have in common in a part of a frame that does not move as the rest does.

    Args:
        cv2: OpenCV.
        first: the frame before.
        second: the frame after it.
        similarity: `(3, 3)`, the motion of the rest.
        part: `(h, w)` bytes, not 0 in that part of the second frame.

    Returns:
        Likewise, the motion of the part; None where it has none of its own.
    """
    corners = second.corners_in(part)
    if len(corners) < _RIVALS:
        return None
    # Backwards, since the part is one of the second frame.
    after, before = _followed(cv2, corners, second, first, _STILL, _PYRAMID)
    if len(after) < _RIVALS:
        return None
    rival, agree = _fit(cv2, before, after)
    if agree.sum() < max(_RIVALS, _LEAST_SHARE * len(before)) or not _is_plausible(rival):
        return None
    difference = cv2.transform(before[agree], (rival - similarity)[:2])
    return rival if np.linalg.norm(difference, axis=-1).mean() >= _RIVAL_SHIFT else None


def _followed(
    cv2: ModuleType,
    corners: NDArray[np.float32],
    first: GreyFrame,
    second: GreyFrame,
    guess: NDArray[np.float64],
    levels: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Follow corners `(n, 1, 2)` of a frame into another one; returns those that were found, there and here."""
    expected = cv2.transform(corners, guess[:2]).astype(np.float32)
    places, status, _ = cv2.calcOpticalFlowPyrLK(
        first.grey,
        second.grey,
        corners,
        expected,
        winSize=_WINDOW,
        maxLevel=levels,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    found = status[:, 0] == 1
    return corners[found], places[found]


def _fit(
    cv2: ModuleType, before: NDArray[np.float32], after: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Fit a similarity `(3, 3)` to corners `(n, 1, 2)`; returns it, and which of them agree with it."""
    similarity, agree = cv2.estimateAffinePartial2D(before, after, ransacReprojThreshold=_RESIDUAL)
    if similarity is None:
        return _STILL, np.zeros(len(before), bool)
    return np.vstack([similarity, _STILL[2]]), agree[:, 0].astype(bool)


def _is_plausible(similarity: NDArray[np.float64]) -> bool:
    """Tell whether a similarity is no leap of scale or turn."""
    scale = float(np.hypot(similarity[0, 0], similarity[1, 0]))
    turn = float(np.degrees(np.arctan2(similarity[1, 0], similarity[0, 0])))
    return 1 / _MOST_SCALE <= scale <= _MOST_SCALE and abs(turn) <= _MOST_TURN
