"""Frames as the motion of a camera is estimated from them: small and grey, with corners to follow."""

import math
from functools import cached_property
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

_LONGER = 480  # most pixels of the longer side of the reduced frames
_CORNERS = 150  # most corners that are followed
_QUALITY = 0.01  # least quality of a corner, as a share of the best one's
_APART = 8  # least distance between two corners, in reduced pixels

_AROUND = 21  # side of the square about a pixel whose mean is taken off, in reduced pixels
_CLIP = 10  # largest contrast in grey values: a few bright pixels count no more than many others
_MIDDLE = 128  # byte of no contrast

_REPEAT = 0.5  # autocorrelation from which on a picture repeats itself
_LOBE = 4  # reduced pixels about no shift where every picture is like itself
_MOST_REPEATS = 2


class GreyFrame:
    """A frame reduced in size and to grey.

    Attributes:
        grey: `(h, w)` bytes.
        ratio: `(x, y)`, pixels of the frame for one of the reduced one.
    """

    def __init__(self, cv2: ModuleType, frame: NDArray[np.uint8]) -> None:
        self._cv2 = cv2
        self.grey, self.ratio = reduced_grey(cv2, frame, _LONGER)

    @cached_property
    def corners(self) -> NDArray[np.float32]:
        """Corners that can be followed (Shi and Tomasi, 1994), `(n, 1, 2)`."""
        return self.corners_in(None)

    def corners_in(self, part: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        """Find the corners in a part of the frame `(h, w)`, where it is not 0; None for all of it."""
        corners = self._cv2.goodFeaturesToTrack(self.grey, _CORNERS, _QUALITY, _APART, mask=part)
        return np.zeros((0, 1, 2), np.float32) if corners is None else corners

    @cached_property
    def contrast(self) -> NDArray[np.uint8]:
        """Differences from the mean of the surroundings, clipped, `(h, w)` bytes.

        Every part of a frame counts nearly alike in it. So writing on a film or bright pixels of a sensor, which stay
        where they are, do not outweigh a scene that moves.
        """
        cv2 = self._cv2
        mean = cv2.blur(self.grey, (_AROUND, _AROUND))
        difference = cv2.addWeighted(self.grey, 1, mean, -1, _MIDDLE)
        return np.asarray(cv2.max(cv2.min(difference, _MIDDLE + _CLIP), _MIDDLE - _CLIP), np.uint8)

    @cached_property
    def coarse(self) -> NDArray[np.uint8]:
        """What is left without fine detail, so that a motion that is off by some pixels changes little."""
        return np.asarray(self._cv2.blur(self.grey, (_AROUND, _AROUND)), np.uint8)

    @cached_property
    def repeats(self) -> list[NDArray[np.float64]]:
        """Shifts `(x, y)` in reduced pixels by which the frame looks much like itself, as bricks and stripes do.

        They are the highest peaks of the circular autocorrelation of the contrast, which is the Fourier transform of
        its power spectrum (Wiener–Khinchin theorem).
        """
        cv2 = self._cv2
        height, width = self.grey.shape
        # The correlation is circular: zeros keep shifts of up to a quarter from meeting the other side.
        rows = cv2.getOptimalDFTSize(height + height // 4)
        columns = cv2.getOptimalDFTSize(width + width // 4)
        padded = np.zeros((rows, columns), np.float32)
        padded[:height, :width] = self.contrast
        # With another mean than 0 a frame would be like itself after any shift.
        padded[:height, :width] -= padded[:height, :width].mean()
        # Spectra of real numbers are symmetric, so that half of them is enough.
        spectrum = cv2.dft(padded, nonzeroRows=height)
        power = cv2.mulSpectrums(spectrum, spectrum, 0, conjB=True)
        correlation = cv2.dft(power, flags=cv2.DFT_INVERSE)
        if correlation[0, 0] <= 0:
            return []
        # Of a shift and its opposite one is enough: the half below, with no shift in the middle of its first row.
        half = np.roll(correlation[: rows // 2], columns // 2, axis=1) / correlation[0, 0]
        peaks = (half >= cv2.dilate(half, np.ones((3, 3)))) & (half >= _REPEAT)
        down, across = peaks.nonzero()
        across = across - columns // 2
        beyond = np.hypot(down, across) > _LOBE
        order = half[peaks][beyond].argsort()[::-1][:_MOST_REPEATS]
        return [np.array([across[beyond][n], down[beyond][n]], np.float64) for n in order]


def in_grey(cv2: ModuleType, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert a frame `(h, w, 3)` to grey, `(h, w)` bytes; a grey one stays as it is."""
    return frame if frame.ndim == 2 else np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), np.uint8)


def reduced_grey(
    cv2: ModuleType, frame: NDArray[np.uint8], longer: int
) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Reduce a frame by whole pixels, and to grey.

    Args:
        cv2: OpenCV.
        frame: `(h, w, 3)` bytes, or `(h, w)` of a grey one.
        longer: most pixels of the longer side of the copy.

    Returns:
        The copy, and `(x, y)`, pixels of the frame for one of it.
    """
    # A third of the values is left to average where the frame is grey first.
    full = in_grey(cv2, frame)
    height, width = full.shape
    factor = max(1, math.ceil(max(width, height) / longer))
    size = max(1, width // factor), max(1, height // factor)
    # Means of whole pixels take a fifth of the time of others; a rest at the right and below is left out.
    shown = full[: size[1] * factor, : size[0] * factor]
    ratio = shown.shape[1] / size[0], shown.shape[0] / size[1]
    return cv2.resize(shown, size, interpolation=cv2.INTER_AREA), ratio
