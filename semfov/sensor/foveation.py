"""The foveal sensor: an image that is sharp around a fixation and gets coarser away from it."""

from collections.abc import Mapping
from numbers import Real
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor, nn

from semfov.data.inputs import ImageLike, PointLike, as_batch, as_images, as_points, as_positions
from semfov.errors import check, lookup, values_known
from semfov.sensor.base import Sensor, fixations
from semfov.sensor.lines import constant, difference, empty
from semfov.sensor.pyramid import Bands, Convention, expand, expanding, laplacian_pyramid, reduce, widened
from semfov.threads import one_thread_if_small

# Elements of the views that are made together on a CPU; those of many views leave the processor's cache.
_TOGETHER = 1 << 21
_LARGE = 360  # pixels of the shorter side from which on the finest band is not computed for one fixation


@one_thread_if_small
def foveate(
    image: ImageLike | Bands,
    gaze: PointLike,
    *,
    sigma: float | Tensor,
    levels: int = 5,
    growth: float | Tensor = 2.0,
    convention: Convention = "kornia",
) -> Tensor:
    r"""Foveate images around fixations.

    Each band of a Laplacian pyramid is weighted with a Gaussian window around the fixation, and the pyramid is put
    together again (Almeida, Figueiredo, Bernardino and Santos-Victor, 2018):

    .. math:: R_K = G_K, \quad R_k = w_k L_k + \mathrm{expand}(R_{k+1}), \quad
              w_k(x, y) = \exp\left(-\frac{(x-x_0)^2 + (y-y_0)^2}{2 \sigma_k^2}\right), \quad
              \sigma_k = \sigma \cdot g^k

    which is `expand^K(G_K) + Σ_k expand^k(w_k L_k)`. (The factor g is ours: the authors' code has one window for all
    bands, g = 1.) The window of a band is evaluated at the positions of the band's pixels in the image. Pixel i of
    band k is at `(i + ½) · W / W_k − ½` in Kornia's pyramid, and at `2^k i` in OpenCV's.

    Args:
        image: `(B, C, H, W)`, or its pyramid from `Foveation.pyramid`, which any number of fixations can share (the
            pyramid then determines `levels` and `convention`); or one picture of any common type (`semfov.as_image`).
        gaze: fixation `(x, y)` in image pixels, inside or outside, as a tensor, an array, a tuple or a list. For a
            batch: `(2,)` for all images, `(B, 2)` for one fixation of each image, or `(B, G, 2)` for G of each. For
            one picture: `(2,)`, or `(G, 2)` for G fixations.
        sigma: width σ of the fovea in image pixels: a number, `()`, `(B,)`, or `(B, 2)` for widths along x and y.
            With infinity the result equals the image.
        levels: number of bands, K.
        growth: factor g by which the window of each coarser band is wider. With 1 all bands share one window; with 2
            acuity falls off gradually. `semfov.sensor.SENSORS` lists named settings.
        convention: convention of the pyramid, `kornia` or `opencv` (`semfov.sensor.pyramid`).

    Returns:
        Foveated images `(B, C, H, W)`, or `(B, G, C, H, W)` for G fixations; for one picture `(3, H, W)` or
        `(G, 3, H, W)`.

    Raises:
        InputError: a shape does not fit, the gaze is not finite, σ or growth is not positive, or the image is not a
            picture.
        DataError: a file cannot be read.

    >>> image = torch.rand(1, 3, 48, 64)
    >>> foveate(image, torch.tensor([32.0, 24.0]), sigma=10.0).shape
    torch.Size([1, 3, 48, 64])
    >>> foveate(image, torch.rand(1, 7, 2), sigma=10.0).shape
    torch.Size([1, 7, 3, 48, 64])
    >>> foveate(image[0], (32, 24), sigma=10.0).shape
    torch.Size([3, 48, 64])
    """
    gaze = as_points(gaze)
    if not (isinstance(image, Bands) or (isinstance(image, Tensor | np.ndarray) and image.ndim > 3)):
        points = gaze[None] if gaze.ndim == 2 else gaze
        bands = laplacian_pyramid(as_images(image), levels, convention)
        return foveate(bands, points, sigma=sigma, growth=growth)[0]
    source = image if isinstance(image, Bands) else as_batch(image)
    like = source.base if isinstance(source, Bands) else source
    fixation, many = fixations(gaze, like)
    for name, value in (("sigma", sigma), ("growth", growth)):
        known = not isinstance(value, Tensor) or values_known(value)
        if known and not (value > 0 if isinstance(value, Real) else bool((torch.as_tensor(value) > 0).all())):
            check(False, name, "a positive number", value.tolist() if isinstance(value, Tensor) else value)
    widths, (batch, number) = _widths(sigma, like), fixation.shape[:2]
    size = source.shape if isinstance(source, Bands) else tuple(source.shape[-2:])
    details = source.details if isinstance(source, Bands) else ()
    tensors = [each for each in (*details, like, fixation, widths, growth) if isinstance(each, Tensor)]
    recorded = torch.is_grad_enabled() and any(each.requires_grad for each in tensors)
    plain = like.device.type == "cpu" and not recorded and values_known(*tensors)
    whole = plain and number == 1 and levels > 0 and min(size) >= _LARGE
    step = max(1, _TOGETHER // max(1, like.shape[1] * size[0] * size[1]))

    def pyramid(some: slice) -> tuple[Bands, Tensor | None]:
        if isinstance(source, Bands):
            return Bands(tuple(band[some] for band in source.details), source.base[some], source.convention), None
        if not whole:
            return laplacian_pyramid(source[some], levels, convention), None
        image = widened(source[some])
        half = reduce(image, convention)
        rest = laplacian_pyramid(half, levels - 1, convention)
        return Bands((image, *rest.details), rest.base, convention), half

    if not plain or batch * number <= step:
        views = _collapse(*pyramid(slice(None)), fixation, widths, growth).to(like.dtype)
        return views if many else views[:, 0]
    views = empty(like, batch, number, like.shape[1], *size)
    for b in (slice(n, n + max(1, step // number)) for n in range(0, batch, max(1, step // number))):
        own = pyramid(b)
        for g in (slice(n, n + step) for n in range(0, number, step)):
            _collapse(*own, fixation[b, g], widths[b], growth, views[b, g])
    return views if many else views[:, 0]


class Foveation(Sensor):
    r"""A foveal sensor, the module form of `foveate`.

    A canvas may be s times as large as the image that σ is meant for. Distances on it are then s times as long, and
    the detail of a band of the image is :math:`\log_2 s` bands coarser on the canvas. The widths

    .. math:: \sigma_k' = s \, \sigma \, \mathrm{growth}^{k - \log_2 s}, \qquad
              \sigma' = \sigma \, s^{1 - \log_2 \mathrm{growth}}

    keep the same detail at the same distance from the fovea. (With growth 2, acuity as a function of eccentricity has
    no scale of its own, and σ' = σ.)

    Args:
        sigma: width of the fovea in image pixels; a tensor with gradients stays in the graph.
        levels: number of bands of the pyramid.
        growth: factor by which the window of each coarser band is wider; a tensor with gradients stays in the graph.
        convention: convention of the pyramid, `kornia` or `opencv`.
        learnable: make σ a learnable parameter (its logarithm is learned, so that σ stays positive).

    >>> sensor = Foveation(20.0)
    >>> bands = sensor.pyramid(torch.rand(2, 3, 64, 64))
    >>> views = [sensor(bands, torch.tensor([x, 32.0])) for x in (16.0, 48.0)]
    """

    kind = "foveation"
    names = ("sigma", "levels", "growth", "convention")

    def __init__(
        self,
        sigma: float | Tensor,
        levels: int = 5,
        growth: float | Tensor = 2.0,
        convention: Convention = "kornia",
        *,
        learnable: bool = False,
    ) -> None:
        super().__init__()
        for name, value in (("sigma", sigma), ("growth", growth)):
            got = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else value
            check(value.numel() == 1 if isinstance(value, Tensor) else isinstance(value, Real), name, "a number", got)
            check(bool(value > 0), name, "a positive number", value)
        check(levels >= 0, "levels", "0 or more", levels)
        lookup(convention, get_args(Convention), "pyramid convention")
        self.levels = levels
        self.growth = growth
        self.convention: Convention = convention
        given = isinstance(sigma, Tensor) and sigma.requires_grad
        check(not (given and learnable), "learnable", "False for a sigma that is learned outside", learnable)
        self.given_sigma = sigma if isinstance(sigma, Tensor) and given else None
        log_sigma = None if given else torch.tensor(float(sigma)).log()
        self.log_sigma = None if log_sigma is None else nn.Parameter(log_sigma, requires_grad=learnable)

    @property
    def sigma(self) -> Tensor:
        """Width of the fovea in image pixels."""
        if self.log_sigma is not None:
            return self.log_sigma.exp()
        assert self.given_sigma is not None
        return self.given_sigma

    def pyramid(self, image: ImageLike) -> Bands:
        """Compute the part of the work that does not depend on the gaze, to share it among fixations.

        Args:
            image: images `(B, C, H, W)`, or one picture of any common type (`semfov.as_image`).

        Returns:
            The Laplacian pyramid.
        """
        return laplacian_pyramid(as_batch(image), self.levels, self.convention)

    def open(self, canvas: Tensor, scale: Tensor) -> tuple[Bands, Tensor]:
        """Compute the pyramid of a canvas, and scale the width of the fovea, `(1, 2)`."""
        shrink = scale[None].pow(1 - torch.as_tensor(self.growth).to(scale).log2())
        return self.pyramid(canvas), self.sigma * shrink

    def look(self, state: tuple[Bands, Tensor], gaze: Tensor) -> Tensor:
        """Foveate a canvas around fixations `(F, 2)`: views `(F, 3, H, W)`."""
        bands, sigma = state
        return foveate(bands, gaze[None], sigma=sigma, growth=self.growth)[0]

    def settings(self) -> dict[str, Any]:
        """List the settings that the views depend on."""
        return {
            "sigma": float(self.sigma.detach()),
            "levels": self.levels,
            "growth": float(torch.as_tensor(self.growth).detach()),
            "convention": self.convention,
        }

    @classmethod
    def width(cls, settings: Mapping[str, Any]) -> float:
        """Tell the width of the fovea, σ."""
        return float(settings["sigma"])

    @classmethod
    def describe(cls, settings: Mapping[str, Any]) -> str:
        """Describe width and growth of the fovea."""
        return f"σ {settings['sigma']:g} px, growth {settings['growth']:g}"

    def forward(self, image: ImageLike | Bands, gaze: PointLike) -> Tensor:
        """Foveate images around fixations.

        Args:
            image: images, or their pyramid, as for `foveate`.
            gaze: fixations `(x, y)` in image pixels, as for `foveate`.

        Returns:
            Foveated images, in the shapes of `foveate`.
        """
        return foveate(
            image, gaze, sigma=self.sigma, levels=self.levels, growth=self.growth, convention=self.convention
        )


def _collapse(
    bands: Bands,
    half: Tensor | None,
    fixation: Tensor,
    sigma: Tensor,
    growth: float | Tensor,
    out: Tensor | None = None,
) -> Tensor:
    r"""Put the pyramid together around `(B, G, 2)` fixations: `(B, G, C, H, W)`, into `out` if it is given.

    With G₁, `half`, the first detail is the image itself, for one fixation of each. Then
    :math:`R_0 = w_0 G_0 + (\mathrm{expand}(R_1) - w_0 \mathrm{expand}(G_1))`, the difference in one product.
    """
    batch, many = fixation.shape[:2]
    if not bands.details:
        views = bands.base[:, None].repeat(1, many, 1, 1, 1)
        return views if out is None else out.copy_(views)
    bands = Bands(tuple(map(widened, bands.details)), widened(bands.base), bands.convention)
    result, windows = bands.base, _windows(bands, fixation, sigma, growth)
    in_place = values_known(result, windows[0][0])
    for k, (band, (across, down)) in reversed([*enumerate(zip(bands.details, windows, strict=True))]):
        window, detail = down[..., None] * across[..., None, :], band[:, None]
        size = band.shape[-2], band.shape[-1]
        if k == 0 and half is not None:
            lines = expanding((half.shape[-2], half.shape[-1]), size, bands.convention, half.dtype, half.device)
            weights = zip(down.flatten(1), across.flatten(1), strict=True)
            views = torch.empty_like(detail, memory_format=torch.contiguous_format)
            for one, other, weight, view in zip(result, half, weights, views, strict=True):
                difference(one, other, *lines, weight, view[0])
        else:
            views = expand(result, size, bands.convention)
            # All fixations share the coarsest level.
            views = views[:, None] if result is bands.base else views.view(batch, many, *detail.shape[2:])
        if k == 0 and out is not None and out.dtype == views.dtype:
            return torch.addcmul(views, window, detail, out=out)
        # In place where no graph is traced and the views exist, which avoids allocating memory.
        fits = in_place and views.shape[1] == many
        result = (views.addcmul_ if fits else views.addcmul)(window, detail).flatten(0, 1)
    views = result.unflatten(0, (batch, many))
    return views if out is None else out.copy_(views)


def _windows(bands: Bands, fixation: Tensor, sigma: Tensor, growth: float | Tensor) -> list[tuple[Tensor, Tensor]]:
    """Gaussian windows `(B, G, 1, w_k)` along x and `(B, G, 1, h_k)` along y for every band, from one exponential."""
    sizes = tuple((band.shape[-2], band.shape[-1]) for band in bands.details)
    place, power, axis, level = _layout(sizes, bands.convention, sigma.dtype, sigma.device)
    least = torch.finfo(sigma.dtype).tiny  # a width that underflows to 0 would give 0 / 0 at the fixation
    widths = (sigma[..., None] * (growth**power).clamp(min=least)).clamp(min=least).flatten(1)
    offset = (place - fixation.index_select(-1, axis)) / widths.index_select(-1, level)[:, None]
    weights = offset.square().mul(-0.5).exp().to(bands.base.dtype)[:, :, None]
    pieces = weights.split([n for size in sizes for n in reversed(size)], -1)
    return list(zip(pieces[0::2], pieces[1::2], strict=True))


def _pixel_positions(count: int, length: int, k: int, convention: Convention) -> Tensor:
    """Positions of the `count` pixels of band k along an image side of `length` pixels: `(count,)`, float64."""
    place = torch.arange(count, dtype=torch.float64)
    return place * 2**k if convention == "opencv" else (place + 0.5) * (length / count) - 0.5


@constant
def _layout(
    sizes: tuple[tuple[int, int], ...], convention: Convention, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Positions of the pixels along x and y of every band, exponents of the growth, and indices of axes and widths."""
    lines = [(axis, k) for k in range(len(sizes)) for axis in (0, 1)]
    place = [_pixel_positions(sizes[k][1 - axis], sizes[0][1 - axis], k, convention) for axis, k in lines]
    counts = torch.tensor([sizes[k][1 - axis] for axis, k in lines])
    axes, levels = (torch.tensor(n).repeat_interleave(counts) for n in zip(*lines, strict=True))
    power = torch.arange(len(sizes))
    return (
        torch.cat(place).to(device, dtype),
        power.to(device, dtype),
        axes.to(device),
        (axes * len(sizes) + levels).to(device),
    )


def _widths(sigma: float | Tensor, like: Tensor) -> Tensor:
    """σ along x and y for every image, `(B, 2)`."""
    # A number that is filled in on a GPU is not waited for; one that is copied there is.
    number = like.new_full((), float(sigma), dtype=torch.float64) if isinstance(sigma, Real) else torch.as_tensor(sigma)
    width = as_positions(number, like)
    batch = like.shape[0]
    fits = width.ndim == 0 or (width.shape[0] in (1, batch) and width.shape[1:] in ((), (2,)))
    check(fits, "sigma", f"a number or shape (), ({batch},) or ({batch}, 2)", tuple(width.shape))
    return (width[:, None] if width.ndim == 1 else width).expand(batch, 2)
