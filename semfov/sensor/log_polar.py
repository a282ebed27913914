"""The log-polar sensor: cortical images, whose receptors lie further apart with eccentricity, and their projections."""

from dataclasses import dataclass, replace
from math import ceil, exp, hypot, inf, log1p, log2, pi, sqrt

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.inputs import ImageLike, PointLike, as_batch, as_images, as_points
from semfov.errors import check, check_shape
from semfov.io.compatibility import Settings
from semfov.sensor.base import Sensor, fixations, is_single_picture, of_one_picture
from semfov.sensor.constants import constant
from semfov.sensor.pyramid import gaussian_pyramid

_Levels = tuple[Tensor, ...]  # a Gaussian pyramid, finest level first
_Numbers = tuple[float, float, float, tuple[float, float]]  # fovea, spacing, pooling and scale of a retina
_TALLEST = 30  # levels of a pyramid; an image with sides of 2^30 pixels is a single pixel then
_MOST = 2**26  # receptors
_FARTHEST = 1e15  # pixels from the image to a fixation


@dataclass(frozen=True)
class _Retina:
    """The layout of the receptors."""

    fovea: float
    spacing: float = 1.0
    pooling: float = 1.0
    scale: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("fovea", "spacing", "pooling"):
            value = getattr(self, name)
            check(0 < value < inf, name, "a positive number", value)

    @property
    def numbers(self) -> _Numbers:
        """The arguments, as the key of what is computed for them once."""
        return self.fovea, self.spacing, self.pooling, self.scale

    def receptors(self, size: tuple[int, int]) -> tuple[int, int]:
        """Count the `(rings, wedges)` that cover an image of `(width, height)` from any fixation inside it."""
        wedges = 4 * max(1, round(pi * self.fovea / (2 * self.spacing)))
        farthest = self.fovea * log1p(self._reach(size) / self.fovea)  # cortical distance of the farthest pixel
        rings = 2 + ceil(farthest / self.spacing)
        expected = f"a distance large enough for at most {_MOST:,} receptors"
        check(rings * wedges <= _MOST, "spacing", expected, self.spacing)
        return rings, wedges

    def levels(self, size: tuple[int, int]) -> int:
        """Count how often an image of `(width, height)` is halved for its widest receptive field."""
        return ceil(self.level(self._reach(size)))

    def level(self, eccentricity: float) -> float:
        """Compute the level of a Gaussian pyramid, also between two, whose pixels are as large as a receptive field."""
        at_fixation = self.pooling * self.spacing  # in pixels of the retina
        across, down = self.scale
        field = at_fixation * (1 + eccentricity / self.fovea) * sqrt(across * down)  # in pixels of the image
        return min(max(log2(field), 0.0), float(_TALLEST))

    def eccentricity(self, ring: int) -> float:
        """Compute the eccentricity of the receptors of a ring, in the unit of `fovea`: r of its ρ (`log_polar`)."""
        rho = (ring + 0.5) * self.spacing
        return self.fovea * (exp(rho / self.fovea) - 1)

    def _reach(self, size: tuple[int, int]) -> float:
        """Measure the diagonal of an image, in the unit of `fovea`."""
        return hypot(size[0] / self.scale[0], size[1] / self.scale[1])


def log_polar(
    image: ImageLike | _Levels,
    gaze: PointLike,
    *,
    fovea: float,
    spacing: float = 1.0,
    pooling: float = 1.0,
) -> Tensor:
    r"""Compute cortical images: the responses of receptors on rings around a fixation.

    A point at eccentricity r and angle θ relative to the fixation has the cortical coordinates

    .. math:: \rho = a \ln\left(1 + \frac{r}{a}\right), \qquad \theta.

    The receptor of ring i and wedge j is at :math:`\rho_i = (i + ½) \delta` and :math:`\theta_j = 2 \pi j / N`.
    Neighbouring receptors are :math:`\delta (1 + r / a)` pixels apart. Their distance is nearly constant for r well
    below a, is doubled at r = a, and is proportional to the eccentricity far beyond, as in the cortex of primates
    (:math:`\ln(z + a)`, Schwartz, 1980; Traver and Bernardino, 2010, review such maps). There are
    :math:`N = 2 \pi a / \delta` wedges (rounded to a multiple of 4), so that for large r wedges are as far apart as
    rings.

    A receptor pools its surroundings: it samples a Gaussian pyramid at level :math:`\log_2` of `pooling` times the
    distance to its neighbours, and the image itself where that distance is less than a pixel. Interpolation is bicubic
    between pixels and linear between levels. Receptors outside the image respond to its nearest border pixel.

    Args:
        image: `(B, C, H, W)`, or its levels from `LogPolar.pyramid`, which any number of fixations can share; or one
            picture of any common type (`semfov.as_image`).
        gaze: fixation `(x, y)` in image pixels, inside or outside: `(2,)` for all images, `(B, 2)` for one fixation of
            each image, or `(B, G, 2)` for G of each; of one picture `(2,)`, or `(G, 2)` for G fixations.
        fovea: a in pixels.
        spacing: δ in pixels.
        pooling: width of receptive fields, as a multiple of the distance between neighbours. Smaller values alias,
            larger values blur.

    Returns:
        `(B, C, M, N)`, or `(B, G, C, M, N)` for G fixations; of one picture `(3, M, N)` or `(G, 3, M, N)`: M rings,
        innermost first, and N wedges, clockwise from the x-axis. The rings extend as far as the diagonal of the image
        is long.

    Raises:
        InputError: a shape does not fit, the gaze is not finite, or a setting is not positive.

    >>> image = torch.rand(1, 3, 48, 64)
    >>> log_polar(image, torch.tensor([32.0, 24.0]), fovea=10.0).shape
    torch.Size([1, 3, 24, 64])
    """
    retina = _Retina(fovea, spacing, pooling)
    points = as_points(gaze)
    if is_single_picture(image):
        levels = _pyramid(as_images(image), retina)
        row = of_one_picture(points)
        return log_polar(levels, row, fovea=fovea, spacing=spacing, pooling=pooling)[0]
    levels = image if isinstance(image, tuple) else _pyramid(as_batch(image), retina)
    cortical = _sample(levels, fixations(points, levels[0]), retina)
    return cortical if points.ndim == 3 else cortical[:, 0]


def _pyramid(images: Tensor, retina: _Retina) -> _Levels:
    """Compute the levels of images `(B, C, H, W)` that the receptors of a retina sample."""
    return gaussian_pyramid(images, retina.levels(_size(images)))


def from_log_polar(
    cortical: Tensor, gaze: Tensor, size: tuple[int, int], *, fovea: float, spacing: float = 1.0
) -> Tensor:
    """Project cortical images back to images, by bicubic interpolation between receptors.

    Within the innermost ring, a point is interpolated between this ring and its opposite side.

    Args:
        cortical: `(B, C, M, N)` or `(B, G, C, M, N)`, from `log_polar`.
        gaze: the fixations of the cortical images, as for `log_polar`.
        size: `(width, height)` of the image.
        fovea: a in pixels, as for `log_polar`.
        spacing: δ in pixels, as for `log_polar`.

    Returns:
        Images `(B, C, height, width)` or `(B, G, C, height, width)`.

    Raises:
        InputError: a shape does not fit, the gaze is not finite, or a setting is not positive.

    >>> image, gaze = torch.full((1, 3, 48, 64), 0.25), torch.tensor([32.0, 24.0])
    >>> view = from_log_polar(log_polar(image, gaze, fovea=10.0), gaze, (64, 48), fovea=10.0)
    >>> torch.allclose(view, image)
    True
    """
    check(min(size) >= 1, "size", "(width, height) of at least one pixel", size)
    retina = _Retina(fovea, spacing)
    check_shape(cortical, "cortical", None, None, *retina.receptors(size))
    fixation = fixations(gaze, cortical)
    if gaze.ndim == 3:
        check(cortical.ndim == 5, "cortical", "5 dimensions with a gaze of this shape", cortical.ndim)
        return _project(cortical, fixation, size, retina)
    check(cortical.ndim == 4, "cortical", "4 dimensions with a gaze of this shape", cortical.ndim)
    return _project(cortical[:, None], fixation, size, retina)[:, 0]


class LogPolar(Sensor):
    """A sensor with receptors on rings, see `log_polar`; its views are back-projections of the cortical images.

    Args:
        fovea: eccentricity in pixels at which acuity is half the acuity at the fixation.
        spacing: distance between neighbouring receptors at the fixation, in pixels.
        pooling: width of receptive fields, as a multiple of the distance between neighbours.

    >>> sensor = LogPolar(20.0)
    >>> image = torch.rand(2, 3, 64, 64)
    >>> sensor.cortical(image, torch.tensor([16.0, 32.0])).shape
    torch.Size([2, 3, 37, 124])
    >>> sensor(image, torch.tensor([16.0, 32.0])).shape
    torch.Size([2, 3, 64, 64])
    """

    kind = "log-polar"
    names = ("fovea", "spacing", "pooling")

    def __init__(self, fovea: float, spacing: float = 1.0, pooling: float = 1.0) -> None:
        super().__init__()
        self.retina = _Retina(fovea, spacing, pooling)

    def pyramid(self, image: ImageLike) -> _Levels:
        """Compute the part of the work that does not depend on the gaze, to share it among fixations.

        Args:
            image: images `(B, C, H, W)`, or one picture of any common type (`semfov.as_image`).

        Returns:
            Levels of the Gaussian pyramid, finest first.
        """
        return _pyramid(as_batch(image), self.retina)

    def cortical(self, image: ImageLike | _Levels, gaze: PointLike) -> Tensor:
        """Compute cortical images, see `log_polar`.

        Args:
            image: images, or their levels from `pyramid`, as for `log_polar`.
            gaze: fixations `(x, y)` in image pixels, as for `log_polar`.

        Returns:
            Cortical images, in the shapes of `log_polar`.
        """
        retina = self.retina
        return log_polar(image, gaze, fovea=retina.fovea, spacing=retina.spacing, pooling=retina.pooling)

    def forward(self, image: ImageLike | _Levels, gaze: PointLike) -> Tensor:
        """Compute the back-projection of the cortical images of fixations.

        Args:
            image: images, or their levels from `pyramid`, as for `log_polar`.
            gaze: fixations `(x, y)` in image pixels, as for `log_polar`.

        Returns:
            Images `(B, C, H, W)`, or `(B, G, C, H, W)` for G fixations; of one picture `(3, H, W)` or `(G, 3, H, W)`.
        """
        points = as_points(gaze)
        if is_single_picture(image):
            return self(self.pyramid(image), of_one_picture(points))[0]
        levels = image if isinstance(image, tuple) else self.pyramid(image)
        cortical = self.cortical(levels, points)
        retina = self.retina
        return from_log_polar(cortical, points, _size(levels[0]), fovea=retina.fovea, spacing=retina.spacing)

    def open(self, canvas: Tensor, scale: Tensor) -> tuple[_Levels, _Retina]:
        """Compute the pyramid of a canvas, and scale the layout of the receptors."""
        scale_x, scale_y = scale.tolist()
        retina = replace(self.retina, scale=(scale_x, scale_y))
        return _pyramid(canvas, retina), retina

    def look(self, state: tuple[_Levels, _Retina], gaze: Tensor) -> Tensor:
        """Compute back-projections `(F, 3, H, W)` of the cortical images of fixations `(F, 2)`."""
        levels, retina = state
        fixation = fixations(gaze[None], levels[0])  # (1, F, 2)
        cortical = _sample(levels, fixation, retina)
        return _project(cortical, fixation, _size(levels[0]), retina)[0]

    def settings(self) -> dict[str, object]:
        """List the settings that the views depend on."""
        retina = self.retina
        return {"kind": self.kind, "fovea": retina.fovea, "spacing": retina.spacing, "pooling": retina.pooling}

    @classmethod
    def width(cls, settings: Settings) -> float:
        """Return the eccentricity at which acuity is half the acuity at the fixation."""
        return float(settings["fovea"])


def _size(image: Tensor) -> tuple[int, int]:
    """Read the `(width, height)` of images `(B, C, H, W)`."""
    check_shape(image, "image", None, None, None, None)
    return image.shape[-1], image.shape[-2]


def _sample(levels: _Levels, fixation: Tensor, retina: _Retina) -> Tensor:
    """Compute the responses of receptors, each from the two levels of the pyramid that are nearest to its size.

    Args:
        levels: the pyramid, `(B, C, h, w)` each.
        fixation: `(B, G, 2)`, in pixels of the finest level.
        retina: layout of the receptors.

    Returns:
        Cortical images `(B, G, C, M, N)`.
    """
    finest = levels[0]
    size = _size(finest)
    offset = _places(retina.numbers, size, fixation.dtype, finest.device)
    rings = offset.shape[0]
    receptors = fixation[:, :, None, None] + offset
    # All levels cover the same area, so positions as fractions of the image's sides are valid for all of them.
    place = (2 * receptors + 1) / fixation.new_tensor(size) - 1
    by_level = []
    for level, first, weight in _shares(retina.numbers, size, finest.dtype, finest.device):
        if level >= len(levels):
            break
        last = first + len(weight)
        points = place[:, :, first:last].flatten(1, 2)
        image = levels[level].to(points)
        responses = F.grid_sample(image, points, "bicubic", "border", align_corners=False).to(finest)
        by_ring = responses.unflatten(2, (fixation.shape[1], last - first))
        weighted = by_ring * weight[:, None]
        by_level.append(F.pad(weighted, (0, 0, first, rings - last)))
    return torch.stack(by_level).sum(0).transpose(1, 2)


def _project(cortical: Tensor, fixation: Tensor, size: tuple[int, int], retina: _Retina) -> Tensor:
    """Project cortical images back, by bicubic interpolation between receptors.

    Args:
        cortical: `(B, G, C, M, N)`.
        fixation: their fixations, `(B, G, 2)` in image pixels.
        size: `(width, height)` of the images.
        retina: layout of the receptors.

    Returns:
        Images `(B, G, C, H, W)`.
    """
    batch, number, _, rings, wedges = cortical.shape
    radius, angle = _polar(fixation, size, retina.scale)
    # Numbers of rings and wedges, also between two: ρ / δ - ½ and θ N / 2π.
    ring = retina.fovea * torch.log1p(radius / retina.fovea) / retina.spacing - 0.5
    wedge = angle.remainder(2 * pi) * (wedges / (2 * pi))
    # Places in the extended image from -1 to 1: two more rings lie before the first, a wedge before and two behind.
    columns = 2 * (wedge + 1) / (wedges + 2) - 1
    rows = 2 * (ring + 2) / (rings + 1) - 1
    points = torch.stack([columns, rows], -1).flatten(0, 1)
    receptors = _extended(cortical).flatten(0, 1).to(points)
    images = F.grid_sample(receptors, points, "bicubic", "border", align_corners=True)
    return images.to(cortical).unflatten(0, (batch, number))


def _extended(cortical: Tensor) -> Tensor:
    """Continue cortical images by the neighbours that bicubic interpolation needs, `(…, M + 2, N + 3)`.

    Those of the innermost ring lie on the opposite side of the fixation, and the last wedge is next to the first.
    """
    half_turn = cortical.shape[-1] // 2
    opposite_rings = cortical[..., :2, :].flip(-2).roll(half_turn, -1)
    rings = torch.cat([opposite_rings, cortical], -2)
    before = rings[..., -1:]
    after = rings[..., :2]
    return torch.cat([before, rings, after], -1)


def _polar(fixation: Tensor, size: tuple[int, int], scale: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Compute the polar coordinates of all pixels around fixations.

    Args:
        fixation: `(B, G, 2)` in image pixels.
        size: `(width, height)` of the images.
        scale: image pixels for a pixel of the retina, along x and y.

    Returns:
        Distances in pixels of the retina, and angles in radians, `(B, G, H, W)`.
    """
    # Squares of longer distances overflow, and beyond this distance the view no longer changes.
    fixation = fixation.clamp(-_FARTHEST, _FARTHEST)
    x, y = (torch.arange(n, dtype=fixation.dtype, device=fixation.device) for n in size)
    x_scale, y_scale = fixation.new_tensor(scale)
    x_offset = ((x - fixation[..., :1]) / x_scale)[:, :, None, :]
    y_offset = ((y - fixation[..., 1:]) / y_scale)[:, :, :, None]
    squared = x_offset.square() + y_offset.square()
    # The angle is not defined at the fixation itself, so no gradient may flow through it there.
    is_middle = squared == 0
    one = torch.ones_like(squared)
    x_offset = torch.where(is_middle, one, x_offset)
    radius = torch.where(is_middle, one, squared).sqrt()
    angle = torch.atan2(y_offset.expand_as(x_offset), x_offset)
    return torch.where(is_middle, torch.zeros_like(squared), radius), angle


@constant
def _places(numbers: _Numbers, size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Lay out the receptors: positions relative to the fixation, `(M, N, 2)`, in image pixels."""
    retina = _Retina(*numbers)
    rings, wedges = retina.receptors(size)
    rho = (torch.arange(rings, dtype=torch.float64) + 0.5) * retina.spacing
    radius = retina.fovea * torch.expm1(rho / retina.fovea)
    angle = torch.arange(wedges, dtype=torch.float64) * (2 * pi / wedges)
    directions = torch.stack([angle.cos(), angle.sin()], -1)
    steps = directions * torch.tensor(retina.scale, dtype=torch.float64)
    return (radius[:, None, None] * steps).to(device, dtype)


@constant
def _shares(
    numbers: _Numbers, size: tuple[int, int], dtype: torch.dtype, device: torch.device
) -> list[tuple[int, int, Tensor]]:
    """List the levels of the pyramid that are read: number, first ring that reads it, and weights of the rings."""
    retina = _Retina(*numbers)
    rings, _ = retina.receptors(size)
    top = retina.levels(size)
    # A ring reads the two levels around its own, which need not be a whole number, with weights that sum to 1.
    levels = [min(retina.level(retina.eccentricity(ring)), top) for ring in range(rings)]
    shares = []
    for level in range(top + 1):
        readers = [ring for ring in range(rings) if abs(levels[ring] - level) < 1]
        if not readers:
            continue
        first = readers[0]
        last = readers[-1]
        weights = [1 - abs(ring_level - level) for ring_level in levels[first : last + 1]]
        shares.append((level, first, torch.tensor(weights, dtype=torch.float64).to(device, dtype)))
    return shares
