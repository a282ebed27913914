"""Reading of image files as a whole, by the reader that knows most of their kind."""

from contextlib import suppress
from os import PathLike
from pathlib import Path

from torch import Tensor

from semfov.data.images import (
    SIXTEEN_BITS,
    SMALLER,
    check_area,
    check_decoding,
    has_pages,
    open_pillow,
    quiet_decoders,
    read_photograph,
)
from semfov.data.tiff_tags import UPRIGHT, TiffTags
from semfov.data.tone import White, check_white
from semfov.data.windowed import ChosenBands, check_bands, check_no_bands, has_windows
from semfov.errors import check

_BYTES_A_PIXEL = 16  # of a picture that is read by windows: floats, and the bytes that they are made of


def read_image(
    path: str | PathLike[str], *, oriented: bool = True, white: White | None = None, bands: ChosenBands = None
) -> Tensor:
    """Read an image file as RGB.

    The EXIF orientation is applied, so the image has the orientation that viewers show. Grey images get three equal
    channels, CMYK and YCbCr are converted to RGB, and transparent pixels are blended with white. Grey images of 16 bits
    keep their precision (TIFFs: without `white`). The first frame of an animation, or page of a TIFF, is read. Colour
    profiles (ICC) are not applied.

    Args:
        path: a file of JPEG, JPEG 2000, PNG, WebP, AVIF, TIFF, GIF, BMP or PPM, whatever its name, and of HEIF where
            pillow-heif is registered.
        oriented: whether to apply the EXIF orientation; False is for annotations of the pixels as they are stored.
        white: the value of white (0 is black), such as 4095 for 12 bits; the values `(black, white)`; or `auto`, for
            the 1st and the 99th percentile. None: the largest value of the file's number of bits, or 1 for floats.
        bands: the number of a band of a TIFF or a raster, or three for red, green and blue, from 1; None for those that
            the file names.

    Returns:
        `(3, H, W)`, float32 in [0, 1].

    Raises:
        InputError: `white` or `bands` are no such numbers, or the file has no such bands.
        DataError: the file is missing, unreadable, truncated or not an image, or has more than `MAX_PIXELS` pixels.

    >>> import tempfile
    >>> from PIL import Image
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     Image.new("L", (4, 2), 255).save(folder + "/white.png")
    ...     read_image(folder + "/white.png").shape
    torch.Size([3, 2, 4])
    """
    check_white(white)
    check_bands(bands)
    if not has_windows(path):
        check_no_bands(bands)
    check(oriented or bands is None, "bands", "None for the pixels as they are stored (oriented=False)", bands)
    if bands is not None or _is_read_by_windows(path, white, oriented):
        from semfov.data.rasters import open_by_windows

        picture = open_by_windows(path, white=white, bands=bands)
        check_area(picture.size, f"image {Path(path)}")
        check_decoding(picture.size, _BYTES_A_PIXEL, Path(path).stat().st_size, f"image {Path(path)}", SMALLER)
        return picture.read((0, 0, *picture.size)).float().div_(255)
    return read_photograph(path, oriented=oriented, white=white)


def _is_read_by_windows(path: str | PathLike[str], white: White | None, oriented: bool) -> bool:
    """Tell whether a file is one of which Pillow would lose masks, channels that are pages, or 16 bits of colours.

    Grey pictures of 16 bits are Pillow's, as it keeps their precision, which bytes do not. Where `white` is given they
    are not: Pillow spreads 12 bits of JPEG 2000 over 16, and percentiles would be those of pixels without data, too.
    """
    if not has_windows(path):
        return False
    with suppress(Exception), quiet_decoders, open_pillow(path) as image:
        is_grey = image.mode in (*SIXTEEN_BITS, "F") and not has_pages(image)
        is_precise = is_grey and white is None
        # Readers by windows turn pictures upright.
        is_turned = not oriented and TiffTags.of_image(image).orientation != UPRIGHT
        return image.format in ("TIFF", "JPEG2000") and not is_precise and not is_turned
    return Path(path).suffix.lower() in (".tif", ".tiff")  # of a compression that Pillow has not, or of 12 bits
