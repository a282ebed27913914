"""Closer looks of a search by windows: the windows that show a place closely."""

from torch import Tensor

from semfov.sensor.glimpse import CONTEXT, window_around
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook, WindowLooks

# A smaller window shows the place equally well, but fewer other places.
USUAL_WINDOW = 0.6, 2.0
"""Least side of that window in a photograph, in longer sides of the photograph, and its side in those of the box."""

MOST_IN_PHOTOGRAPH = 3
"""Default for the largest number of closer looks in a photograph: more would go to the objects of a crowd."""


def closer_window(lattice: Lattice, box: Tensor, window: tuple[float, float] = USUAL_WINDOW) -> Window:
    """Choose the window of a closer look around a box.

    Args:
        lattice: windows of the picture.
        box: `(4,)` in picture pixels.
        window: least side and context of the window in a photograph (`USUAL_WINDOW`). In a larger picture it has three
            times the longer side of the box, and at least half of the closest window.

    Returns:
        The window.
    """
    least, context = window
    if lattice.levels > 1:
        context = CONTEXT
        # At most one octave beyond the last level: such windows told right places from wrong ones best.
        least = min(lattice.canvas) / (2 * lattice.magnifications[-1]) / max(lattice.size)
    x1, y1, x2, y2 = window_around(box.double(), lattice.size, context=context, least=least).tolist()
    return Window.around(lattice, (x1, y1, x2, y2))


def look_closely(source: WindowLooks, box: Tensor, window: tuple[float, float] = USUAL_WINDOW) -> WindowLook:
    """Look at the window that shows a box closely (`closer_window`).

    Args:
        source: looks at the picture.
        box: `(4,)` in picture pixels.
        window: size of the window in a photograph.

    Returns:
        The look.
    """
    return source.see([closer_window(source.lattice, box, window)])[0]
