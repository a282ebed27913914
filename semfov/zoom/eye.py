"""An eye for pictures larger than the detector's input, which looks at windows at a chosen magnification."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from semfov.data.inputs import ImageLike
from semfov.data.large import open_large
from semfov.data.windowed import LargePicture, resized
from semfov.detection import Detections, Detector
from semfov.detection.scores import BackgroundPolicy, Candidates, shares
from semfov.detection.selection import check_numbers, select
from semfov.errors import check, check_number, check_shape, lookup
from semfov.sensor.glimpse import edges_at
from semfov.threads import beside
from semfov.zoom.hints import Hints
from semfov.zoom.lattice import Lattice

Cut = Literal["keep", "drop", "background"]
_Limit = tuple[float, float, float, float]
_Frame = tuple[int, int, int, int, int, int, int, int]
"""`(x1, y1, x2, y2)` of a window in picture pixels, then of its place on the canvas in canvas pixels."""

Resampled = tuple[Tensor, list[_Frame]]

BORDER = 2.0  # a box this near to the border of its window, in canvas pixels, counts as cut by it
# The same in a photograph, where a box that a border cuts often ends well before it (docs/zoom.md).
_PHOTOGRAPH_BORDER = 16.0
_MOST_STRETCHED = 4.0  # largest change of proportions; beyond it nothing was measured, and memory would grow


@dataclass(frozen=True)
class WindowView:
    """A picture that was opened for a `WindowEye`; its pixels are read when a look needs them.

    Attributes:
        picture: source of the pixels, read by windows.
        lattice: cells over the picture, and the windows of every level.

    Example::

        view = WindowEye(load_detector("yolox-nano")).open("harbour.tif")
        view.picture.size, view.lattice.levels
    """

    picture: LargePicture
    lattice: Lattice


class WindowDetections(NamedTuple):
    """The detections and windows of several looks.

    Attributes:
        detections: a batch of F, boxes in picture pixels.
        cut: `(F, L)`, whether the border of a window cuts a box.
        hints: hints of each look; None where none were wanted.
    """

    detections: Detections
    cut: Tensor
    hints: tuple[Hints, ...] | None


class WindowEye(nn.Module):
    """Looks at windows of a picture: resamples a window to the detector's input and detects in it.

    A look costs one pass of the detector, whatever the size of the picture. The borders of windows are rounded to whole
    pixels. In pictures of more than 16 million pixels, the borders of windows at low magnification are rounded to
    pixels of a reduced copy (`semfov.data.windowed`). Windows are resampled as bytes by the antialiased filter of
    `semfov.sensor.glimpse`, from the pixels inside them alone.

    Where the border of a window cuts an object, only a part of the object is visible, and its box encloses that part.
    Such boxes can be kept (`keep`), left out (`drop`), or kept with the scores of background (`background`). The border
    of the picture cuts no object.

    If a window reaches beyond the picture, its part of the picture is padded to the canvas, or stretched to it by a
    factor of at most 4 in proportions. Agents pad or stretch as their evidence was fitted (`semfov.agents.windows`),
    even if the detector was trained in the other way.

    Args:
        detector: any detector.
        finest: largest magnification, in canvas pixels per picture pixel; 1 ends at native pixels.
        cut: treatment of boxes that the border of a window cuts.
        stretch: whether what is shown fills the canvas; None for what the detector was trained with.

    Attributes:
        stretch: whether what is shown fills the canvas.

    Raises:
        InputError: a setting is outside its range.

    Example::

        eye = WindowEye(load_detector("yolox-nano"))
        view = eye.open("harbour.tif")
        eye.look(view, torch.tensor([[2000.0, 1500.0, 0.5]])).boxes
    """

    def __init__(
        self, detector: Detector, *, finest: float = 1.0, cut: Cut = "keep", stretch: bool | None = None
    ) -> None:
        super().__init__()
        check_number(finest, "finest", 0, 64)
        check(finest > 0, "finest", "a positive magnification", finest)
        self.detector = detector
        self.finest = finest
        self.cut: Cut = lookup(cut, get_args(Cut), "treatment of cut boxes")
        self.stretch = detector.stretch if stretch is None else stretch

    def open(self, picture: LargePicture | ImageLike) -> WindowView:
        """Open a picture to look at it.

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.

        Returns:
            The picture with its lattice.
        """
        source = open_large(picture)
        return WindowView(source, Lattice.over(source.size, self.detector.input_size, finest=self.finest))

    def look(self, view: WindowView, fixations: Tensor) -> Detections:
        """Look at windows of a picture, and detect objects in them.

        Args:
            view: the picture, from `open`.
            fixations: `(F, 3)`, `(x, y, magnification)`: centres of the windows in picture pixels, and canvas pixels
                per picture pixel. Points `(F, 2)` are looked at with the largest magnification.

        Returns:
            A batch of F detections, boxes in picture pixels.
        """
        return self.detect(view, fixations).detections

    def detect(
        self,
        view: WindowView,
        fixations: Tensor,
        within: Sequence[_Limit | None] | None = None,
        *,
        hints: bool = True,
        resampled: Resampled | None = None,
        meanwhile: Callable[[], object] | None = None,
    ) -> WindowDetections:
        """Look at windows of a picture, and return their detections and hints (faint candidates).

        Args:
            view: the picture, from `open`.
            fixations: `(F, 3)` or `(F, 2)`, as for `look`.
            within: for each look the box of the picture that it shows; None shows all that fits the canvas.
            hints: whether hints are wanted.
            resampled: the windows, if they were resampled before (`resample`).
            meanwhile: work for a second thread while the detector computes, where a core is left for it.

        Returns:
            Detections and hints of each look.
        """
        canvas, frames = self.resample(view, fixations, within) if resampled is None else resampled
        device = canvas.device
        threshold = self.detector.selection.threshold
        # Hints begin below the threshold of detections.
        least = min(threshold, self.detector.faint) if hints else threshold
        candidates = self._propose(canvas, least, meanwhile)
        selected = select(candidates, None, self.detector.selection, self.detector.background)
        border = _PHOTOGRAPH_BORDER if view.lattice.levels == 1 else BORDER
        place = _Placement(frames, view.picture.size, selected.boxes, border)
        boxes = place.to_picture(selected.boxes)
        if len(boxes) > 1:  # else there is no padding
            boxes = boxes * selected.mask[..., None]
        detections = replace(selected, boxes=boxes)
        if boxes.device != device:
            detections = detections.to(device)
        detections, cut = self._treat(detections, place.cut(selected).to(device))
        hints_of_looks = self._hints(candidates, place, len(frames), device) if hints else None
        return WindowDetections(detections, cut, hints_of_looks)

    def _hints(
        self, candidates: Candidates, place: "_Placement", looks: int, device: torch.device
    ) -> tuple[Hints, ...]:
        """Take the hints of each look from all boxes of the detector's head, with boxes in picture pixels."""
        hints = []
        for look in range(looks):
            on_canvas = _hints_of(candidates, look, self.detector.background, self.detector.faint)
            boxes = place.to_picture(on_canvas.boxes, look)
            hints.append(Hints(boxes.to(device), on_canvas.scores.to(device)))
        return tuple(hints)

    def _propose(self, canvas: Tensor, least: float, meanwhile: Callable[[], object] | None) -> Candidates:
        """Pass canvases `(F, 3, h, w)` through the detector, on its device, while a second thread works.

        Boxes with less than the `least` confidence may be left out.
        """
        device = canvas.device
        canvas = canvas.to(next(self.detector.parameters(), canvas).device)
        with beside(meanwhile, idle=canvas.device.type != "cpu"):
            if canvas.dtype != torch.uint8:
                canvas = canvas.to(torch.get_default_dtype()).contiguous() / 255
            proposals = self.detector.propose_likely(canvas, least)
            return proposals.precise().to(device)

    def glimpse(
        self, view: WindowView, fixations: Tensor, within: Sequence[_Limit | None] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Resample windows without detecting in them.

        Args:
            view: the picture, from `open`.
            fixations: `(F, 3)` or `(F, 2)`, as for `look`.
            within: for each look the box of the picture that it shows; None shows all that fits the canvas.

        Returns:
            Canvases `(F, 3, h, w)`, RGB in [0, 1], and frames `(F, 8)`: each window in picture pixels
            `(x1, y1, x2, y2)`, and its place on the canvas.

        Raises:
            InputError: a fixation is not finite, or its magnification is not positive.
        """
        canvases, frames = self.resample(view, fixations, within)
        unit = canvases.to(torch.get_default_dtype()).contiguous() / 255
        return unit, torch.tensor(frames, dtype=unit.dtype).view(-1, 8)

    def resample(self, view: WindowView, fixations: Tensor, within: Sequence[_Limit | None] | None = None) -> Resampled:
        """Resample windows to the detector's input, for `detect`.

        Args:
            view: the picture, from `open`.
            fixations: `(F, 3)` or `(F, 2)`, as for `look`.
            within: for each look the box of the picture that it shows; None shows all that fits the canvas.

        Returns:
            Canvases `(F, 3, h, w)`, RGB from 0 to 255, as bytes if the padding is a byte; and frames as of `glimpse`.
        """
        rows = _checked_fixations(fixations, view.lattice.magnifications[-1])
        limits = [None] * len(rows) if within is None else within
        padding = self._padding()
        canvases = []
        frames = []
        for row, limit in zip(rows, limits, strict=True):
            canvas, frame = self._show(padding, view.picture, row, limit)
            canvases.append(canvas)
            frames.append(frame)
        return canvases[0] if len(canvases) == 1 else torch.cat(canvases), frames

    def _padding(self) -> Tensor:
        """Make the detector's padding from 0 to 255: a byte where it is a whole number, for canvases of bytes."""
        fill = 255 * float(self.detector.fill)
        # A share of 255 that was a byte is a whole number up to rounding alone.
        is_byte = abs(fill - round(fill)) < 1e-6
        return torch.tensor(round(fill), dtype=torch.uint8) if is_byte else torch.tensor(fill)

    def _show(
        self, padding: Tensor, picture: LargePicture, fixation: list[float], limit: _Limit | None
    ) -> tuple[Tensor, _Frame]:
        """Show one window on a canvas.

        Args:
            padding: a pixel of the canvas where the window has none, `()`; gives the dtype.
            picture: the picture.
            fixation: x, y and magnification.
            limit: `(x1, y1, x2, y2)` of the picture that is shown; None shows all that fits the canvas.

        Returns:
            The canvas `(1, 3, h, w)`, and the frame of the window.
        """
        width, height = self.detector.input_size
        picture_width, picture_height = picture.size
        left, top, right, bottom = (0.0, 0.0, math.inf, math.inf) if limit is None else limit
        x, y, magnification = fixation
        reduction = picture.reduction(1 / magnification)
        # First and end in the picture, and on the canvas.
        x1, x2, u1, u2 = _window_pixels(x, magnification, width, picture_width, left, right, reduction)
        y1, y2, v1, v2 = _window_pixels(y, magnification, height, picture_height, top, bottom, reduction)
        if self.stretch:
            stretched = width / (u2 - u1), height / (v2 - v1)
            if max(stretched) <= _MOST_STRETCHED * min(stretched):
                u1, v1, u2, v2 = 0, 0, width, height
                # The axis that is stretched needs more pixels of the picture; edges stay multiples of the reduction.
                reduction = min(reduction, picture.reduction(min((x2 - x1) / width, (y2 - y1) / height)))
        window = picture.read((x1, y1, x2, y2), reduction)
        pixels = resized(window, (v2 - v1, u2 - u1)).to(padding.dtype)
        frame = x1, y1, x2, y2, u1, v1, u2, v2
        if (u1, v1, u2, v2) == (0, 0, width, height):
            return pixels, frame
        # In the layout of `resized`, which windows that fill the canvas have.
        canvas = padding.expand(1, 3, height, width).contiguous(memory_format=torch.channels_last)
        canvas[..., v1:v2, u1:u2] = pixels
        return canvas, frame

    def _treat(self, detections: Detections, cut: Tensor) -> tuple[Detections, Tensor]:
        """Treat cut boxes as the eye's setting says.

        Args:
            detections: a batch of F.
            cut: `(F, L)`, which boxes are cut.

        Returns:
            The detections, and which of the resulting boxes are cut.
        """
        if self.cut == "keep" or not bool(cut.any()):
            return detections, cut
        if self.cut == "drop":
            uncut = detections.mask & ~cut
            looks = [detections[look, rows][None] for look, rows in enumerate(uncut)]
            remaining = Detections.stack(looks)
            return remaining, torch.zeros_like(remaining.mask)
        background = torch.zeros_like(detections.scores[..., :1, :])
        background[..., 0] = 1
        scores = torch.where(cut[..., None], background, detections.scores)
        return Detections(detections.boxes, scores, detections.mask, detections.confidence * ~cut), cut

    def forward(self, picture: Tensor, fixations: Tensor) -> Detections:
        """Open a picture, look at it and detect.

        Args:
            picture: `(3, H, W)`, RGB in [0, 1] or bytes.
            fixations: `(F, 3)` or `(F, 2)`, as for `look`.

        Returns:
            A batch of F detections, boxes in picture pixels.
        """
        return self.look(self.open(picture), fixations)

    def settings(self) -> dict[str, Any]:
        """List the settings on which detections depend; caches and files of fitted models store them.

        Returns:
            JSON values.
        """
        sensor = {"glimpse": "antialiased bilinear", "finest": self.finest, "cut": self.cut}
        # Not named where it is false, so that keys and metadata from before it stay valid.
        if self.stretch:
            sensor["stretch"] = True
        return {"sensor": sensor, "detector": self.detector.settings()}


def _checked_fixations(fixations: Tensor, closest: float) -> list[list[float]]:
    """Check fixations; returns x, y and magnification of each, the closest one for points `(F, 2)` alone."""
    if fixations.shape[-1] == 2:
        magnification = fixations.new_full((*fixations.shape[:-1], 1), closest)
        fixations = torch.cat([fixations, magnification], -1)
    check_shape(fixations, "fixations", None, 3)
    rows: list[list[float]] = fixations.tolist()
    check(bool(fixations.isfinite().all()), "fixations", "finite numbers", rows)
    magnifications = [magnification for _, _, magnification in rows]
    check(min(magnifications, default=1) > 0, "fixations", "positive magnifications", magnifications)
    return rows


def _hints_of(candidates: Candidates, image: int, policy: BackgroundPolicy, faint: float) -> Hints:
    """Take the hints from all boxes of a detector's head."""
    confidence = candidates.confidence[image].detach()
    index = (confidence >= faint).nonzero()[:, 0]
    selected = candidates.take(image, index)
    boxes = selected.boxes.detach()
    # Some detectors check all numbers of a pass themselves, and once is enough.
    if not candidates.are_checked:
        check_numbers(image, -math.inf, math.inf, confidence=confidence, boxes=boxes)
        check_numbers(image, 0, 1, class_scores=selected.classes, objectness=selected.objectness)
    return Hints(boxes, shares(selected, policy)[1].detach())


def _window_pixels(
    point: float, magnification: float, count: int, length: int, low: float, high: float, step: int
) -> tuple[int, int, int, int]:
    """Find the pixels that a window shows along one axis.

    Args:
        point: centre of the window in picture pixels.
        magnification: canvas pixels per picture pixel.
        count: pixels of the canvas.
        length: pixels of the picture.
        low: first edge of what is shown of the picture.
        high: its last edge.
        step: edges are rounded to multiples of it.

    Returns:
        First and end in the picture, and first and end on the canvas; at least one pixel each.
    """
    edge, last_edge = edges_at(point, magnification, float(count))
    window_start = step * round(edge / step)
    window_end = step * round(last_edge / step)
    least = round(max(low, 0.0))
    most = round(min(high, length))
    # A window beside the picture shows its nearest pixel.
    first = min(max(window_start, least), most - 1)
    end = min(max(window_end, first + 1), most)
    # What the window shows beyond the picture is padding on the canvas.
    padding = round((first - window_start) * magnification)
    canvas_first = min(max(padding, 0), count - 1)
    canvas_end = canvas_first + round((end - first) * magnification)
    return first, end, canvas_first, min(max(canvas_end, canvas_first + 1), count)


def _placement_rows(frame: _Frame, size: tuple[int, int], border: float) -> list[list[float]]:
    """List the six rows of numbers of a look (`_Placement`)."""
    width, height = size
    x1, y1, x2, y2, u1, v1, u2, v2 = frame
    scale = [(x2 - x1) / (u2 - u1), (y2 - y1) / (v2 - v1)]
    # The border of the picture cuts no object.
    borders = [
        u1 + border if x1 > 0 else -math.inf,
        v1 + border if y1 > 0 else -math.inf,
        border - u2 if x2 < width else -math.inf,
        border - v2 if y2 < height else -math.inf,
    ]
    return [[x1, y1] * 2, [x2, y2] * 2, [u1, v1] * 2, scale * 2, borders, [1, 1, -1, -1]]


class _Placement:
    """Maps boxes from the canvases of several looks to the picture.

    For each look it holds six rows of four numbers, one for each edge of a box: the window's low and high edges in the
    picture, its low edges on the canvas, picture pixels per canvas pixel, and by which number an edge of a box, times
    the sign that points inwards, is at the border of the window.
    """

    def __init__(self, frames: Sequence[_Frame], size: tuple[int, int], like: Tensor, border: float) -> None:
        """Compute the numbers of all looks.

        Args:
            frames: of the looks.
            size: `(width, height)` of the picture.
            like: gives dtype and device.
            border: canvas pixels from the border of a window at which it cuts a box.
        """
        # Python's numbers: tensors this small spend their time in calls.
        rows = [_placement_rows(frame, size, border) for frame in frames]
        numbers = torch.tensor(rows, dtype=like.dtype, device=like.device).view(-1, 6, 1, 4)
        self._by_look = [numbers[look].unbind() for look in range(len(frames))]
        self._all = numbers.unbind(1)

    def to_picture(self, boxes: Tensor, look: int | None = None) -> Tensor:
        """Map canvas boxes of all looks `(F, L, 4)`, or of one `(L, 4)`, to the picture, cut to the window."""
        low, high, canvas_low, scale, _, _ = self._all if look is None else self._by_look[look]
        return ((boxes - canvas_low) * scale + low).clamp(low, high)

    def cut(self, detections: Detections) -> Tensor:
        """Tell which boxes touch a border of their window that lies inside the picture, `(F, L)`."""
        *_, border, inwards = self._all
        return (detections.boxes * inwards <= border).any(-1) & detections.mask
