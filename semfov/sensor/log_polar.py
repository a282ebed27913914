"""The log-polar sensor: a cortical image of receptors that stand ever wider apart, and what it shows on the canvas."""

from dataclasses import dataclass
from math import ceil, exp, hypot, inf, log1p, log2, pi, sqrt
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.errors import check, check_shape
from semfov.sensor.base import Sensor, fixations
from semfov.sensor.lines import constant
from semfov.sensor.pyramid import gaussian_pyramid

Levels = tuple[Tensor, ...]
"""A Gaussian pyramid, finest level first."""

_TALLEST = 30  # levels of a pyramid; an image with sides of 2^30 pixels is a single pixel then
_MOST = 2**26  # receptors
_FARTHEST = 1e15  # pixels from the image to a fixation


@dataclass(frozen=True)
class Retina:
    """Where receptors stand, in pixels of an image.

    Attributes:
        fovea: eccentricity a in units of one's own, at which they stand twice as far apart as in the middle.
        spacing: distance δ of neighbours in the middle, in the same units.
        pooling: width of a receptive field in distances of neighbours.
        scale: image pixels for each unit, along x and y.
    """

    fovea: float
    spacing: float = 1.0
    pooling: float = 1.0
    scale: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("fovea", "spacing", "pooling"):
            value = getattr(self, name)
            check(0 < value < inf, name, "a positive number", value)

    def receptors(self, size: tuple[int, int]) -> tuple[int, int]:
        """`(rings, wedges)` that reach from any pixel of an image of `(width, height)` to any other."""
        wedges = 4 * max(1, round(pi * self.fovea / (2 * self.spacing)))
        rings = 2 + ceil(self.fovea * log1p(self._reach(size) / self.fovea) / self.spacing)
        check(rings * wedges <= _MOST, "spacing", f"one that leaves no more than {_MOST:,} receptors", self.spacing)
        return rings, wedges

    def levels(self, size: tuple[int, int]) -> int:
        """How often an image of `(width, height)` has to be halved for its widest receptive field."""
        return ceil(self.level(self._reach(size)))

    def level(self, eccentricity: float) -> float:
        """Level of a Gaussian pyramid, whole or between two, whose pixels are as large as a receptive field."""
        field = self.pooling * self.spacing * (1 + eccentricity / self.fovea) * sqrt(self.scale[0] * self.scale[1])
        return min(max(log2(field), 0.0), float(_TALLEST))

    def eccentricity(self, ring: int) -> float:
        """Distance from the fixation of the receptors of a ring."""
        return self.fovea * (exp((ring + 0.5) * self.spacing / self.fovea) - 1)

    def _reach(self, size: tuple[int, int]) -> float:
        return hypot(size[0] / self.scale[0], size[1] / self.scale[1])


def log_polar(
    image: Tensor | Levels, gaze: Tensor, *, fovea: float, spacing: float = 1.0, pooling: float = 1.0
) -> Tensor:
    r"""Cortical images: what receptors on rings around a fixation see.

    With the eccentricity r and the angle θ of a place relative to the fixation, the cortex has it at

    .. math:: \rho = a \ln\left(1 + \frac{r}{a}\right), \qquad \theta,

    so that ring i and wedge j look at :math:`\rho_i = (i + ½) \delta` and :math:`\theta_j = 2 \pi j / N`. Neighbours
    stand :math:`\delta (1 + r / a)` pixels apart: evenly up to about a, where it is twice as far as in the middle, and
    in proportion to the eccentricity beyond, as in the primate's cortex (:math:`\ln(z + a)`, Schwartz, 1980; Traver and
    Bernardino, 2010, review such maps). There are :math:`N = 2 \pi a / \delta` wedges (a multiple of 4), as far apart
    as the rings are where r is large.

    A receptor pools its surroundings. It reads a Gaussian pyramid, by cubics between pixels and linearly between
    levels, at level :math:`\log_2` of `pooling` times the distance of its neighbours (and the image itself where that
    is less than a pixel). Receptors beyond the image see its border.

    Args:
        image: `(B, C, H, W)`, or its levels from `LogPolar.pyramid`, which any number of fixations can share.
        gaze: fixation `(x, y)` in image pixels, inside or outside: `(2,)` for all images, `(B, 2)` one for each, or
            `(B, G, 2)` G for each.
        fovea: a in pixels.
        spacing: δ in pixels.
        pooling: width of receptive fields in distances of neighbours: less aliases, more blurs.

    Returns:
        `(B, C, M, N)`, or `(B, G, C, M, N)` for G fixations: M rings, of which the first is the innermost, and N wedges
        from the x-axis clockwise. The rings reach as far as the image's diagonal.

    Raises:
        InputError: a shape does not fit, the gaze is not finite, or a setting is not positive.

    >>> image = torch.rand(1, 3, 48, 64)
    >>> log_polar(image, torch.tensor([32.0, 24.0]), fovea=10.0).shape
    torch.Size([1, 3, 24, 64])
    """
    retina = Retina(fovea, spacing, pooling)
    levels = image if isinstance(image, tuple) else gaussian_pyramid(image, retina.levels(_size(image)))
    fixation, many = fixations(gaze, levels[0])
    result = _sample(levels, fixation, retina)
    return result if many else result[:, 0]


def from_log_polar(
    cortical: Tensor, gaze: Tensor, size: tuple[int, int], *, fovea: float, spacing: float = 1.0
) -> Tensor:
    """Back-projection: the image that a cortical image holds, interpolated by cubics between receptors.

    Across the fixation the innermost ring is its own neighbour, turned by half a turn.

    Args:
        cortical: `(B, C, M, N)` or `(B, G, C, M, N)`, of `log_polar`.
        gaze: where it was fixated, likewise.
        size: `(width, height)` of the image.
        fovea: as for `log_polar`.
        spacing: likewise.

    Returns:
        `(B, C, height, width)` or `(B, G, C, height, width)`.

    Raises:
        InputError: a shape does not fit, the gaze is not finite, or a setting is not positive.

    >>> image, gaze = torch.full((1, 3, 48, 64), 0.25), torch.tensor([32.0, 24.0])
    >>> view = from_log_polar(log_polar(image, gaze, fovea=10.0), gaze, (64, 48), fovea=10.0)
    >>> torch.allclose(view, image)
    True
    """
    check(min(size) >= 1, "size", "(width, height) of at least one pixel", size)
    retina = Retina(fovea, spacing)
    check_shape(cortical, "cortical", None, None, *retina.receptors(size))
    fixation, many = fixations(gaze, cortical)
    check(cortical.ndim == 4 + many, "cortical", f"{4 + many} dimensions beside such a gaze", cortical.ndim)
    result = _project(cortical if many else cortical[:, None], fixation, size, retina)
    return result if many else result[:, 0]


@dataclass(frozen=True)
class Opened:
    """A canvas as `LogPolar` holds it.

    Attributes:
        levels: its Gaussian pyramid.
        retina: receptors in pixels of the canvas.
    """

    levels: Levels
    retina: Retina


class LogPolar(Sensor):
    """A sensor with receptors on rings, see `log_polar`; a detector is shown the back-projection of what they see.

    Args:
        fovea: eccentricity in pixels at which acuity is half of what it is at the fixation.
        spacing: distance of receptors at the fixation, in pixels.
        pooling: width of receptive fields in distances of neighbours.

    >>> sensor = LogPolar(20.0)
    >>> image = torch.rand(2, 3, 64, 64)
    >>> sensor.cortical(image, torch.tensor([16.0, 32.0])).shape
    torch.Size([2, 3, 37, 124])
    >>> sensor(image, torch.tensor([16.0, 32.0])).shape
    torch.Size([2, 3, 64, 64])
    """

    def __init__(self, fovea: float, spacing: float = 1.0, pooling: float = 1.0) -> None:
        super().__init__()
        self.retina = Retina(fovea, spacing, pooling)

    def pyramid(self, image: Tensor) -> Levels:
        """The part of the work that does not depend on the gaze, for an image `(B, C, H, W)`."""
        return gaussian_pyramid(image, self.retina.levels(_size(image)))

    def cortical(self, image: Tensor | Levels, gaze: Tensor) -> Tensor:
        """Cortical images, see `log_polar`."""
        retina = self.retina
        return log_polar(image, gaze, fovea=retina.fovea, spacing=retina.spacing, pooling=retina.pooling)

    def back(self, cortical: Tensor, gaze: Tensor, size: tuple[int, int]) -> Tensor:
        """Back-projection of cortical images to images of `(width, height)`, see `from_log_polar`."""
        return from_log_polar(cortical, gaze, size, fovea=self.retina.fovea, spacing=self.retina.spacing)

    def forward(self, image: Tensor | Levels, gaze: Tensor) -> Tensor:
        """The back-projection of what is seen of an image, or of its levels, from `gaze`; shapes as for `foveate`."""
        finest = image[0] if isinstance(image, tuple) else image
        return self.back(self.cortical(image, gaze), gaze, _size(finest))

    def open(self, canvas: Tensor, scale: Tensor) -> Opened:
        """Build the pyramid of a canvas, and scale the receptors' places."""
        across, down = scale.tolist()
        own = self.retina
        retina = Retina(own.fovea, own.spacing, own.pooling, (across, down))
        return Opened(gaussian_pyramid(canvas, retina.levels(_size(canvas))), retina)

    def look(self, state: Opened, gaze: Tensor) -> Tensor:
        """Canvases `(F, 3, H, W)`: back-projections of what is seen from fixations `(F, 2)`."""
        fixation, _ = fixations(gaze[None], state.levels[0])
        seen = _sample(state.levels, fixation, state.retina)
        return _project(seen, fixation, _size(state.levels[0]), state.retina)[0]

    def settings(self) -> dict[str, Any]:
        """What its views depend on."""
        own = self.retina
        return {"kind": "log-polar", "fovea": own.fovea, "spacing": own.spacing, "pooling": own.pooling}

    def extra_repr(self) -> str:
        """Settings, for `repr`."""
        own = self.retina
        return f"fovea={own.fovea:g}, spacing={own.spacing:g}, pooling={own.pooling:g}"


def _size(image: Tensor) -> tuple[int, int]:
    check_shape(image, "image", None, None, None, None)
    return image.shape[-1], image.shape[-2]


def _sample(levels: Levels, fixation: Tensor, retina: Retina) -> Tensor:
    """What receptors around `(B, G, 2)` fixations see: `(B, G, C, M, N)`."""
    finest = levels[0]
    size = _size(finest)
    offset = _places(retina, size, finest.dtype, finest.device)
    # A level covers the image as its finest one does, so places as shares of the image's sides hold for all.
    place = (2 * (fixation[:, :, None, None] + offset) + 1) / finest.new_tensor(size) - 1
    rings, many = offset.shape[0], fixation.shape[1]
    parts = []
    for level, first, weight in _shares(retina, size, finest.dtype, finest.device):
        if level >= len(levels):
            break
        last = first + len(weight)
        where = place[:, :, first:last].flatten(1, 2)
        seen = F.grid_sample(levels[level], where, "bicubic", "border", align_corners=False)
        seen = seen.unflatten(2, (many, last - first)) * weight[:, None]
        parts.append(F.pad(seen, (0, 0, first, rings - last)))
    return torch.stack(parts).sum(0).transpose(1, 2)


def _project(cortical: Tensor, fixation: Tensor, size: tuple[int, int], retina: Retina) -> Tensor:
    """Images `(B, G, C, H, W)` from cortical ones `(B, G, C, M, N)` around `(B, G, 2)` fixations."""
    batch, many, _, rings, wedges = cortical.shape
    # Nothing changes any more where squares overflow.
    fixation = fixation.clamp(-_FARTHEST, _FARTHEST)
    x, y = (torch.arange(n, dtype=fixation.dtype, device=fixation.device) for n in size)
    scale = fixation.new_tensor(retina.scale)
    across = ((x - fixation[..., :1]) / scale[0])[:, :, None, :]
    down = ((y - fixation[..., 1:]) / scale[1])[:, :, :, None]
    squared = across.square() + down.square()
    # At the fixation itself no angle is there to differentiate.
    middle = squared == 0
    across = torch.where(middle, torch.ones_like(squared), across)
    radius = torch.where(middle, torch.ones_like(squared), squared).sqrt()
    angle = torch.atan2(down.expand_as(across), across)
    radius = torch.where(middle, torch.zeros_like(squared), radius)
    ring = retina.fovea * torch.log1p(radius / retina.fovea) / retina.spacing - 0.5
    wedge = angle.remainder(2 * pi) * (wedges / (2 * pi))
    # What cubics reach for beyond the innermost ring lies across the fixation, beyond the last wedge the first.
    whole = torch.cat([cortical[..., :2, :].flip(-2).roll(wedges // 2, -1), cortical], -2)
    whole = torch.cat([whole[..., -1:], whole, whole[..., :2]], -1).flatten(0, 1)
    where = torch.stack([2 * (wedge + 1) / (wedges + 2) - 1, 2 * (ring + 2) / (rings + 1) - 1], -1).flatten(0, 1)
    seen = F.grid_sample(whole, where, "bicubic", "border", align_corners=True)
    return seen.unflatten(0, (batch, many))


@constant
def _places(retina: Retina, size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Where receptors stand relative to the fixation, `(M, N, 2)`, in image pixels."""
    rings, wedges = retina.receptors(size)
    rho = (torch.arange(rings, dtype=torch.float64) + 0.5) * retina.spacing
    radius = retina.fovea * torch.expm1(rho / retina.fovea)
    angle = torch.arange(wedges, dtype=torch.float64) * (2 * pi / wedges)
    unit = torch.stack([angle.cos(), angle.sin()], -1) * torch.tensor(retina.scale, dtype=torch.float64)
    return (radius[:, None, None] * unit).to(device, dtype)


@constant
def _shares(
    retina: Retina, size: tuple[int, int], dtype: torch.dtype, device: torch.device
) -> list[tuple[int, int, Tensor]]:
    """Levels of the pyramid, the first ring that reads each, and the level's weights in its rings."""
    rings, top = retina.receptors(size)[0], retina.levels(size)
    levels = [min(retina.level(retina.eccentricity(ring)), top) for ring in range(rings)]
    found = []
    for level in range(top + 1):
        reading = [ring for ring in range(rings) if abs(levels[ring] - level) < 1]
        if reading:
            weight = [1 - abs(levels[ring] - level) for ring in range(reading[0], reading[-1] + 1)]
            found.append((level, reading[0], torch.tensor(weight, dtype=torch.float64).to(device, dtype)))
    return found
