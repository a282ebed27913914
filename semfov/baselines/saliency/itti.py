"""The saliency model of Itti, Koch and Niebur: centre-surround differences of colour, intensity and orientation."""

from math import pi

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.baselines.saliency.blur import rescale
from semfov.baselines.saliency.opponent import anchor, double_opponency
from semfov.data.inputs import ImageLike, as_batch
from semfov.sensor.constants import constant
from semfov.sensor.pyramid import pyrdown

_CENTRES = (2, 3, 4)
_DELTAS = (3, 4)
_ORIENTATIONS = (0.0, 45.0, 90.0, 135.0)

# Itti, Koch and Niebur (1998) print no sizes of their Gabor filters; these are the SaliencyToolbox's (Walther and
# Koch, 2006).
_TAPS = 9
_PERIOD = 7.0
_SIGMA = 7 / 3

# Lower maxima of a map do not count (Walther and Koch, 2006).
_PEAK = 0.1

# Maps with a smaller range, in units of the rounding error at 1, hold rounding errors alone. Scaling would amplify
# them.
_FLAT = 32


def _dyadic_pyramid(channels: Tensor, levels: int) -> list[Tensor]:
    """Compute the dyadic Gaussian pyramid (`cv2.pyrDown`) of channels `(B, C, H, W)`, finest level first."""
    pyramid = [channels]
    for _ in range(levels):
        pyramid.append(pyrdown(pyramid[-1], "opencv"))
    return pyramid


@constant
def _gabor_kernels(dtype: torch.dtype, device: torch.device) -> Tensor:
    r"""Make even and odd Gabor filters, weights of a convolution `(2n, 1, 9, 9)`, of mean 0 and absolute sum 1.

    .. math:: g_\phi(x, y) = \cos(2\pi u / 7 + \phi) \exp(-(x^2 + y^2) / 2\sigma^2), \quad
        u = x \cos\theta + y \sin\theta, \quad \phi \in \{0, \pi/2\}, \quad \sigma = 7/3
    """
    place = torch.arange(_TAPS, dtype=torch.float64) - _TAPS // 2
    y = place[:, None]
    x = place[None, :]
    envelope = torch.exp(-(x**2 + y**2) / (2 * _SIGMA**2))  # (9, 9)
    degrees = torch.tensor(_ORIENTATIONS, dtype=torch.float64)
    theta = (degrees * (pi / 180))[:, None, None]
    u = x * theta.cos() + y * theta.sin()  # (n, 9, 9)
    phase = 2 * pi / _PERIOD * u
    waves = torch.stack([phase.cos(), -phase.sin()], 1).flatten(0, 1)  # (2n, 9, 9), even and odd by turns
    kernels = waves * envelope
    kernels = kernels - kernels.mean((-2, -1), keepdim=True)
    kernels = kernels / kernels.abs().sum((-2, -1), keepdim=True)
    return kernels.to(device, dtype)[:, None]


def _promote(maps: Tensor) -> Tensor:
    """Promote maps with few peaks: `N(M) = M (1 - m)²` of Itti, Koch and Niebur (1998).

    m is the mean of the local maxima above 0.1 other than the largest; a map of rounding errors alone becomes 0.

    Args:
        maps: M, `(..., h, w)`.

    Returns:
        N(M), `(..., h, w)`.
    """
    maps = rescale(maps, _FLAT * torch.finfo(maps.dtype).eps)
    peaks = _local_maxima(maps) & (maps > _PEAK)
    count = peaks.sum((-2, -1), keepdim=True)
    total = (maps * peaks).sum((-2, -1), keepdim=True)
    # The largest maximum is exactly 1, and is always among the peaks.
    mean_of_others = (total - 1) / (count - 1).clamp(min=1)
    m = torch.where(count > 1, mean_of_others, 0.0)
    return maps * (1 - m) ** 2


def _local_maxima(maps: Tensor) -> Tensor:
    """Tell which pixels of maps `(..., h, w)` are above their earlier neighbours and no less than their later ones.

    Earlier and later are in row-major order, so that of equal neighbours one alone is a maximum.
    """
    height, width = maps.shape[-2:]
    padded = F.pad(maps, (1, 1, 1, 1), value=-torch.inf)
    west = padded[..., :width]
    east = padded[..., 2:]
    rows = torch.maximum(torch.maximum(west, east), padded[..., 1:-1])
    row_above = rows[..., :height, :]
    row_below = rows[..., 2:, :]
    earlier = torch.maximum(row_above, west[..., 1:-1, :])
    later = torch.maximum(row_below, east[..., 1:-1, :])
    return (maps > earlier) & (maps >= later)


def _conspicuity(image: Tensor) -> Tensor:
    r"""Compute conspicuity maps of intensity, colour and orientation at scale 4 (Itti, Koch and Niebur, 1998).

    .. math:: \bar I = \bigoplus_{c,s} N(I_{c,s}), \quad
        \bar C = \bigoplus_{c,s} N(RG_{c,s}) + N(BY_{c,s}), \quad
        \bar O = \sum_\theta N\Bigl(\bigoplus_{c,s} N(O_{c,s,\theta})\Bigr)

    over centres c = 2, 3, 4 and surrounds s = c + 3, c + 4 of the Gaussian pyramid.

    Opponencies of the surround are subtracted as they are: with G - R in it (their equation 2, and 3 for B - Y) a
    uniform colour would respond most.

    Args:
        image: `(B, 3, H, W)`, RGB in [0, 1].

    Returns:
        `(B, 3, h, w)`.
    """
    levels = max(_CENTRES) + max(_DELTAS)
    pyramid = _dyadic_pyramid(anchor(double_opponency(image)), levels)
    finest = min(_CENTRES)
    features = {finest + number: _with_orientations(level) for number, level in enumerate(pyramid[finest:])}
    total = torch.zeros((), dtype=image.dtype, device=image.device)
    for scale in _CENTRES:
        contrasts = [_contrast(features[scale], features[scale + delta]) for delta in _DELTAS]
        maps = _promote(torch.stack(contrasts, 1)).sum(1)
        # Across-scale addition happens at the coarsest centre.
        total = total + _dyadic_pyramid(maps, max(_CENTRES) - scale)[-1]
    intensity, colour, orientation = total.split([1, 2, len(_ORIENTATIONS)], 1)
    channels = [intensity, colour.sum(1, keepdim=True), _promote(orientation).sum(1, keepdim=True)]
    return torch.cat(channels, 1)


def _contrast(centre: Tensor, surround: Tensor) -> Tensor:
    """Compute the centre-surround difference of features `(B, C, h, w)` and of those at a coarser scale."""
    size = (centre.shape[-2], centre.shape[-1])
    enlarged = F.interpolate(surround, size, mode="bilinear", align_corners=False)
    return (centre - enlarged).abs()


def _with_orientations(level: Tensor) -> Tensor:
    """Append to a level `(B, 3, h, w)` the energy of each orientation of its intensity, |even| + |odd|."""
    intensity = F.pad(level[:, :1], (_TAPS // 2,) * 4, mode="replicate")
    responses = F.conv2d(intensity, _gabor_kernels(level.dtype, level.device))  # (B, 2n, h, w)
    even_and_odd = responses.abs().unflatten(1, (-1, 2))
    return torch.cat([level, even_and_odd.sum(2)], 1)


def itti_koch_saliency(image: Tensor, *, normalise: bool = True) -> Tensor:
    r"""Compute saliency by Itti, Koch and Niebur ("A model of saliency-based visual attention", PAMI 1998).

    .. math:: S = \tfrac{1}{3} (N(\bar I) + N(\bar C) + N(\bar O))

    It is computed at scale 4 and enlarged bilinearly to the size of the image; see `_conspicuity`.

    Args:
        image: `(B, 3, H, W)`, RGB in [0, 1].
        normalise: scale every map to [0, 1].

    Returns:
        `(B, H, W)`, saliency, 0 or more.

    Raises:
        InputError: the image is not `(B, 3, H, W)` of floating-point numbers, or is empty.

    >>> image = torch.zeros(1, 3, 192, 256)
    >>> image[:, 0, 80:96, 48:64] = 1.0
    >>> row, column = divmod(int(itti_koch_saliency(image).argmax()), 256)
    >>> 72 <= row < 104 and 40 <= column < 72
    True
    """
    # Peaks depend on the last digits of a map: in half precision nearly every pixel is one, and no saliency remains.
    with torch.autocast(image.device.type, enabled=False):
        saliency = _promote(_conspicuity(image)).mean(1, keepdim=True)
    size = (image.shape[-2], image.shape[-1])
    saliency = F.interpolate(saliency, size, mode="bilinear", align_corners=False)[:, 0]
    return rescale(saliency) if normalise else saliency


class IttiKoch(nn.Module):
    """Saliency by Itti, Koch and Niebur as a module; see `itti_koch_saliency`.

    Args:
        normalise: scale every map to [0, 1].

    >>> IttiKoch()(torch.rand(2, 3, 32, 48)).shape
    torch.Size([2, 32, 48])
    """

    def __init__(self, *, normalise: bool = True) -> None:
        super().__init__()
        self.normalise = normalise

    def forward(self, image: ImageLike) -> Tensor:
        """Compute the saliency of images.

        Args:
            image: `(B, 3, H, W)`, RGB in [0, 1], or one picture of any common type (`semfov.as_image`).

        Returns:
            `(B, H, W)`.
        """
        return itti_koch_saliency(as_batch(image), normalise=self.normalise)
