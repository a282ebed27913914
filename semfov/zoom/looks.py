"""Windows of a picture, and the results of looks at them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.motion import CameraStep
from semfov.zoom.eye import Resampled, WindowDetections, WindowEye, WindowView
from semfov.zoom.hints import Gist, Hints
from semfov.zoom.lattice import Lattice


def nearest_cells(lattice: Lattice, box: tuple[float, float, float, float]) -> tuple[int, int, int, int]:
    """Round the edges of a box in picture pixels to those of cells.

    Args:
        lattice: the cells.
        box: `(x1, y1, x2, y2)` in picture pixels.

    Returns:
        Cells `(x1, y1, x2, y2)`.
    """
    x1, y1, x2, y2 = box
    width, height = lattice.pitch
    return round(x1 / width), round(y1 / height), round(x2 / width), round(y2 / height)


@dataclass(frozen=True)
class Window:
    """A window of a picture: where to look, and how closely.

    Attributes:
        fixation: `(x, y, magnification)`, its centre in picture pixels, and canvas pixels per picture pixel.
        level: level of the lattice with that magnification, or the nearest one.
        cells: cells `(x1, y1, x2, y2)` that it shows, rounded.
        within: box of the picture that it shows and nothing beyond; None for a window of the lattice.
    """

    fixation: tuple[float, float, float]
    level: int
    cells: tuple[int, int, int, int]
    within: tuple[float, float, float, float] | None = None

    @staticmethod
    @lru_cache(4096)
    def on(lattice: Lattice, action: tuple[int, int, int]) -> "Window":
        """Make the window with an index `(level, column, row)`, which is cached for the next call."""
        level, column, row = action
        x, y, magnification = lattice.fixation(level, column, row)
        span = lattice.span(level)
        return Window((x, y, magnification), level, (column, row, column + span, row + span))

    @staticmethod
    def overview(lattice: Lattice) -> "Window":
        return Window.on(lattice, (0, 0, 0))

    @property
    def is_overview(self) -> bool:
        """Whether the window is the lattice's window of the whole picture."""
        return self.level == 0 and self.within is None

    @staticmethod
    def around(lattice: Lattice, box: tuple[float, float, float, float]) -> "Window":
        """Make the window that shows exactly a box of the picture, at the largest magnification that fits."""
        x1, y1, x2, y2 = box
        canvas_width, canvas_height = lattice.canvas
        magnification = min(canvas_width / (x2 - x1), canvas_height / (y2 - y1))

        def difference(level: int) -> float:
            return abs(lattice.magnifications[level] / magnification - 1)

        level = min(range(lattice.levels), key=difference)
        fixation = (x1 + x2) / 2 - 0.5, (y1 + y2) / 2 - 0.5, magnification
        return Window(fixation, level, nearest_cells(lattice, box), box)

    def region(self, lattice: Lattice) -> tuple[float, float, float, float]:
        """Part of the picture that the window shows, `(x1, y1, x2, y2)` in picture pixels."""
        x1, y1, x2, y2 = self._edges(lattice) if self.within is None else self.within
        width, height = lattice.size
        # A camera that moves carries windows beyond the frame.
        return max(x1, 0.0), max(y1, 0.0), min(x2, float(width)), min(y2, float(height))

    def _edges(self, lattice: Lattice) -> tuple[float, float, float, float]:
        """Edges `(x1, y1, x2, y2)` of a window of the lattice in picture pixels, which may lie beyond the picture."""
        x, y, magnification = self.fixation
        # Half of the window, about its centre in edges of pixels.
        half_width = lattice.canvas[0] / magnification / 2
        half_height = lattice.canvas[1] / magnification / 2
        x += 0.5
        y += 0.5
        return x - half_width, y - half_height, x + half_width, y + half_height

    def centre(self, lattice: Lattice) -> tuple[float, float]:
        """Centre `(x, y)` of the part of the window that lies in the picture, in picture pixels."""
        x1, y1, x2, y2 = self.region(lattice)
        return (x1 + x2 - 1) / 2, (y1 + y2 - 1) / 2

    def points_closer(self, lattice: Lattice) -> bool:
        """Whether a look predicts objects in smaller windows: it is on the lattice, and not at the last level."""
        return self.within is None and self.level < lattice.levels - 1


@dataclass(frozen=True)
class WindowLook:
    """The result of a look at a window.

    Attributes:
        window: where it looked.
        detections: a batch of one, boxes in picture pixels.
        cut: `(L,)`, whether the border of the window cuts a box.
        show: `(K,)`, highest score of each class in any hint, or in the detections where no hints were wanted.
        gist: the hints by cell; None if the window predicts nothing about smaller windows (`Window.points_closer`).
        hints: all hints, in a photograph alone.
    """

    window: Window
    detections: Detections
    cut: Tensor
    show: Tensor
    gist: Gist | None
    hints: Hints | None = None


def half_steps(lattice: Lattice) -> Iterator[Window]:
    """Yield windows of all levels at steps of half a window, and those at the right and lower borders."""
    for level in range(lattice.levels):
        half = max(1, lattice.span(level) // 2)
        columns, rows = lattice.places(level)
        for row in sorted({*range(0, rows, half), rows - 1}):
            for column in sorted({*range(0, columns, half), columns - 1}):
                yield Window.on(lattice, (level, column, row))


class WindowLooks(ABC):
    """Base of sources of looks at one picture: an eye that looks now, or stored looks."""

    lattice: Lattice
    time: float = 0
    """Seconds of a stream up to the present frame."""
    passed: float = 0
    """Seconds of a stream between the frame before and the present one."""
    blank: Callable[[], Tensor | None] = staticmethod(lambda: None)
    """Gives the cells where there is nothing to see, `(rows, columns)`; None for none."""
    meanwhile: Callable[[], object] | None = None
    """Work for a second thread during the next look, where a detector leaves a core for it."""
    carry: Callable[[CameraStep], object] | None = None
    """Carries what is known along with the camera, as soon as a frame is shown before which it moved."""

    def prepare(self, window: Window) -> None:  # noqa: B027
        """Resample the likely next window in advance; with stored looks this does nothing."""

    @abstractmethod
    def see(self, windows: Sequence[Window], *, hints: bool = True) -> list[WindowLook]:
        """Look at windows, in one batch where that is possible."""


class LiveWindowLooks(WindowLooks):
    """Looks of an eye at a picture.

    Invariant: `_prepared` has windows of the present frame alone, resampled for the next look; a look and a new frame
    empty it. `meanwhile` is for the next look alone, too.
    """

    def __init__(self, eye: WindowEye, view: WindowView) -> None:
        self.eye = eye
        self.view = view
        self.lattice = view.lattice
        self._prepared: dict[Window, Resampled] = {}

    def show(self, view: WindowView, passed: float, camera: CameraStep | None = None) -> None:
        """Set the next frame of a stream, with the seconds and the camera's motion since the last frame."""
        self.view = view
        self.passed = passed
        self.time += passed
        self._prepared.clear()
        if camera is not None and not camera.is_still and self.carry is not None:
            self.carry(camera)

    def prepare(self, window: Window) -> None:
        fixation = torch.tensor([window.fixation], dtype=torch.float64)
        self._prepared[window] = self.eye.resample(self.view, fixation, [window.within])

    def see(self, windows: Sequence[Window], *, hints: bool = True) -> list[WindowLook]:
        resampled = self._prepared.get(windows[0]) if len(windows) == 1 else None
        self._prepared.clear()
        # Work beside a look is asked for before each look.
        meanwhile = self.meanwhile
        self.meanwhile = None
        detected = self.eye.detect(
            self.view,
            torch.tensor([window.fixation for window in windows], dtype=torch.float64),
            [window.within for window in windows],
            # A look that points to closer ones has a gist, which is made of hints.
            hints=hints or any(window.points_closer(self.lattice) for window in windows),
            resampled=resampled,
            meanwhile=meanwhile,
        )
        return [_look_at(detected, number, window, self.lattice) for number, window in enumerate(windows)]


def _look_at(detected: WindowDetections, number: int, window: Window, lattice: Lattice) -> WindowLook:
    """Make one of several looks: a batch of one, without padding.

    Args:
        detected: what all looks show.
        number: of the look.
        window: where it looked.
        lattice: lattice of the picture.
    """
    detections = detected.detections
    if len(detections.mask) > 1:
        count = int(detections.mask[number].sum())
        detections = detections[number : number + 1].take(slice(count))
    hints = None if detected.hints is None else detected.hints[number]
    gist = None
    if hints is None:
        scores = detections.scores[0, :, 1:]
    elif window.points_closer(lattice):
        gist = Gist.of(hints, detections, lattice, (window.level, *window.cells[:2]))
        scores = gist.scores.flatten(0, 1)
    else:
        scores = hints.scores
    is_photograph = lattice.levels == 1
    highest_scores = scores.amax(0).float() if len(scores) else scores.new_zeros(scores.shape[-1])
    return WindowLook(
        window,
        detections,
        cut=detected.cut[number, : detections.mask.shape[1]],
        show=highest_scores,
        gist=gist,
        hints=hints if is_photograph and gist is None else None,
    )
