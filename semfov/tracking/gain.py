"""Value of a look at a window for known objects that may have moved: it finds their places again."""

import numpy as np
from numpy.typing import NDArray

from semfov.tracking.model import TrackingModel
from semfov.tracking.tracks import Tracks
from semfov.zoom.lattice import Lattice


def value_of_windows(tracks: Tracks, model: TrackingModel, lattice: Lattice, level: int) -> NDArray[np.float32]:
    r"""Compute how many objects a look at each window of a level is expected to put right.

    An object is put right if it is there, the look shows it, and its box, or what is known of it, does not fit it any
    more. With the probability p that it is there, f that its box fits, and d that a look shows it, an object counts
    t seconds after the last look that showed it, with a rate r (`TrackingModel.staleness`), for

    .. math:: p \, d \, \bigl(1 - f \, e^{-rt}\bigr)

    Flow keeps the boxes of objects that stand still, so that without r none of them would be looked at again. A window
    counts for the objects whose boxes lie in it.

    Args:
        tracks: the objects, in pixels of the present frame.
        model: what is assumed of looks.
        lattice: the windows.
        level: level of the windows.

    Returns:
        `(down, across)`, in objects.
    """
    across, down = lattice.places(level)
    values = np.zeros((down, across), np.float32)
    shown = model.detects(tracks.sides * lattice.magnifications[level])
    gains = tracks.existence * shown * (1 - tracks.fits * np.exp(-model.staleness * tracks.unseen))
    # The first and the last window that hold a box: they start at a cell before it, and end at one after it.
    pitch = np.array(lattice.pitch)
    span = lattice.span(level)
    first = np.ceil(tracks.corners[:, 2:] / pitch).astype(int) - span
    last = np.floor(tracks.corners[:, :2] / pitch).astype(int)
    for gain, (x1, y1), (x2, y2) in zip(gains, first.clip(0), last, strict=True):
        # Beyond the first cell no window holds a box, and negative ends would count from the other side.
        if x2 >= 0 and y2 >= 0:
            values[y1 : y2 + 1, x1 : x2 + 1] += gain
    return values
