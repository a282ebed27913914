"""Reading of PNG and PPM files with 16 bits a channel, of which Pillow returns only the upper eight bits."""

from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple, Self, cast

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageFile import ImageFile

_LOWER_BYTES = {"RGB;16B": "RGB;16L", "RGBA;16B": "RGBA;16L"}
"""Pillow's ways to unpack the upper byte of each channel, and those that take the other byte for the upper one."""

_GREY_AND_ALPHA = "LA;16B"  # four bytes a pixel, which Pillow also unpacks as the channels of RGBA
_CHANNELS = {"L": 1, "RGB": 3}  # of a PPM


_SIZES = b"\xff\x4f\xff\x51"
"""Markers of JPEG 2000 by which a code stream (SOC) and its sizes (SIZ) begin."""

_PRECISION = 42  # bytes from there to that of the bits of the first channel
_JPEG2000_HEAD = 2**16  # bytes of a file that are looked through


def is_deep(image: "ImageFile") -> bool:
    """Tell whether a Pillow image that is not decoded yet has more than 8 bits a channel that decoding would cut."""
    if not image.tile:
        return False
    tile = image.tile[0]
    if tile.codec_name == "zip":
        return tile.args in (*_LOWER_BYTES, _GREY_AND_ALPHA)
    if tile.codec_name != "ppm":
        return False
    _, white = cast(tuple[str, int], tile.args)
    return white > 255


class DeepValues(NamedTuple):
    """The values of a file with more than 8 bits a channel, joined from two decoded halves when read.

    Attributes:
        shape: `(H, W, C)`; of two or four channels, the last one is an alpha.
        most: the largest possible value.
        rows: makes the values of some rows, `(h, W, C)`.
    """

    shape: tuple[int, int, int]
    most: int
    rows: Callable[[slice], NDArray[np.uint16]]

    @classmethod
    def of(cls, copies: tuple["ImageFile", "ImageFile"], load: Callable[["Image"], "Image"]) -> Self:
        """Decode a file.

        Args:
            copies: the image twice, not decoded yet.
            load: decodes an image and turns it.

        Returns:
            Its values.
        """
        image, again = copies
        tile = image.tile[0]
        if tile.codec_name == "ppm":
            values, most = _ppm_values(image)
            return cls(values.shape, most, lambda rows: values[rows].astype(np.uint16))
        if tile.args == _GREY_AND_ALPHA:
            image.tile = [tile._replace(args="RGBA")]
            both = load(image)
            return cls((both.height, both.width, 2), 65535, lambda rows: _joined(*_every_other(rows_of(both, rows))))
        again.tile = [tile._replace(args=_LOWER_BYTES[cast(str, tile.args)])]
        upper = load(image)
        lower = load(again)
        shape = upper.height, upper.width, len(upper.getbands())
        return cls(shape, 65535, lambda rows: _joined(rows_of(upper, rows), rows_of(lower, rows)))


def rows_of(image: "Image", rows: slice) -> NDArray[Any]:
    """Copy rows of a decoded image to an array."""
    return np.asarray(cut(image, rows))


def cut(image: "Image", rows: slice) -> "Image":
    """Cut some rows out of a decoded image."""
    return image.crop((0, rows.start, image.width, rows.stop))


def _every_other(values: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Split channels into the first, third, … and the others."""
    return values[..., 0::2], values[..., 1::2]


def _joined(upper: NDArray[np.uint8], lower: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Join the two bytes of values."""
    return upper * np.uint16(256) + lower


def jpeg2000_bits(path: str | PathLike[str]) -> int:
    """Tell the bits of the first channel of a JPEG 2000 file (ISO/IEC 15444-1, A.5.1); 8 where its head lacks them."""
    with Path(path).open("rb") as file:
        head = file.read(_JPEG2000_HEAD)
    start = head.find(_SIZES)
    place = start + _PRECISION
    if start < 0 or place >= len(head):
        return 8
    return (head[place] & 0x7F) + 1  # the first bit tells a sign


def _ppm_values(image: "ImageFile") -> tuple[NDArray[np.uint16], int]:
    """Read the values of a PPM, which are not packed, in the file's order of bytes, and the value that is white."""
    tile = image.tile[0]
    mode, white = cast(tuple[str, int], tile.args)
    shape = image.height, image.width, _CHANNELS[mode]
    file = cast(IO[bytes], image.fp)
    file.seek(tile.offset)
    content = file.read(2 * int(np.prod(shape)))
    values = np.frombuffer(content, ">u2")  # two bytes a sample, the most significant first (netpbm, ppm(5))
    return values.reshape(shape), white
