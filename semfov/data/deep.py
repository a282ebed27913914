"""Colours of 16 bits a channel in PNG and PPM files, of which Pillow gives the upper eight bits alone."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LOWER = {"RGB;16B": "RGB;16L", "RGBA;16B": "RGBA;16L"}  # ways to unpack the upper bytes, and the lower ones
_FOUR_BYTES = "LA;16B"  # of grey and alpha, which Pillow also unpacks as the four channels of RGBA


def is_deep(image: Any) -> bool:
    """Whether a Pillow image that is not decoded yet has more than 8 bits a channel that decoding would cut."""
    if not image.tile:
        return False
    codec, given = image.tile[0].codec_name, image.tile[0].args
    return (codec == "zip" and given in (*_LOWER, _FOUR_BYTES)) or (codec == "ppm" and given[1] > 255)


def deep_values(copies: Sequence[Any], turned: Callable[[Any], Any]) -> tuple[NDArray[np.uint16], int]:
    """The values `(H, W, C)` of a file, an alpha last, and the largest possible one.

    `copies` has the image twice, not decoded yet; `turned` loads and turns one of them.
    """
    first, second = copies
    tile = first.tile[0]
    if tile.codec_name == "ppm":
        mode, most = tile.args
        shape = first.height, first.width, {"L": 1, "RGB": 3}[mode]
        first.fp.seek(tile.offset)
        return np.frombuffer(first.fp.read(2 * int(np.prod(shape))), ">u2").reshape(shape).astype(np.uint16), most
    if tile.args == _FOUR_BYTES:
        first.tile = [tile._replace(args="RGBA")]
        halves = np.asarray(turned(first))
        return halves[..., 0::2] * np.uint16(256) + halves[..., 1::2], 65535
    second.tile = [tile._replace(args=_LOWER[tile.args])]
    upper, lower = (np.asarray(turned(each)) for each in (first, second))
    return upper * np.uint16(256) + lower, 65535
