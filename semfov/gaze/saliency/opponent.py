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
    """Intensity, red-green and blue-yellow `(B, 3, H, W)` of VOCUS2 (Frintrop, Werner and Martin García, 2015, 3.1)."""
    _check_image(image)
    red, green, blue = image.unbind(1)
    return torch.stack([(red + green + blue) / 3, red - green, blue - (red + green) / 2], 1)


def lab_colours(image: Tensor) -> Tensor:
    """CIELAB `(L* / 100, a* / 255, b* / 255)` of sRGB: OpenCV's bytes by 255, but for their offset and rounding."""
    # Imported when first needed: Kornia takes a quarter of a second.
    from kornia.color import rgb_to_lab

    _check_image(image)
    return rgb_to_lab(image) / image.new_tensor([100.0, 255.0, 255.0])[:, None, None]


def double_opponency(image: Tensor) -> Tensor:
    r"""Intensity and the two colour opponencies of Itti, Koch and Niebur (1998), which do not depend on intensity.

    With r, g and b divided by I where I exceeds a tenth of its maximum over the image, and 0 elsewhere,

    .. math:: R = [r - (g + b)/2]_+, \; G = [g - (r + b)/2]_+, \; B = [b - (r + g)/2]_+,
        \; Y = [(r + g)/2 - |r - g|/2 - b]_+

    Image `(B, 3, H, W)` → `(B, 3, H, W)`.
    """
    _check_image(image)
    intensity = image.mean(1)
    least = intensity.amax((-2, -1), keepdim=True) / 10
    # So many rows at once that they stay in the processor's cache.
    some = max(1, _PIXELS // max(1, len(image) * image.shape[-1])) if values_known(image) else image.shape[-2]
    parts = []
    for part, bright in zip(image.split(some, 2), intensity.split(some, 1), strict=True):
        visible = bright > least
        gain = visible / torch.where(visible, bright, 1.0)
        red, green, blue = (part * gain[:, None]).unbind(1)
        mean = (red + green) / 2
        reds, greens = F.relu(red - (green + blue) / 2), F.relu(green - (red + blue) / 2)
        blues, yellows = F.relu(blue - mean), F.relu(mean - (red - green).abs() / 2 - blue)
        parts.append(torch.stack([bright, reds - greens, blues - yellows], 1))
    return torch.cat(parts, 2)


def anchor(channels: Tensor) -> Tensor:
    """Channels `(B, C, H, W)` less their first pixel: contrasts stay, and those of a uniform image are exactly 0."""
    return channels - channels[..., :1, :1]
