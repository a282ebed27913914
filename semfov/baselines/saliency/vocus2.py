"""VOCUS2: saliency as the contrast of two Gaussian pyramids, of centres and of surrounds."""

from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.baselines.saliency.blur import enlarge, gaussian_blur, rescale
from semfov.baselines.saliency.opponent import anchor, lab_colours, opponent_colours
from semfov.data.inputs import ImageLike, as_batch
from semfov.errors import check, lookup

_ColorSpace = Literal["opponent", "lab"]
_Fusion = Literal["mean", "max"]

# Maps of `lab` with a smaller range, in units of the rounding error at 1, hold rounding errors alone.
_FLAT = 8


class _Twin(NamedTuple):
    """One scale of the twin pyramids; centre `(B, C, h, w)`."""

    centre: Tensor
    surround: Tensor


def _twin_pyramids(
    channels: Tensor,
    centre_sigma: float = 2.0,
    surround_sigma: float = 6.0,
    layers: int = 5,
    scales: int = 2,
) -> list[list[_Twin]]:
    r"""Compute centre and surround pyramids (Frintrop, Werner and Martin García, 2015, section 3.2).

    Each layer has half the size of the one before, and S scales, each by further blur of the one before (Lowe, 2004):

    .. math:: \sigma_c(s) = 2^{s/S} \sigma_c, \quad
        \mathrm{surround} = G(2^{s/S} \sqrt{\sigma_s^2 - \sigma_c^2}) * \mathrm{centre}

    Args:
        channels: `(B, C, H, W)`.
        centre_sigma: blur of the centre at the first scale.
        surround_sigma: blur of the surround at the first scale.
        layers: number of layers, fewer of small images.
        scales: S, number of scales of a layer.

    Returns:
        The scales of each layer, largest first.
    """
    # Variances of successive blurs add up, so the surround is a further blur of the centre.
    further_sigma = (surround_sigma**2 - centre_sigma**2) ** 0.5
    # From one scale to the next the variance grows by this factor.
    growth = 2 ** (2 / scales)

    def step_from(scale: int) -> float:
        """Compute the blur of the centre from a scale to the next one."""
        return 2 ** (scale / scales) * centre_sigma * (growth - 1) ** 0.5

    centre = gaussian_blur(channels, centre_sigma)
    pyramids: list[list[_Twin]] = []
    for layer in range(min(layers, min(channels.shape[-2:]).bit_length())):
        if layer > 0:
            centre = gaussian_blur(centre, step_from(scales - 1), halve=True)
        twins = [_Twin(centre, gaussian_blur(centre, further_sigma))]
        for scale in range(1, scales):
            centre = gaussian_blur(centre, step_from(scale - 1))
            surround = gaussian_blur(centre, 2 ** (scale / scales) * further_sigma)
            twins.append(_Twin(centre, surround))
        pyramids.append(twins)
    return pyramids


def vocus2_saliency(
    image: Tensor,
    *,
    centre_sigma: float = 2.0,
    surround_sigma: float = 6.0,
    layers: int = 5,
    scales: int = 2,
    fusion: _Fusion = "mean",
    color_space: _ColorSpace = "opponent",
    normalise: bool = True,
) -> Tensor:
    """Saliency by VOCUS2 (Frintrop, Werner and Martin García, "Traditional saliency reloaded", CVPR 2015).

    It fuses the on-off and off-on contrasts of intensity, red-green and blue-yellow over all layers and scales.

    This is the saliency baseline of Luzio, Bernardino and Moreno (2024, section IV-B), who print no settings. The
    authors of VOCUS2 ship two sets with their program. The defaults here are those for cluttered scenes
    (`coffee_cfg.xml`). σ of 3 and 13 are the program's own defaults, for salient single objects.

    Args:
        image: `(B, 3, H, W)`, RGB in [0, 1].
        centre_sigma: blur of the centre; 2 for cluttered scenes, 3 for salient single objects.
        surround_sigma: blur of the surround; 6 for cluttered scenes, 13 for salient single objects.
        layers: number of layers of the pyramids, each half the size of the one before.
        scales: number of scales of a layer.
        fusion: `mean` or `max`, within and across features.
        color_space: `opponent`, the intensity and two opponencies of Frintrop, Werner and Martin García
            (`semfov.baselines.saliency.opponent.opponent_colours`); or `lab`, CIELAB, which the authors' program offers
            too (`lab_colours` in the same module). The program rounds CIELAB to bytes; we do not.
        normalise: scale every map to [0, 1].

    Returns:
        `(B, H, W)`, saliency, 0 or more.

    Raises:
        InputError: the image is not `(B, 3, H, W)` of floating-point numbers, or a setting is out of range.

    >>> image = torch.zeros(1, 3, 40, 60)
    >>> image[:, 0, 10:14, 30:34] = 1.0
    >>> row, column = divmod(int(vocus2_saliency(image).argmax()), 60)
    >>> 10 <= row < 14 and 30 <= column < 34
    True
    """
    _check_settings(centre_sigma, surround_sigma, layers, scales, fusion, color_space)
    # Contrasts are small differences, so half precision is not enough.
    with torch.autocast(image.device.type, enabled=False):
        channels = opponent_colours(image) if color_space == "opponent" else lab_colours(image)
        pyramids = _twin_pyramids(anchor(channels), centre_sigma, surround_sigma, layers=layers, scales=scales)
        size = (image.shape[-2], image.shape[-1])
        saliency = _mean_contrast(pyramids, size) if fusion == "mean" else _largest_contrast(pyramids, size)
    # The powers in CIELAB round differently from pixel to pixel, so a uniform image has contrasts of rounding errors.
    flat = 0.0 if color_space == "opponent" else _FLAT * torch.finfo(saliency.dtype).eps
    return rescale(saliency, flat) if normalise else saliency


def _mean_contrast(pyramids: list[list[_Twin]], size: tuple[int, int]) -> Tensor:
    """Take the mean of on-off and off-on contrasts over channels, scales and layers, `(B, *size)`."""
    layers = []
    for twins in pyramids:
        contrasts = []
        for twin in twins:
            # One of on-off and off-on is 0, so their mean is half the difference.
            difference = (twin.centre - twin.surround).abs_()
            contrasts.append(difference.mean(1, keepdim=True) / 2)
        # Interpolation is linear, so the mean of each size can be taken before it is enlarged.
        layers.append(enlarge(torch.cat(contrasts, 1).mean(1), size))
    coarser = layers[1:]
    return sum(coarser, layers[0]) / len(layers)


def _largest_contrast(pyramids: list[list[_Twin]], size: tuple[int, int]) -> Tensor:
    """Take the largest of on-off and off-on contrasts over channels, scales and layers, `(B, *size)`."""
    layers = []
    for twins in pyramids:
        contrasts = []
        for twin in twins:
            difference = twin.centre - twin.surround
            contrasts += [F.relu(difference), F.relu(-difference)]
        layers.append(enlarge(torch.cat(contrasts, 1), size).amax(1))
    return torch.stack(layers).amax(0)


class VOCUS2(nn.Module):
    """Saliency by VOCUS2 as a module; see `vocus2_saliency`.

    Args:
        centre_sigma: blur of the centre in pixels; 2 for cluttered scenes, 3 for salient single objects.
        surround_sigma: blur of the surround in pixels; 6 for cluttered scenes, 13 for salient single objects.
        layers: number of layers of the pyramids, each half the size of the one before.
        scales: number of scales of a layer.
        fusion: `mean` or `max`, within and across features.
        color_space: `opponent` or `lab`.
        normalise: scale every map to [0, 1].

    Raises:
        InputError: a setting is out of range.

    >>> VOCUS2(centre_sigma=3.0, surround_sigma=13.0)(torch.rand(2, 3, 32, 48)).shape
    torch.Size([2, 32, 48])
    """

    def __init__(
        self,
        centre_sigma: float = 2.0,
        surround_sigma: float = 6.0,
        *,
        layers: int = 5,
        scales: int = 2,
        fusion: _Fusion = "mean",
        color_space: _ColorSpace = "opponent",
        normalise: bool = True,
    ) -> None:
        super().__init__()
        _check_settings(centre_sigma, surround_sigma, layers, scales, fusion, color_space)
        self.settings: dict[str, Any] = {
            "centre_sigma": centre_sigma,
            "surround_sigma": surround_sigma,
            "layers": layers,
            "scales": scales,
            "fusion": fusion,
            "color_space": color_space,
        }
        self.normalise = normalise

    def forward(self, image: ImageLike) -> Tensor:
        """Compute the saliency of images.

        Args:
            image: `(B, 3, H, W)`, RGB in [0, 1], or one picture of any common type (`semfov.as_image`).

        Returns:
            `(B, H, W)`.
        """
        return vocus2_saliency(as_batch(image), **self.settings, normalise=self.normalise)

    def extra_repr(self) -> str:
        """Write all settings by name."""
        return ", ".join(f"{name}={value!r}" for name, value in self.settings.items())


def _check_settings(
    centre_sigma: float,
    surround_sigma: float,
    layers: int,
    scales: int,
    fusion: str,
    color_space: str,
) -> None:
    """Raise `InputError` unless the settings of `vocus2_saliency` are in their range."""
    check(centre_sigma > 0, "centre_sigma", "a positive number of pixels", centre_sigma)
    check(surround_sigma > centre_sigma, "surround_sigma", f"more than centre_sigma = {centre_sigma}", surround_sigma)
    check(layers >= 1, "layers", "1 or more", layers)
    check(scales >= 1, "scales", "1 or more", scales)
    lookup(fusion, get_args(_Fusion), "fusion")
    lookup(color_space, get_args(_ColorSpace), "color space")
