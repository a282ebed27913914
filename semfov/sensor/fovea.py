"""The Gaussian windows of a fovea in the bands of a Laplacian pyramid.

The windows of all bands and of both axes are one line of weights, computed by one exponential and then cut:

    | band 0, x | band 0, y | band 1, x | band 1, y | …

`_Lattice` says for each place of that line where in the image it lies, along which axis, and which width applies.
"""

from dataclasses import dataclass
from numbers import Real
from typing import Self

import torch
from torch import Tensor

from semfov.data.inputs import as_positions
from semfov.errors import InputError, check, values_known
from semfov.sensor.base import fixations
from semfov.sensor.constants import constant
from semfov.sensor.pyramid import Convention

Width = float | tuple[float | Tensor, float | Tensor] | Tensor
"""Width of a fovea: a number, a pair of numbers along x and y, or a tensor `()`, `(B,)` or `(B, 2)`."""


@dataclass(frozen=True)
class FovealWindow:
    """A Gaussian window of a band for G fixations of B images: weights of columns `(B, G, 1, w)`, rows `(B, G, 1, h)`.

    A Gaussian is separable: the weight of a pixel is that of its column times that of its row.
    """

    columns: Tensor
    rows: Tensor

    def plane(self) -> Tensor:
        """Compute the weights of the pixels, `(B, G, 1, h, w)`."""
        return self.rows[..., None] * self.columns[..., None, :]


@dataclass(frozen=True)
class Fovea:
    r"""Foveas at G fixations in each of B images, :math:`\sigma_k = \sigma \cdot g^k` wide in band k.

    Attributes:
        fixation: `(B, G, 2)`, `(x, y)` in image pixels.
        sigma: widths σ along x and y, `(B, 2)`, in image pixels.
        growth: factor g by which the window of each coarser band is wider.
    """

    fixation: Tensor
    sigma: Tensor
    growth: float | Tensor

    @classmethod
    def at(cls, gaze: Tensor, sigma: Width, growth: float | Tensor, images: Tensor) -> Self:
        """Make the foveas of images, and check their numbers.

        Args:
            gaze: fixations `(2,)`, `(B, 2)` or `(B, G, 2)`.
            sigma: width: a number, a pair of numbers along x and y, `()`, `(B,)`, or `(B, 2)` along x and y.
            growth: factor of the widths.
            images: `(B, ...)`, whose device and precision the fovea takes.

        Returns:
            The foveas.

        Raises:
            InputError: a shape does not fit, the gaze is not finite, or σ or growth is not positive.
        """
        fixation = fixations(gaze, images)
        width = _number_or_tensor(sigma, images)
        _check_positive(width, "sigma")
        _check_positive(growth, "growth")
        return cls(fixation, _widths(width, images), growth)

    def __getitem__(self, part: tuple[slice, slice]) -> Self:
        """Select images, and fixations of each."""
        return type(self)(self.fixation[part], self.sigma[part[0]], self.growth)

    @property
    def count(self) -> tuple[int, int]:
        """Numbers of images and of fixations of each, `(B, G)`."""
        return self.fixation.shape[0], self.fixation.shape[1]

    def tensors(self) -> list[Tensor]:
        """List the tensors that the windows depend on."""
        return [self.fixation, self.sigma, *([self.growth] if isinstance(self.growth, Tensor) else [])]

    def windows(
        self, sizes: tuple[tuple[int, int], ...], convention: Convention, dtype: torch.dtype
    ) -> tuple[FovealWindow, ...]:
        r"""Compute the windows :math:`w_k(x, y) = \exp(-((x - x_0)^2 + (y - y_0)^2) / 2 \sigma_k^2)` of all bands.

        Args:
            sizes: `(height, width)` of the bands, finest first; the first is the image's.
            convention: convention of the pyramid, which says where the pixels of a band lie.
            dtype: dtype of the weights.

        Returns:
            The window of each band.
        """
        lattice = _lattice(sizes, convention, self.sigma.dtype, self.sigma.device)
        tiny = torch.finfo(self.sigma.dtype).tiny  # a width that underflows to 0 would give 0 / 0 at the fixation
        growth = (self.growth**lattice.exponent).clamp(min=tiny)
        widths = (self.sigma[..., None] * growth).clamp(min=tiny).flatten(1)
        # The columns and the rows of all bands lie one after another: the windows of all are computed at once.
        centre = self.fixation.index_select(-1, lattice.axis)
        width = widths.index_select(-1, lattice.width)[:, None]
        distance = (lattice.place - centre) / width
        weights = distance.square().mul(-0.5).exp().to(dtype)[:, :, None]

        lengths: list[int] = []
        for height_of_band, width_of_band in sizes:
            lengths += [width_of_band, height_of_band]
        lines = weights.split(lengths, -1)
        columns_of_bands = lines[0::2]
        rows_of_bands = lines[1::2]
        pairs = zip(columns_of_bands, rows_of_bands, strict=True)
        return tuple(FovealWindow(columns, rows) for columns, rows in pairs)


@dataclass(frozen=True, eq=False)
class _Lattice:
    """The pixels of all bands along both axes, one line after the other: N of them in K bands.

    Attributes:
        place: position of each along its axis of the image, `(N,)`, in image pixels.
        axis: its axis, 0 for x and 1 for y, `(N,)`.
        width: index of its width among `(x, y) × K` widths, `(N,)`.
        exponent: exponents of the growth, 0 to K - 1, `(K,)`.
    """

    place: Tensor
    axis: Tensor
    width: Tensor
    exponent: Tensor


@constant
def _lattice(
    sizes: tuple[tuple[int, int], ...], convention: Convention, dtype: torch.dtype, device: torch.device
) -> _Lattice:
    """Lay out the pixels of bands of the sizes `(height, width)`."""
    places = []
    axes = []
    widths = []
    image = sizes[0][::-1]
    for k, (height, width) in enumerate(sizes):
        for axis, count in enumerate((width, height)):
            places.append(pixel_positions(count, image[axis], k, convention))
            axes.append(torch.full((count,), axis))
            widths.append(torch.full((count,), axis * len(sizes) + k))
    exponent = torch.arange(len(sizes)).to(device, dtype)
    all_places = torch.cat(places).to(device, dtype)
    axis_of_place = torch.cat(axes).to(device)
    width_of_place = torch.cat(widths).to(device)
    return _Lattice(all_places, axis_of_place, width_of_place, exponent)


def pixel_positions(count: int, length: int, k: int, convention: Convention) -> Tensor:
    """Compute where the pixels of a band lie along a side of the image.

    Args:
        count: number of pixels of the band along that side.
        length: number of pixels of the image along it.
        k: number of the band.
        convention: convention of the pyramid.

    Returns:
        Positions `(count,)` in image pixels, float64.
    """
    index = torch.arange(count, dtype=torch.float64)
    if convention == "opencv":
        return index * 2**k
    return (index + 0.5) * (length / count) - 0.5


def _check_positive(value: float | Tensor, name: str) -> None:
    """Raise `InputError` unless a number or all numbers of a tensor are positive; traced ones are not read."""
    if isinstance(value, Tensor) and not values_known(value):
        return
    is_positive = value > 0 if isinstance(value, Real) else bool((torch.as_tensor(value) > 0).all())
    if not is_positive:
        # The message copies the numbers from their device, which is waited for.
        got = value.tolist() if isinstance(value, Tensor) else value
        raise InputError(f"{name}: expected a positive number, got {got}")


def _number_or_tensor(sigma: Width, images: Tensor) -> float | Tensor:
    """Bring a pair of widths, along x and y of all images, to a tensor `(1, 2)`; others stay as they are."""
    if not isinstance(sigma, tuple | list):
        return sigma
    if not all(isinstance(width, Real) or (isinstance(width, Tensor) and width.ndim == 0) for width in sigma):
        return torch.as_tensor(sigma)
    check(len(sigma) == 2, "sigma", "a number, a pair (x, y) of numbers, or a tensor", sigma)
    if all(isinstance(width, Real) for width in sigma):
        return torch.tensor([sigma], dtype=torch.float64)
    # Gradients flow through the tensors of a pair.
    numbers = [width if isinstance(width, Tensor) else torch.tensor(width, dtype=torch.float64) for width in sigma]
    return torch.stack([as_positions(number, images) for number in numbers])[None]


def _widths(sigma: float | Tensor, images: Tensor) -> Tensor:
    """Bring σ to widths along x and y for every image, `(B, 2)`."""
    if isinstance(sigma, Real):
        # A number that is filled in on a GPU is not waited for; one that is copied there is.
        number = images.new_full((), float(sigma), dtype=torch.float64)
    else:
        number = torch.as_tensor(sigma)
    width = as_positions(number, images)
    batch = images.shape[0]
    shapes = [(), (1,), (batch,), (1, 2), (batch, 2)]
    expected = f"a number, a pair (x, y) of numbers, or shape (), ({batch},) or ({batch}, 2)"
    check(tuple(width.shape) in shapes, "sigma", expected, tuple(width.shape))
    if width.ndim == 1:
        width = width[:, None]  # the same along x and y
    return width.expand(batch, 2)
