"""Opponent colours of both saliency models, and CIELAB."""

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.errors import check, check_shape, values_known

_PIXELS = 1 << 15  # that are worked on at once


def _check_image(image: Tensor) -> None:
    """Raise `InputError` unless `image` is a floating-point `(B, 3, H, W)` with at least one pixel."""
    check_shape(image, "image", 3, None, None)
    check(image.ndim == 4, "image", "a tensor of shape (B, 3, any, any)", tuple(image.shape))
    check(image.is_floating_point(), "image", "floating-point values in [0, 1]", image.dtype)
    check(min(image.shape[-2:]) > 0, "image", "at least one pixel", tuple(image.shape))


def opponent_colours(image: Tensor) -> Tensor:
    """Compute the colours of VOCUS2 (Frintrop, Werner and Martin García, 2015, 3.1).

    Args:
        image: `(B, 3, H, W)`, RGB in [0, 1].

    Returns:
        Intensity, red minus green and blue minus yellow, `(B, 3, H, W)`.
    """
    _check_image(image)
    red, green, blue = image.unbind(1)  # (B, H, W)
    intensity = (red + green + blue) / 3
    yellow = (red + green) / 2
    return torch.stack([intensity, red - green, blue - yellow], 1)


def lab_colours(image: Tensor) -> Tensor:
    """Convert sRGB to CIELAB as OpenCV's bytes divided by 255, but for their offset and rounding.

    Args:
        image: `(B, 3, H, W)`, RGB in [0, 1].

    Returns:
        `(L* / 100, a* / 255, b* / 255)`, `(B, 3, H, W)`.
    """
    # Imported when first needed: Kornia takes a quarter of a second.
    from kornia.color import rgb_to_lab

    _check_image(image)
    ranges = image.new_tensor([100.0, 255.0, 255.0])[:, None, None]
    return rgb_to_lab(image) / ranges


def double_opponency(image: Tensor) -> Tensor:
    r"""Compute intensity and two colour opponencies that do not depend on it (Itti, Koch and Niebur, 1998).

    With r, g and b divided by I where I exceeds a tenth of its maximum over the image, and 0 elsewhere,

    .. math:: R = [r - (g + b)/2]_+, \; G = [g - (r + b)/2]_+, \; B = [b - (r + g)/2]_+,
        \; Y = [(r + g)/2 - |r - g|/2 - b]_+

    Args:
        image: `(B, 3, H, W)`, RGB in [0, 1].

    Returns:
        I, R minus G, and B minus Y, `(B, 3, H, W)`.
    """
    _check_image(image)
    intensity = image.mean(1)
    least = intensity.amax((-2, -1), keepdim=True) / 10
    rows = image.shape[-2]
    if values_known(image):  # a graph has no blocks
        # So many rows at once that they stay in the processor's cache.
        pixels_of_row = len(image) * image.shape[-1]
        rows = max(1, _PIXELS // max(1, pixels_of_row))
    blocks = zip(image.split(rows, 2), intensity.split(rows, 1), strict=True)
    return torch.cat([_opponencies(pixels, bright, least) for pixels, bright in blocks], 2)


def _opponencies(image: Tensor, intensity: Tensor, least: Tensor) -> Tensor:
    """Compute `double_opponency` of some rows of images `(B, 3, h, W)`.

    Args:
        image: the rows.
        intensity: their intensity, `(B, h, W)`.
        least: intensity up to which colours are not visible, `(B, 1, 1)`.

    Returns:
        `(B, 3, h, W)`.
    """
    visible = intensity > least
    gain = visible / torch.where(visible, intensity, 1.0)
    r, g, b = (image * gain[:, None]).unbind(1)
    mean_rg = (r + g) / 2
    red = F.relu(r - (g + b) / 2)
    green = F.relu(g - (r + b) / 2)
    blue = F.relu(b - mean_rg)
    yellow = F.relu(mean_rg - (r - g).abs() / 2 - b)
    return torch.stack([intensity, red - green, blue - yellow], 1)


def anchor(channels: Tensor) -> Tensor:
    """Subtract from channels `(B, C, H, W)` their first pixel: contrasts stay, and a uniform image has exactly none."""
    return channels - channels[..., :1, :1]
