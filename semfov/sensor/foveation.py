"""The foveal sensor: an image that is sharp around a fixation and gets coarser away from it.

`foveate` is a Laplacian pyramid (`semfov.sensor.pyramid`) whose bands are weighted with the windows of a fovea
(`semfov.sensor.fovea`) and put together again (`_reconstruct`). On a CPU, where no gradient and no graph is recorded,
the same views are made in blocks that stay in the processor's cache (`_foveate_in_blocks`), and those of one fixation
of a large image without its finest band (`_foveate_large`).
"""

import warnings
from collections.abc import Iterator, Sequence
from copy import deepcopy
from numbers import Real
from typing import Self, get_args

import torch
from torch import Tensor, nn

from semfov.data.inputs import ImageLike, PointLike, as_batch, as_images, as_points
from semfov.errors import check, lookup, values_known
from semfov.io.compatibility import Settings
from semfov.sensor.base import Sensor, is_single_picture, of_one_picture
from semfov.sensor.fovea import Fovea, FovealWindow, Width
from semfov.sensor.lines import difference, empty
from semfov.sensor.pyramid import Bands, Convention, expand, expanding, laplacian_pyramid, reduce, widened
from semfov.threads import one_thread_if_small

# Elements of the views of a block on a CPU; those of many views leave the processor's cache.
_BLOCK = 1 << 21
_SMALLEST_PICTURE = 64  # pixels of the shorter side; in smaller ones the first pixel may be meant
_LARGE = 360  # pixels of the shorter side from which on the finest band is not computed for one fixation


@one_thread_if_small
def foveate(
    image: ImageLike | Bands,
    gaze: PointLike,
    *,
    sigma: Width,
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
        sigma: width σ of the fovea in image pixels: a number, or a pair of numbers for widths along x and y; or a
            tensor `()`, `(B,)` for one width of each image, or `(B, 2)` for a pair of each. With infinity the result
            equals the image.
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
    points = as_points(gaze)
    if is_single_picture(image):
        bands = laplacian_pyramid(as_images(image), levels, convention)
        return foveate(bands, of_one_picture(points), sigma=sigma, growth=growth)[0]
    images = image if isinstance(image, Bands) else as_batch(image)
    like = _like(images)
    _warn_of_shares(points, _size(images))
    fovea = Fovea.at(points, sigma, growth, like)
    if _blocks_pay(images, fovea, levels):
        views = _foveate_in_blocks(images, fovea, levels, convention)
    else:
        views = _reconstruct(_bands(images, levels, convention), fovea).to(like.dtype)
    return views if points.ndim == 3 else views[:, 0]


def _warn_of_shares(points: Tensor, size: Sequence[int]) -> None:
    """Warn of fixations on a processor that look like shares of a picture `(height, width)`, not like its pixels."""
    if not points.is_floating_point() or points.device.type != "cpu" or not values_known(points):
        return
    in_first_pixel = bool(((points > 0) & (points < 1)).all())
    # In a picture of a few pixels, or of no points, that says nothing.
    if in_first_pixel and points.numel() and min(size) >= _SMALLEST_PICTURE:
        doubt = f"all fixations lie in the first pixel, such as {points.reshape(-1, 2)[0].tolist()}"
        warnings.warn(f"gaze: {doubt}; of shares of the picture take gaze * (width, height)", stacklevel=4)


def _reconstruct(bands: Bands, fovea: Fovea, into: Tensor | None = None) -> Tensor:
    r"""Put a pyramid together around fixations: :math:`R_K = G_K`, :math:`R_k = w_k L_k + \mathrm{expand}(R_{k+1})`.

    Args:
        bands: the bands `L_k` and the coarsest level `G_K` of B images.
        fovea: G fixations in each image, and the widths of the windows `w_k`.
        into: memory for the views, which may have another dtype.

    Returns:
        The views `R_0`, `(B, G, C, H, W)`; those of half precision in float32 on a CPU.
    """
    if not bands.details:
        return bands.base[:, None].repeat(1, fovea.count[1], 1, 1, 1)
    bands = bands.widened()
    windows = fovea.windows(bands.sizes, bands.convention, bands.base.dtype)
    return _collapse(bands, windows, into)


def _collapse(bands: Bands, windows: tuple[FovealWindow, ...], into: Tensor | None = None) -> Tensor:
    """Compute `views = w_k L_k + expand(views)` from the coarsest band to the finest, into `into` if it is given."""
    views = bands.base[:, None]  # all fixations share the coarsest level
    for k in reversed(range(len(windows))):
        expanded = _expand(views, bands.sizes[k], bands.convention)
        band = bands.details[k][:, None]
        memory = into if k == 0 else None  # which has the size of the finest band
        views = _blend(expanded, windows[k].plane(), band, memory)
    return views


def _expand(views: Tensor, size: tuple[int, int], convention: Convention) -> Tensor:
    """Enlarge views `(B, G, C, h, w)` to the `(height, width)` of the next finer band."""
    return expand(views.flatten(0, 1), size, convention).unflatten(0, views.shape[:2])


def _blend(views: Tensor, window: Tensor, band: Tensor, into: Tensor | None = None) -> Tensor:
    """Compute `views + window · band` with as little new memory as possible.

    Args:
        views: `(B, G, C, h, w)`, or `(B, 1, C, h, w)` if the fixations share it; it may be written over.
        window: weights `(B, G, 1, h, w)`.
        band: `(B, 1, C, h, w)`.
        into: memory for the result, of any dtype.

    Returns:
        `(B, G, C, h, w)`.
    """
    if into is not None and into.dtype == views.dtype:
        return torch.addcmul(views, window, band, out=into)
    # Writing over the views avoids allocating memory; a traced graph must not do it.
    has_room = views.shape[1] == window.shape[1]  # else the fixations share the views, and not the result
    if has_room and values_known(views, window, band):
        blended = views.addcmul_(window, band)
    else:
        blended = views.addcmul(window, band)
    return blended if into is None else into.copy_(blended)


def _blocks_pay(images: Tensor | Bands, fovea: Fovea, levels: int) -> bool:
    """Tell whether views can be written into memory block by block: on a CPU, without a gradient or a graph."""
    tensors = fovea.tensors()
    if isinstance(images, Bands):
        tensors += [*images.details, images.base]
        levels = len(images.details)
    else:
        tensors.append(images)
    recorded = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return levels > 0 and not recorded and fovea.sigma.device.type == "cpu" and values_known(*tensors)


def _foveate_in_blocks(images: Tensor | Bands, fovea: Fovea, levels: int, convention: Convention) -> Tensor:
    """Foveate images on a CPU so that the views which are made together stay in the processor's cache.

    Args:
        images: `(B, C, H, W)`, or their pyramid.
        fovea: G fixations in each image.
        levels: number of bands of images that are not split yet.
        convention: convention of their pyramid.

    Returns:
        Views `(B, G, C, H, W)` with the dtype of the images.
    """
    like = _like(images)
    height, width = _size(images)
    channels = like.shape[1]
    batch, number = fovea.count
    block = max(1, _BLOCK // max(1, channels * height * width))  # views that are made together
    if batch * number <= block:
        return _foveate_block(images, fovea, levels, convention).to(like.dtype)
    views = empty(like, batch, number, channels, height, width)
    for rows in _slices(batch, max(1, block // number)):
        if number <= block:
            _foveate_block(images[rows], fovea[rows, :], levels, convention, views[rows])
        else:
            # All fixations of an image share its pyramid.
            bands = _bands(images[rows], levels, convention)
            for columns in _slices(number, block):
                _reconstruct(bands, fovea[rows, columns], views[rows, columns])
    return views


def _foveate_block(
    images: Tensor | Bands,
    fovea: Fovea,
    levels: int,
    convention: Convention,
    into: Tensor | None = None,
) -> Tensor:
    """Foveate images on a CPU at once, by the faster one of two ways; arguments and result as of `_foveate_large`."""
    if isinstance(images, Tensor) and fovea.count[1] == 1 and min(images.shape[-2:]) >= _LARGE:
        return _foveate_large(images, fovea, levels, convention, into)
    return _reconstruct(_bands(images, levels, convention), fovea, into)


def _foveate_large(
    images: Tensor, fovea: Fovea, levels: int, convention: Convention, into: Tensor | None = None
) -> Tensor:
    r"""Foveate large images around one fixation each without their finest band, which no other fixation would share.

    With :math:`L_0 = G_0 - \mathrm{expand}(G_1)`, the finest level is
    :math:`R_0 = w_0 G_0 + (\mathrm{expand}(R_1) - w_0 \, \mathrm{expand}(G_1))`, the difference in one product.

    Args:
        images: `(B, C, H, W)` on a CPU.
        fovea: one fixation in each image.
        levels: number of bands, at least 1.
        convention: convention of the pyramid.
        into: memory for the views, which may have another dtype.

    Returns:
        Views `(B, 1, C, H, W)`; those of half precision in float32.
    """
    image = widened(images)  # G_0
    half = reduce(image, convention)  # G_1
    rest = laplacian_pyramid(half, levels - 1, convention)
    size = (image.shape[-2], image.shape[-1])
    finest, *coarser = fovea.windows((size, *rest.sizes), convention, image.dtype)
    coarse = _collapse(rest, tuple(coarser))[:, 0]  # R_1
    lines = expanding(rest.shape, size, convention, half.dtype, half.device)
    differences = torch.empty_like(image, memory_format=torch.contiguous_format)
    weights = zip(finest.rows.flatten(1), finest.columns.flatten(1), strict=True)
    for coarse_planes, half_planes, weight, result in zip(coarse, half, weights, differences, strict=True):
        difference(coarse_planes, half_planes, *lines, weight, result)
    return _blend(differences[:, None], finest.plane(), image[:, None], into)


def _slices(count: int, step: int) -> Iterator[slice]:
    """Cut `count` rows into parts of at most `step`."""
    for first in range(0, count, step):
        yield slice(first, first + step)


def _like(images: Tensor | Bands) -> Tensor:
    """Give a tensor with the batch, the channels, the dtype and the device of images, or of their pyramid."""
    return images.base if isinstance(images, Bands) else images


def _size(images: Tensor | Bands) -> tuple[int, int]:
    """Read the `(height, width)` of images, or of those of a pyramid."""
    return images.shape if isinstance(images, Bands) else (images.shape[-2], images.shape[-1])


def _bands(images: Tensor | Bands, levels: int, convention: Convention) -> Bands:
    """Split images into bands, unless they are split already."""
    return images if isinstance(images, Bands) else laplacian_pyramid(images, levels, convention)


class Foveation(Sensor):
    r"""A foveal sensor, the module form of `foveate`.

    A canvas may be s times as large as the image that σ is meant for. Distances on it are then s times as long, and
    the detail of a band of the image is :math:`\log_2 s` bands coarser on the canvas. The widths

    .. math:: \sigma_k' = s \, \sigma \, \mathrm{growth}^{k - \log_2 s}, \qquad
              \sigma' = \sigma \, s^{1 - \log_2 \mathrm{growth}}

    keep the same detail at the same distance from the fovea. (With growth 2, acuity as a function of eccentricity has
    no scale of its own, and σ' = σ.)

    Args:
        sigma: width of the fovea in pixels of the image that it is called with (a `semfov.Eye` brings pictures to one
            size before, its `reference`); a tensor with gradients stays in the graph. It is in the module's state if it
            is an `nn.Parameter`; another one stays with the caller, and one that was computed cannot be deep-copied.
        levels: number of bands of the pyramid.
        growth: factor by which the window of each coarser band is wider; a tensor with gradients as for `sigma`.
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
        _check_setting(sigma, "sigma")
        _check_setting(growth, "growth")
        check(levels >= 0, "levels", "0 or more", levels)
        lookup(convention, get_args(Convention), "pyramid convention")
        self.levels = levels
        self.growth = growth
        self.convention: Convention = convention
        if isinstance(sigma, Tensor) and sigma.requires_grad:
            check(not learnable, "learnable", "False for a sigma that is learned outside", learnable)
            self.given_sigma: Tensor | None = sigma
            self.log_sigma: nn.Parameter | None = None
        else:
            self.given_sigma = None
            self.log_sigma = nn.Parameter(torch.tensor(float(sigma)).log(), requires_grad=learnable)

    def __deepcopy__(self, memo: dict[int, object]) -> Self:
        """Copy the sensor; raises `InputError` for a σ or a growth that was computed, which PyTorch does not copy."""
        for name, value in (("sigma", self.given_sigma), ("growth", self.growth)):
            is_computed = isinstance(value, Tensor) and not value.is_leaf
            remedy = f"one that was computed with gradients; make the copy anew, with {name}={name}.detach() or without"
            check(not is_computed, name, "a number, a parameter or another leaf where a sensor is copied", remedy)
        copied = type(self).__new__(type(self))
        memo[id(self)] = copied
        copied.__setstate__(deepcopy(self.__dict__, memo))
        return copied

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

    def settings(self) -> dict[str, object]:
        """List the settings that the views depend on."""
        return {
            "sigma": float(self.sigma.detach()),
            "levels": self.levels,
            "growth": float(torch.as_tensor(self.growth).detach()),
            "convention": self.convention,
        }

    @classmethod
    def width(cls, settings: Settings) -> float:
        """Return the width of the fovea, σ."""
        return float(settings["sigma"])

    @classmethod
    def describe(cls, settings: Settings) -> str:
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


def _check_setting(value: float | Tensor, name: str) -> None:
    """Raise `InputError` unless this is a positive number, or a tensor that holds one."""
    if isinstance(value, Tensor):
        check(value.numel() == 1, name, "a number", f"shape {tuple(value.shape)}")
    else:
        check(isinstance(value, Real), name, "a number", value)
    check(bool(value > 0), name, "a positive number", value)
