"""An eye for pictures larger than a detector's input: a look is a choice of where and how close."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.data.inputs import ImageLike
from semfov.data.large import LargePicture, open_large
from semfov.detection.detections import Detections
from semfov.detection.detector import Detector
from semfov.detection.selection import Selection, select_several
from semfov.errors import check, check_number, check_shape, lookup
from semfov.sensor.glimpse import windows_at
from semfov.zoom.lattice import Lattice

Cut = Literal["keep", "drop", "background"]
Limit = tuple[float, float, float, float]

HINTS = Selection(threshold=0.002, iou=0.95, limit=300)
"""Candidates that are too weak to be detections, but tell where a closer look pays."""

_REDUCE = 2  # a window is reduced in the source as long as it keeps this many pixels for each canvas pixel
BORDER = 2.0
"""Canvas pixels; a box that comes as near to the window's border is cut by it."""


@dataclass(frozen=True)
class ZoomView:
    """A picture as the eye holds it: nothing is read yet.

    Attributes:
        picture: gives its windows.
        lattice: the cells over it, and the windows of every level.
    """

    picture: LargePicture
    lattice: Lattice


@dataclass(frozen=True)
class Seen:
    """What a few looks show.

    Attributes:
        detections: boxes in picture pixels, a batch of F.
        cut: `(F, L)`, which detections the border of their window cuts.
        hints: weak candidates, overlapping ones among them, boxes in picture pixels.
        windows: `(F, 4)`, what was looked at, cut to the picture.
    """

    detections: Detections
    cut: Tensor
    hints: Detections
    windows: Tensor


class ZoomEye(nn.Module):
    """Looks at windows of a picture, each at a magnification and resampled to the detector's input.

    A look costs one pass of the detector, whatever the size of the picture. Windows are rounded to whole pixels and
    resampled by the antialiased filter of `semfov.sensor.glimpse`, from bytes, within their own border.

    An object that the border of a window cuts shows a part of itself there, and its box is the part's. Such a box can
    be kept (`keep`), left out (`drop`), or keep its place with the scores of a background (`background`). A border of
    the picture cuts nothing.

    Args:
        detector: any detector.
        finest: largest magnification, in canvas pixels for each picture pixel; 1 ends at native pixels.
        cut: what becomes of boxes at a window's border.

    Example::

        eye = ZoomEye(load_detector("yolox-nano"))
        view = eye.open("harbour.tif")
        eye.look(view, torch.tensor([[2000.0, 1500.0, 0.5]])).boxes
    """

    def __init__(self, detector: Detector, *, finest: float = 1.0, cut: Cut = "keep") -> None:
        super().__init__()
        check_number(finest, "finest", 0, 64)
        check(finest > 0, "finest", "a positive magnification", finest)
        self.detector = detector
        self.finest = finest
        self.cut: Cut = lookup(cut, get_args(Cut), "treatment of cut boxes")

    def open(self, picture: LargePicture | ImageLike) -> ZoomView:
        """Hold a picture: a file, another of any common kind (`semfov.as_image`), or a `LargePicture`."""
        source = open_large(picture)
        return ZoomView(source, Lattice.over(source.size, self.detector.input_size, finest=self.finest))

    def look(self, view: ZoomView, fixations: Tensor) -> Detections:
        """Detections from fixations `(F, 3)`, `(x, y, magnification)`: a batch of F, boxes in picture pixels.

        Points of two numbers `(F, 2)` are looked at at the largest magnification.
        """
        return self.glance(view, fixations).detections

    def glance(self, view: ZoomView, fixations: Tensor, within: Sequence[Limit | None] | None = None) -> Seen:
        """Detections with their hints.

        Args:
            view: of `open`.
            fixations: as for `look`.
            within: box of the picture that each look shows no more than; None for all that fits the canvas.
        """
        canvas, frames = self.glimpse(view, fixations, within)
        candidates = self.detector.propose(canvas)
        wanted = [self.detector.selection, HINTS]
        detections, hints = select_several(candidates, None, wanted, self.detector.background)
        place = _Placement(frames, view.picture.size, detections.boxes)
        found, cut = self._treat(place.to_picture(detections), place.cut(detections))
        return Seen(found, cut, place.to_picture(hints), frames[:, :4])

    def glimpse(
        self, view: ZoomView, fixations: Tensor, within: Sequence[Limit | None] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Canvases `(F, 3, h, w)`, and `(F, 8)`: the window in the picture and the same on the canvas.

        Arguments as for `glance`.
        """
        if fixations.shape[-1] == 2:
            closest = fixations.new_full((*fixations.shape[:-1], 1), view.lattice.magnifications[-1])
            fixations = torch.cat([fixations, closest], -1)
        check_shape(fixations, "fixations", None, 3)
        rows = fixations.tolist()
        check(all(math.isfinite(n) for row in rows for n in row), "fixations", "finite numbers", rows)
        check(all(row[2] > 0 for row in rows), "fixations", "positive magnifications", [row[2] for row in rows])
        windows = windows_at(fixations[:, :2].double(), fixations[:, 2].double(), self.detector.input_size)
        limits = [None] * len(fixations) if within is None else within
        wide, high = self.detector.input_size
        canvases = torch.empty(len(fixations), 3, high, wide)
        frames = [
            self._show(canvas, view.picture, window, m, limit)
            for canvas, window, (_, _, m), limit in zip(canvases, windows.tolist(), rows, limits, strict=True)
        ]
        return canvases, torch.tensor(frames).view(-1, 8)

    def _show(
        self, canvas: Tensor, picture: LargePicture, window: list[float], magnification: float, limit: Limit | None
    ) -> list[float]:
        """Write a canvas; returns where it lies in the picture."""
        wide, high = self.detector.input_size
        low, right = (0.0, 0.0), (float(picture.size[0]), float(picture.size[1]))
        if limit is not None:
            low = max(low[0], limit[0]), max(low[1], limit[1])
            right = min(right[0], limit[2]), min(right[1], limit[3])
        left, top = round(window[0]), round(window[1])
        x1, y1 = (min(max(edge, round(a)), round(b) - 1) for edge, a, b in zip((left, top), low, right, strict=True))
        x2, y2 = (
            min(max(round(edge), start + 1), round(b))
            for edge, start, b in zip(window[2:], (x1, y1), right, strict=True)
        )
        u1, v1 = (
            min(round((low - edge) * magnification), n - 1) for low, edge, n in ((x1, left, wide), (y1, top, high))
        )
        u2, v2 = (
            min(max(start + round((stop - first) * magnification), start + 1), n)
            for start, first, stop, n in ((u1, x1, x2, wide), (v1, y1, y2, high))
        )
        reduction = 1
        while min((x2 - x1) // (u2 - u1), (y2 - y1) // (v2 - v1)) >= 2 * _REDUCE * reduction:
            reduction *= 2
        pixels = picture.read((x1, y1, x2, y2), reduction)[None]
        if pixels.shape[-2:] != (v2 - v1, u2 - u1):
            # A window whose rows lie apart in memory is resampled half as fast.
            pixels = pixels.contiguous(memory_format=torch.channels_last)
            pixels = F.interpolate(pixels, (v2 - v1, u2 - u1), mode="bilinear", antialias=True)
        if (u1, v1, u2, v2) != (0, 0, wide, high):
            canvas.fill_(float(self.detector.fill))
            canvas = canvas[:, v1:v2, u1:u2]
        canvas.copy_(pixels[0]).div_(255)
        return [float(n) for n in (x1, y1, x2, y2, u1, v1, u2, v2)]

    def _treat(self, detections: Detections, cut: Tensor) -> tuple[Detections, Tensor]:
        """Detections after the eye's treatment of those that are cut, and which of them are cut."""
        if self.cut == "keep" or not bool(cut.any()):
            return detections, cut
        if self.cut == "drop":
            kept = [detections.mask[n] & ~cut[n] for n in range(len(cut))]
            whole = [
                Detections(detections.boxes[n : n + 1, keep], detections.scores[n : n + 1, keep], keep[keep][None])
                for n, keep in enumerate(kept)
            ]
            left = Detections.stack(whole)
            return left, torch.zeros_like(left.mask)
        nothing = torch.zeros_like(detections.scores[..., :1, :])
        nothing[..., 0] = 1
        scores = torch.where(cut[..., None], nothing, detections.scores)
        return Detections(detections.boxes, scores, detections.mask), cut

    def forward(self, picture: Tensor, fixations: Tensor) -> Detections:
        """`look` at an image from fixations."""
        return self.look(self.open(picture), fixations)

    def settings(self) -> dict[str, Any]:
        """What the detections depend on, for the keys of caches and the metadata of fitted models."""
        sensor = {"glimpse": "antialiased bilinear", "finest": self.finest, "cut": self.cut}
        return {"sensor": sensor, "detector": self.detector.settings()}


class _Placement:
    """Where the canvases of a few looks lie in the picture.

    Args:
        frames: `(F, 8)`, the window in the picture and the same on the canvas.
        size: `(width, height)` of the picture.
        like: boxes whose dtype and device are taken.
    """

    def __init__(self, frames: Tensor, size: tuple[int, int], like: Tensor) -> None:
        values = frames.numpy().astype(np.float64 if like.dtype == torch.float64 else np.float32)
        window, canvas = values[:, :4], values[:, 4:]
        scale = (window[:, 2:] - window[:, :2]) / (canvas[:, 2:] - canvas[:, :2])
        # A border of the picture cuts nothing.
        near = np.where(window[:, :2] > 0, canvas[:, :2] + BORDER, -np.inf)
        far = np.where(window[:, 2:] < size, canvas[:, 2:] - BORDER, np.inf)
        corners = window[:, :2], window[:, 2:], canvas[:, :2], scale
        rows = np.stack([*(np.tile(corner, 2) for corner in corners), np.concatenate([near, far], 1)])
        self._low, self._high, self._first, self._scale, self._border = torch.from_numpy(rows).to(like)[:, :, None]

    def to_picture(self, detections: Detections) -> Detections:
        """Canvas boxes as boxes in picture pixels, cut to their windows."""
        boxes = (detections.boxes - self._first) * self._scale + self._low
        boxes = boxes.clamp(self._low, self._high) * detections.mask[..., None]
        return Detections(boxes, detections.scores, detections.mask)

    def cut(self, detections: Detections) -> Tensor:
        """Which boxes touch a border of their window that lies inside the picture, `(F, L)`."""
        low, high = self._border.split(2, -1)
        touches = (detections.boxes[..., :2] <= low) | (detections.boxes[..., 2:] >= high)
        return touches.any(-1) & detections.mask
