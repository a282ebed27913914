"""The multi-scale fovea: square crops around the fixation, each twice as wide as the one before, all of one size."""

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.inputs import ImageLike, PointLike, as_batch, as_points, as_positions
from semfov.errors import check, check_shape, check_whole
from semfov.io.compatibility import Settings
from semfov.sensor.base import Sensor, fixations, is_single_picture, of_one_picture
from semfov.sensor.glimpse import windows_at

_Planes = tuple[Tensor, ...]
"""Planes of all squares of 2^l pixels that touch an image, with a black border, finest scale first."""


class MultiScaleFovea(Sensor):
    r"""A sensor of several square crops around the fixation, each of which the detector sees as a picture of its own.

    Crop l of L covers :math:`side \cdot 2^l` pixels and is reduced to `side` pixels. Its pixel i is the mean of the
    picture over a square of :math:`s = 2^l` pixels, and the picture is black outside:

    .. math:: c_i = \frac{1}{s} \int_{a + i s}^{a + (i + 1) s} I(u) \, du, \qquad a = g + ½ - \frac{side \cdot s}{2}

    along x and along y, for a fixation g. Where the edges of the crop lie between pixels, this is the average of blocks
    of pixels (OpenCV's `INTER_AREA`); elsewhere it is linear interpolation between such averages.

    It is the sensor of Luzio, Bernardino and Moreno, "Cost-efficient multi-scale fovea for semantic-based visual search
    attention" (arXiv 2604.03836), whose crops are 160, 320, 640 and 1280 pixels wide. Their code
    (vislab-tecnico-lisboa/SemBA) reduces the crops by bilinear interpolation without averaging, and uses the boxes of
    all crops as they are. The averages are our choice, and so is the merging (`semfov.detection.crops.merge_crops`).

    The crops are taken from the picture in its reference size (`Eye(…, reference=640)`) and not from the detector's
    input, so a larger reference shows finer detail for the same number of the detector's pixels.

    Args:
        side: side of each crop as the detector sees it, in pixels.
        scales: number of crops, L.

    Raises:
        InputError: a setting is out of its range.

    >>> sensor = MultiScaleFovea(32, 3)
    >>> sensor(torch.rand(2, 3, 48, 64), torch.tensor([20.0, 30.0])).shape
    torch.Size([2, 3, 3, 32, 32])
    """

    kind = "multi-scale"
    names = ("side", "scales")

    def __init__(self, side: float = 160, scales: float = 4) -> None:
        super().__init__()
        for name, value, largest in (("side", side, 4096), ("scales", scales, 16)):
            # Files of settings may hold whole numbers as floats.
            check_whole(int(value) if float(value).is_integer() else value, name, 1, largest)
        self.side = int(side)
        self.scales = self.crops = int(scales)

    def means(self, image: ImageLike) -> _Planes:
        """Compute the part of the work that does not depend on the gaze, to share it among fixations.

        Args:
            image: images `(B, C, H, W)`, or one picture of any common type (`semfov.as_image`).

        Returns:
            Planes of squares at every scale, finest first.
        """
        images = as_batch(image)
        check(images.numel() > 0 or not len(images), "image", "at least one pixel", tuple(images.shape))
        # A border of one pixel is black; it stands for everything that is farther outside.
        plane = F.pad(images, (1, 1, 1, 1))
        means = [plane]
        for scale in range(self.scales - 1):
            # The mean of a square is that of four squares of half its side, at all places: of two side by side first,
            # and then of two such pairs, one above the other.
            step = 2**scale
            padded = F.pad(plane, (step, step, step, step))
            pairs = (padded[..., step:] + padded[..., :-step]) / 2
            plane = (pairs[..., step:, :] + pairs[..., :-step, :]) / 2
            means.append(plane)
        return tuple(means)

    def forward(self, image: ImageLike | _Planes, gaze: PointLike) -> Tensor:
        """Compute the crops around fixations.

        Args:
            image: images `(B, C, H, W)`, or their `means`; or one picture of any common type (`semfov.as_image`).
            gaze: fixations `(x, y)` in image pixels, inside or outside: `(2,)` for all images, `(B, 2)` for one
                fixation of each image, or `(B, G, 2)` for G of each; of one picture `(2,)`, or `(G, 2)` for G.

        Returns:
            Crops `(B, L, C, side, side)`, or `(B, G, L, C, side, side)` for G fixations, finest first; of one picture
            `(L, 3, side, side)` or `(G, L, 3, side, side)`.

        Raises:
            InputError: a shape does not fit, or the gaze is not finite.
        """
        points = as_points(gaze)
        if is_single_picture(image):
            return self(self.means(image), of_one_picture(points))[0]
        means = image if isinstance(image, tuple) else self.means(image)
        check(len(means) == self.scales, "image", f"planes of {self.scales} scales", len(means))
        check_shape(means[0], "image", None, None, None, None)  # no tuple of pictures
        fixation = fixations(points, means[0])
        crops = torch.stack([self._crop(plane, fixation, scale) for scale, plane in enumerate(means)], 2)
        return crops if points.ndim == 3 else crops[:, 0]

    def windows(self, gaze: Tensor) -> Tensor:
        """Compute the squares that the crops cover.

        Args:
            gaze: fixations `(..., 2)`.

        Returns:
            `(..., L, 4)`, `(x1, y1, x2, y2)`, edges between pixels.
        """
        reduced = 0.5 ** torch.arange(self.scales, dtype=gaze.dtype, device=gaze.device)
        points = gaze[..., None, :].expand(*gaze.shape[:-1], self.scales, 2)
        magnifications = reduced.expand(points.shape[:-1])
        return windows_at(points, magnifications, (self.side, self.side))

    def canvas_size(self, size: tuple[int, int], reference: float) -> tuple[int, int]:
        """Return the size of the canvas: the picture's size, scaled so that its longer side is the reference."""
        width, height = (max(1, round(length * reference / max(size))) for length in size)
        return width, height

    def open(self, canvas: Tensor, scale: Tensor) -> tuple[_Planes, tuple[int, int]]:
        """Compute the means of a canvas. Crops are in pixels of the canvas, whatever the scale."""
        return self.means(canvas), (canvas.shape[-1], canvas.shape[-2])

    def look(self, state: tuple[_Planes, tuple[int, int]], gaze: Tensor) -> Tensor:
        """Compute the crops `(F·L, 3, side, side)` around fixations `(F, 2)`, those of a fixation together."""
        return self(state[0], gaze[None])[0].flatten(0, 1)

    def picture(self, state: tuple[_Planes, tuple[int, int]], gaze: Tensor) -> Tensor:
        """Compose the crops into pictures `(F, 3, H, W)` in which each place is shown by its finest crop."""
        means, size = state
        crops = self(means, gaze[None])[0]
        fixation = fixations(gaze, crops)
        windows = self.windows(fixation[:, 0])
        width, height = size
        picture = crops.new_zeros(len(crops), crops.shape[2], height, width)
        # The coarsest crop first: finer ones are laid over it.
        for scale in reversed(range(self.scales)):
            places = self._places_in_crop(windows[:, scale, :2], scale, size)
            crop = crops[:, scale].to(places)
            shown = F.grid_sample(crop, places, "bilinear", "border", align_corners=False).to(crops)
            is_inside = (places.abs() <= 1).all(-1)[:, None]
            picture = torch.where(is_inside, shown, picture)
        return picture

    def _places_in_crop(self, corner: Tensor, scale: int, size: tuple[int, int]) -> Tensor:
        """Compute where the pixels of a picture lie in crops, from -1 to 1 inside them.

        Args:
            corner: `(F, 2)`, left upper corners of the crops in the picture.
            scale: of the crops.
            size: `(width, height)` of the picture.

        Returns:
            x and y, `(F, height, width, 2)`.
        """
        width, height = size
        x = torch.arange(width, dtype=corner.dtype, device=corner.device) + 0.5
        y = torch.arange(height, dtype=corner.dtype, device=corner.device) + 0.5
        side = self.side * 2**scale
        columns = 2 * (x - corner[:, :1]) / side - 1  # (F, width)
        rows = 2 * (y - corner[:, 1:]) / side - 1  # (F, height)
        planes = torch.broadcast_tensors(columns[:, None, :], rows[:, :, None])
        return torch.stack(planes, -1)

    def boxes_to_canvas(self, state: tuple[_Planes, tuple[int, int]], gaze: Tensor, boxes: Tensor) -> Tensor:
        """Map boxes `(F·L, N, 4)` in the crops to the canvas: times 2^l, from the corner of the crop."""
        windows = self.windows(as_positions(gaze, boxes)).flatten(0, 1)[:, None]  # (F·L, 1, 4)
        corner = windows[..., :2]
        pixels = (windows[..., 2:] - corner) / self.side  # of the canvas, for one of the crop
        return boxes * pixels.repeat(1, 1, 2) + corner.repeat(1, 1, 2)

    def settings(self) -> dict[str, object]:
        """List the settings that the views depend on."""
        return {"kind": self.kind, "side": self.side, "scales": self.scales}

    @classmethod
    def width(cls, settings: Settings) -> float:
        """Return half the side of the finest crop."""
        return float(settings["side"]) / 2

    @classmethod
    def borders(cls, settings: Settings) -> list[float]:
        """List where acuity changes: at half the side of each crop."""
        return [cls.width(settings) * 2**scale for scale in range(int(settings["scales"]))]

    def _crop(self, plane: Tensor, fixation: Tensor, scale: int) -> Tensor:
        """Cut the crops of one scale from the means of its squares.

        Args:
            plane: means of all squares of 2^l pixels, `(B, C, h, w)` with the black border (`means`).
            fixation: `(B, G, 2)` in pixels of the image.
            scale: l.

        Returns:
            Crops `(B, G, C, side, side)`, interpolated linearly between the squares.
        """
        first = self._first_square(plane, fixation, scale)
        square = first.detach().floor()
        # Shares of the next square, for planes `(B, G, side, C, side)`.
        x, y = (first - square)[..., None, None, None].unbind(2)
        offsets = torch.arange(self.side, device=plane.device) * 2**scale
        column = square[..., 0, None].long() + offsets  # (B, G, side)
        row = square[..., 1, None].long() + offsets

        # Rows first: they are contiguous in memory.
        height, width = plane.shape[-2:]
        rows = plane.transpose(1, 2)  # (B, h, C, w)
        image = torch.arange(len(plane), device=plane.device)[:, None, None]
        upper = rows[image, row.clamp(0, height - 1)]  # (B, G, side, C, w)
        lower = rows[image, (row + 1).clamp(0, height - 1)]
        lines = upper * (1 - y) + lower * y

        columns = column[..., None, None, :].expand(*lines.shape[:-1], self.side)
        left = lines.gather(-1, columns.clamp(0, width - 1))
        right = lines.gather(-1, (columns + 1).clamp(0, width - 1))
        crops = left * (1 - x) + right * x
        return crops.transpose(-3, -2).to(plane.dtype)

    def _first_square(self, plane: Tensor, fixation: Tensor, scale: int) -> Tensor:
        """Compute the place `(B, G, 2)` of a crop's first square in a plane of means, between two squares of it."""
        step = 2**scale
        height, width = plane.shape[-2:]
        # Squares that start before 1 - step or after the last pixel show nothing: they are the border of the plane.
        first = fixation + 0.5 - self.side * step / 2 + step
        # A crop that is farther away is all black; a number that fits an integer is enough for it.
        farthest = [float(width + self.side * step), float(height + self.side * step)]
        reach = torch.tensor(farthest, dtype=first.dtype, device=first.device)
        return torch.minimum(torch.maximum(first, -reach), reach)
