"""Reading image files of any common format into RGB tensors."""

import logging
import math
import re
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, BinaryIO, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.camera_raw import check_no_raw
from semfov.data.decoded import Decoded
from semfov.data.deep import DeepValues, cut, is_deep, jpeg2000_bits, rows_of
from semfov.data.jpeg_scans import MOST_SCANS, has_many_scans
from semfov.data.png_chunks import has_late_orientation
from semfov.data.signatures import kind_of
from semfov.data.tiff_tags import HEIGHT, WHITE_IS_ZERO, WIDTH, TiffTags
from semfov.data.tone import White
from semfov.data.windowed import Box, LargePicture
from semfov.errors import DataError, SemfovError, check_data, check_pixels, reason_of
from semfov.io.files import check_regular

if TYPE_CHECKING:
    from PIL.Image import Exif, Image
    from PIL.ImageFile import ImageFile

MAX_PIXELS = 89_478_485
"""Largest number of pixels of a picture that is read (1 GiB as float32 RGB): Pillow's limit on decompression bombs."""

_FORMATS = ("JPEG", "JPEG2000", "PNG", "WEBP", "AVIF", "HEIF", "TIFF", "GIF", "BMP", "PPM")
"""Formats of photographs, which are told by the content of a file (AVIF and HEIF where Pillow has them).

Pillow knows others, of which some start programs (EPS) or are made of other files.
"""

_TILED = "reduce it, or convert it to a tiled TIFF"  # of which windows are decoded one by one
SMALLER = "reduce it, or look at it by windows (search, find_all, explore; the largest as a tiled TIFF)"
"""What to do with a picture that is too large to be read as a whole, in words that hold for every command."""

_SMALL = 2**24  # pixels of a picture that may be blank
_TEXT_HEAD = 2**16  # bytes of the head of a PPM: its kind, its size and its white, and comments between them
_KIND_OF_TEXT = re.compile(rb"P([1-6f])\s")
_COMMENT = re.compile(rb"#[^\r\n]*")
_MOST_A_BYTE = 2**11  # pixels; the best of the common packers keeps about a thousand numbers in a byte
_SMALL_BYTES = 2**29  # that any picture may take when it is decoded as a whole
_BYTES_A_BYTE = 200  # of decoded pixels for a byte of the file; photographs have ten to thirty
_FLOATS = 12  # bytes of a pixel in [0, 1]
_BYTES = 3
_MOST_OF_BYTES = 255
_PAGES = 64  # of a TIFF that are looked through for one that is no thumbnail
_JPEG2000_REMEDY = 'or a name that ends in .jp2 and pip install "semfov[geo]"'
_ORIENTATION = 0x0112  # tag of EXIF
_ORIENTATIONS = range(1, 9)
_UPRIGHT = 1
_MOVES = {
    2: "FLIP_LEFT_RIGHT",
    3: "ROTATE_180",
    4: "FLIP_TOP_BOTTOM",
    5: "TRANSPOSE",
    6: "ROTATE_270",
    7: "TRANSVERSE",
    8: "ROTATE_90",
}
"""Moves that turn a picture upright, by its orientation; from 5 on they swap its sides."""

SWAPPED = 5  # the first orientation whose sides are swapped
_MIRRORED_ACROSS = (2, 3, 6, 7)  # orientations whose stored pixels are mirrored so, before sides are swapped
_MIRRORED_DOWN = (3, 4, 7, 8)
_INVERSE = {6: 8, 8: 6}  # orientations whose moves undo each other; other moves undo themselves
SIXTEEN_BITS = ("I;16", "I;16L", "I;16B", "I;16N", "I")
"""Pillow's modes of grey pictures with 16 bits."""

_OF_SCANS = ("JPEG", "MPO")  # Pillow's names; the latter holds several pictures
_PLAIN = ("RGB", "RGBA", "L", "LA", "P", "1", "CMYK", "YCbCr")  # modes of up to 8 bits
_TRANSPARENT = ("RGBA", "LA", "PA", "RGBa", "La")  # modes with an alpha


def read_photograph(path: str | PathLike[str], *, oriented: bool, white: White | None) -> Tensor:
    """Read an image file by Pillow alone; arguments, result and errors are those of `semfov.read_image`."""
    name = f"image {Path(path)}"
    with opening(Path(path), "decoded"), open_pillow(path) as image:
        held = Path(path).stat().st_size
        check_proportion(image.size, held, path)
        check_area(image.size, name)
        check_decoding(image.size, _FLOATS + _halves(image), held, name, SMALLER)
        # Pillow spreads these over 8 or 16 bits, so that what is white is no longer known.
        are_spread = white is not None and image.format == "JPEG2000" and jpeg2000_bits(path) > 8
        check_data(not are_spread, name, f"white=None beside more than 8 bits of JPEG 2000, {_JPEG2000_REMEDY}", white)
        decoded = _decoded(image, path, upright=oriented)
        extremes = _extremes(decoded, white, name)
        pixels = decoded.floats(white)
    _warn_of_extremes(extremes, decoded, path)
    return torch.from_numpy(pixels)


def _largest_grey(tags: TiffTags) -> int:
    """Tell the largest value of a grey picture of 16 bits; of a TIFF of 12 bits it is 4095."""
    return 4095 if tags.bits == (12,) else 65535


def _halves(image: "ImageFile") -> int:
    """Count the bytes of a pixel while a picture is decoded, in Pillow's images; deep ones are decoded in halves."""
    return 8 if is_deep(image) else 4


def _extremes(decoded: Decoded, white: White | None, name: str) -> tuple[float, float] | None:
    """Find the least and the greatest value of more than 8 bits; None for others, and where their white is stated.

    Raises:
        DataError: there are some beyond black or white.
    """
    if white is not None or decoded.most == _MOST_OF_BYTES:
        return None
    least, greatest = decoded.extremes()
    got = f"{least:g} to {greatest:g}; give white='auto', or the values that are black and white"
    inside = bool(least >= 0 and greatest <= decoded.most)  # false for NaN, too
    check_data(inside, name, f"values from 0 to {decoded.most:g}", got)
    return least, greatest


def _warn_of_extremes(extremes: tuple[float, float] | None, decoded: Decoded, path: str | PathLike[str]) -> None:
    """Warn of values that show little; outside the silence of the decoders."""
    if extremes is not None and decoded.most > 1:
        warn_of_range(*extremes, path, int(decoded.most))


def warn_of_range(least: float, most: float, path: str | PathLike[str], largest: int = 65535) -> None:
    """Warn of a picture whose values, `least` to `most`, use less than a quarter of the range to `largest`."""
    if 0 < most - least < largest / 4:
        bits = largest.bit_length()
        warnings.warn(
            f"image {Path(path)}: values from {least:.0f} to {most:.0f} of {bits} bits, whose white is {largest}, show "
            f"little; give the value that is white, white={most:.0f}, or white='auto' for percentiles",
            stacklevel=3,
        )


class _Silence:
    """Silence of the decoders, which begins with the first thread in it and ends with the last one.

    Private attributes: `_inside` counts the threads in it. While there is one, `_restore` puts back the filters and the
    levels that were found before the first; else it is empty. `_lock` guards both. (Filters and levels are those of all
    threads: if each thread put back what it had found, one that began in another's silence would keep it for ever.)
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._inside = 0
        self._restore = ExitStack()

    def __enter__(self) -> None:
        with self._lock:
            self._inside += 1
            if self._inside == 1:
                self._begin()

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._restore.close()

    def _begin(self) -> None:
        """Silence warnings and logs."""
        self._restore.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")
        for name in ("PIL", "tifffile"):
            log = logging.getLogger(name)
            self._restore.callback(log.setLevel, log.level)
            log.setLevel(logging.CRITICAL)


quiet_decoders = _Silence()
"""A context that silences the decoders' warnings about metadata and size; our own limits check size."""


@contextmanager
def opening(source: Path | str, action: str) -> Iterator[None]:
    """Raise `DataError` for any error of a decoder in a block.

    Args:
        source: the path of a file that is opened in the block, or the name of a picture that is open.
        action: what is done with it, such as `decoded`, for the message.
    """
    name = f"image {source}" if isinstance(source, Path) else source
    if isinstance(source, Path):
        check_regular(source, name)
    with quiet_decoders:
        try:
            yield
        except FileNotFoundError:
            raise DataError(f"{name}: no such file; check its path") from None
        except PermissionError:
            raise DataError(f"{name}: no permission to read it; check the file's mode and owner") from None
        except SemfovError:
            raise
        except Exception as error:  # decoders of damaged files raise errors of many kinds
            raise DataError(f"{name}: {_fault(error, source, action)}") from None


def _fault(error: Exception, source: Path | str, action: str) -> str:
    """Say what is wrong with a picture by the error of a decoder, and the remedy (`opening`)."""
    # By their names, as Pillow need not be imported yet.
    error_name = type(error).__name__
    if error_name == "DecompressionBombError":
        most = f"expected at most {2 * MAX_PIXELS:,} pixels of a file that is decoded as a whole"
        return f"{most}, got more; convert it to a tiled TIFF"
    reason = reason_of(error) or error_name
    if not isinstance(source, Path):
        return f"truncated, damaged or closed, and cannot be {action} ({reason}); open it again or replace it"
    is_unidentified = error_name == "UnidentifiedImageError"
    kind, is_read = kind_of(source)
    # Bytes that tell no kind, such as those of a PPM, are still a picture where Pillow has identified it.
    is_known_by_bytes = kind != ""
    if (is_known_by_bytes or is_unidentified) and not is_read:
        return _of_another_kind(kind)
    if is_unidentified:
        reason = f"as {kind}"  # Pillow's own words name the open file alone
    return f"truncated, damaged or of an unsupported kind, and cannot be {action} ({reason}); replace it"


def _of_another_kind(kind: str) -> str:
    """Say that a file is of a kind that is not read, which may have no name."""
    from PIL import Image

    Image.init()  # without it Pillow knows few formats
    got = f", got {kind}" if kind else ""
    return f"not an image in a format that is read ({', '.join(_known_to_pillow())}){got}; convert it"


@contextmanager
def open_pillow(path: str | PathLike[str]) -> Iterator["ImageFile"]:
    """Open a file in one of `_FORMATS` as a Pillow image that is not decoded yet.

    Raises:
        DataError: it is no regular file, a raw one of a camera, or a TIFF that Pillow would read wrongly or at a price.
    """
    name = f"image {Path(path)}"
    check_regular(path, name)
    with quiet_decoders:
        check_no_raw(path)
    _check_text_head(path, name)
    # Given a file name, Pillow would map a plain TIFF into memory and mix up its rows when turning it.
    with Path(path).open("rb") as file, _open_in_formats(file) as image:
        if image.format == "TIFF":
            _seek_full_page(image)
            _check_tiff(TiffTags.of_image(image), image.size, name)
        yield image


def _check_text_head(path: str | PathLike[str], name: str) -> None:
    """Raise `DataError` for a PPM, PGM, PBM or PFM whose head does not end soon, which Pillow reads byte by byte."""
    with Path(path).open("rb") as file:
        head = file.read(_TEXT_HEAD)
    kind = _KIND_OF_TEXT.match(head)
    if kind is None or len(head) < _TEXT_HEAD:
        return
    needed = 3 if kind[1] in b"14" else 4  # pictures of single bits state no white
    words = _COMMENT.sub(b"", head).split()
    expected = f"its size in the first {_TEXT_HEAD:,} bytes"
    check_data(len(words) >= needed, name, expected, "longer comments; replace it")


def _open_in_formats(file: BinaryIO) -> "ImageFile":
    """Open a file in one of `_FORMATS`, first in those that Pillow always knows: importing all others takes longer."""
    from PIL import Image, UnidentifiedImageError

    Image.preinit()
    try:
        return Image.open(file, formats=_known_to_pillow())
    except UnidentifiedImageError:
        Image.init()
        return Image.open(file, formats=_known_to_pillow())


def _known_to_pillow() -> list[str]:
    """List the formats that Pillow can open so far; AVIF and HEIF need libraries that may be missing."""
    from PIL import Image

    return [kind for kind in _FORMATS if kind in Image.OPEN]


def _seek_full_page(image: "Image") -> None:
    """Go to the first page of a TIFF that is no reduced copy, such as a thumbnail; the first one if there is none."""
    if not TiffTags.of_image(image).is_reduced:
        return
    # Pillow would follow all pages to count them.
    with suppress(EOFError):
        for number in range(1, _PAGES):
            image.seek(number)
            if not TiffTags.of_image(image).is_reduced:
                return
    image.seek(0)


def has_pages(image: "Image") -> bool:
    """Tell whether a Pillow image has a further page, or frame, without counting them; it is at the first one after."""
    try:
        image.seek(1)
    except EOFError:
        return False
    image.seek(0)
    return True


def _check_tiff(tags: TiffTags, size: tuple[int, int], name: str) -> None:
    """Raise `DataError` for a page of `(width, height)` with signed bytes, or tiles out of proportion."""
    # Pillow would read -1 as 255.
    check_data(not tags.has_signed_bytes, name, "8 bits without a sign", "some with one; convert it")
    tile_bytes = tags.tile_bytes(size)
    for stored in tags.stored_bytes:
        check_tile(tile_bytes, stored, name)


def check_proportion(size: tuple[int, int], held: int, path: str | PathLike[str]) -> None:
    """Raise `DataError` for a large picture that claims more pixels than the bytes of its files may hold.

    Args:
        size: `(width, height)` that it claims.
        held: bytes of its files.
        path: its file, for the message.
    """
    most = max(_SMALL, _MOST_A_BYTE * held)
    pixels = math.prod(size)
    got = f"{pixels:,} in {held:,} bytes; replace it"
    check_data(pixels <= most, f"image {Path(path)}", f"at most {most:,} pixels, in proportion to the file", got)


def check_tile(size: int, stored: int, name: str) -> None:
    """Raise `DataError` for a tile (or strip) that is stored in far more or far fewer bytes than its pixels take.

    Args:
        size: bytes of the decoded tile.
        stored: bytes of it in the file, 0 for one that is not there.
        name: of the picture, for the message.
    """
    is_larger = stored > 2 * size + 2**16
    # A small tile may be blank, which takes next to nothing.
    is_smaller = 0 < stored * _MOST_A_BYTE < size and size > 3 * _SMALL
    got = f"one that is stored in {stored:,}, out of proportion; replace it"
    check_data(not (is_larger or is_smaller), name, f"tiles of {size:,} bytes", got)


def check_decoding(size: tuple[int, int], a_pixel: int, held: int, name: str, remedy: str = _TILED) -> None:
    """Raise `DataError` for a picture that takes far more memory than a file of its size should, when it is decoded.

    Args:
        size: its `(width, height)`.
        a_pixel: bytes that a pixel takes.
        held: bytes of its file.
        name: of the picture, for the message.
        remedy: what helps, for the message.
    """
    most = _SMALL_BYTES + _BYTES_A_BYTE * held
    taken = math.prod(size) * a_pixel
    got = f"{size[0]} × {size[1]}, which take {taken:,}; {remedy}"
    check_data(taken <= most, name, f"pixels of at most {most:,} bytes, in proportion to the file", got)


def check_area(size: tuple[int, int], name: str) -> None:
    """Raise `DataError` for a picture of `(width, height)` with more pixels than are decoded as a whole."""
    got = f"{size[0]} × {size[1]}; {SMALLER}"
    check_data(0 < math.prod(size) <= MAX_PIXELS, name, f"1 to {MAX_PIXELS:,} pixels", got)


def from_pillow(image: "Image", name: str, white: White | None = None) -> Tensor:
    """Convert a Pillow image of any mode, as `semfov.read_image` would read its file.

    Args:
        image: the image.
        name: of it, for messages.
        white: as for `semfov.read_image`.

    Returns:
        `(3, H, W)`, float32 in [0, 1].
    """
    with opening(name, "decoded"):
        check_area(image.size, name)
        decoded = _decoded(image, None, upright=True)
        _extremes(decoded, white, name)  # which refuses some
        return torch.from_numpy(decoded.floats(white))


def _orientation(image: "Image") -> int:
    """Read the EXIF orientation, 1 to 8; 1 (as stored) where the metadata are damaged or hold another value."""
    try:
        orientation = _exif(image).get(_ORIENTATION, _UPRIGHT)
    except Exception:  # of the kind that the damage has
        return _UPRIGHT
    return int(orientation) if orientation in _ORIENTATIONS else _UPRIGHT


def _exif(image: "Image") -> "Exif":
    """Read the EXIF data; for those behind the pixels of a PNG, Pillow decodes it, which others are spared."""
    from PIL.Image import Image

    if image.format != "PNG" or "exif" in image.info:
        return image.getexif()
    file: BinaryIO | None = getattr(image, "fp", None)
    # A picture that is decoded has all its data, and perhaps no file.
    if file is None or getattr(file, "closed", False) or has_late_orientation(file):
        return image.getexif()
    return Image.getexif(image)


def _loaded(image: "Image", *, upright: bool) -> "Image":
    """Decode a Pillow image, and turn it upright, or back to how it is stored."""
    from PIL.Image import Transpose

    stored = _orientation(image)
    _check_scans(image)
    image.load()
    remaining = _orientation(image)  # Pillow turns some pictures when it decodes them
    if upright:
        orientation = remaining
    elif remaining != stored:
        orientation = _INVERSE.get(stored, stored)
    else:
        orientation = _UPRIGHT
    return image if orientation == _UPRIGHT else image.transpose(Transpose[_MOVES[orientation]])


def _check_scans(image: "Image") -> None:
    """Raise `DataError` for a JPEG, not decoded yet, whose scans would take longer than its pixels."""
    file = getattr(image, "fp", None)
    if file is None or image.format not in _OF_SCANS:
        return
    name = f"image {getattr(file, 'name', 'in memory')}"
    check_data(not has_many_scans(file), name, f"at most {MOST_SCANS} scans of a JPEG", "more; replace it")


def _decoded(image: "Image", path: str | PathLike[str] | None, *, upright: bool) -> Decoded:
    """Decode a Pillow image.

    Args:
        image: the image.
        path: its file, by which colours of more than 8 bits are read; None without one.
        upright: turn it upright; False leaves it as it is stored.

    Returns:
        The decoded picture.
    """
    if path is not None and is_deep(cast("ImageFile", image)):
        return _decoded_deep(cast("ImageFile", image), path, upright=upright)
    # What the tags say is read before Pillow decodes the picture, and perhaps changes its mode.
    tags = TiffTags.of_image(image)
    largest = _largest_grey(tags)
    # Pillow turns white-is-zero TIFFs of 8 bits into black-is-zero, but not those of 16.
    is_inverted = image.mode in SIXTEEN_BITS and tags.photometric == WHITE_IS_ZERO
    loaded = _loaded(image, upright=upright)
    shape = loaded.height, loaded.width
    if loaded.mode not in (*SIXTEEN_BITS, "F"):
        return Decoded(shape, lambda rows: np.asarray(_over_white(cut(loaded, rows)).convert("RGB")), _MOST_OF_BYTES)
    return Decoded(
        shape,
        lambda rows: rows_of(loaded, rows)[..., None],
        most=1 if loaded.mode == "F" else largest,
        transparent=loaded.info.get("transparency"),
        white_is_zero=is_inverted,
    )


def _decoded_deep(image: "ImageFile", path: str | PathLike[str], *, upright: bool) -> Decoded:
    """Decode a picture that `is_deep`, whose file Pillow opens a second time for the lower halves of its values."""
    with open_pillow(path) as again:
        values = DeepValues.of((image, again), partial(_loaded, upright=upright))
    has_alpha = values.shape[-1] in (2, 4)
    transparent = None if has_alpha else image.info.get("transparency")
    return Decoded(values.shape[:2], values.rows, values.most, has_alpha, transparent)


def _over_white(image: "Image") -> "Image":
    """Blend the transparent pixels of a Pillow image with white."""
    from PIL import Image

    if "transparency" not in image.info and image.mode not in _TRANSPARENT:
        return image
    # Pillow does not convert grey that is multiplied by its alpha to RGBA at once.
    colours = image.convert("LA") if image.mode == "La" else image
    return Image.alpha_composite(Image.new("RGBA", image.size, "white"), colours.convert("RGBA"))


class PhotographPicture(LargePicture):
    """A picture in a file that Pillow decodes as a whole, when the first window is read.

    Invariant: once the picture is decoded, `_array` is all that windows are read from, and it has the size that was
    found when the file was opened; a file that is changed or removed afterwards changes nothing.
    """

    path: Path

    def __init__(self, path: str | PathLike[str], white: White | None = None) -> None:
        self.path = Path(path)
        self._white = white
        with opening(self.path, "opened"), open_pillow(self.path) as image:
            check_proportion(image.size, self.path.stat().st_size, self.path)
            self.size = upright_size(image)

    def pixels(self, box: Box) -> NDArray[np.uint8]:
        x1, y1, x2, y2 = box
        return self._array[y1:y2, x1:x2]

    @cached_property
    def _array(self) -> NDArray[np.uint8]:
        """The decoded bytes, `(H, W, 3)`, without floats in between."""
        name = f"image {self.path}"
        with opening(self.path, "decoded"), open_pillow(self.path) as image:
            if image.mode not in _PLAIN or self._white is not None or is_deep(image):
                check_area(image.size, name)
            check_decoding(image.size, _BYTES + _halves(image), self.path.stat().st_size, name)
            decoded = _decoded(image, self.path, upright=True)
            extremes = _extremes(decoded, self._white, name)
            pixels = decoded.bytes(self._white)
        _warn_of_extremes(extremes, decoded, self.path)
        return pixels


def upright_size(image: "Image") -> tuple[int, int]:
    """Tell `(width, height)` of a Pillow image after it is turned upright."""
    width, height = image.size
    if _orientation(image) < SWAPPED:
        return width, height
    # Pillow swaps the sides of TIFFs itself before it turns them.
    tags = TiffTags.of_image(image).values
    return tags.get(HEIGHT, height), tags.get(WIDTH, width)


def file_orientation(path: Path) -> int:
    """Read the EXIF orientation of an image file, 1 to 8; 1 where it has none, or Pillow cannot open it."""
    with suppress(DataError), opening(path, "opened"), open_pillow(path) as image:
        return _orientation(image)
    return _UPRIGHT


def stored_boxes(boxes: Tensor, size: tuple[int, int], orientation: int) -> Tensor:
    """Move boxes in an upright picture to where its file stores their pixels.

    Args:
        boxes: `(N, 4)`, `(x1, y1, x2, y2)` in pixels.
        size: `(width, height)` of the upright picture.
        orientation: EXIF orientation of the file, 1 to 8.

    Returns:
        `(N, 4)`, in pixels of the stored picture.
    """
    width, height = size
    x1, y1, x2, y2 = boxes.unbind(-1)
    if orientation in _MIRRORED_ACROSS:
        x1, x2 = width - x2, width - x1
    if orientation in _MIRRORED_DOWN:
        y1, y2 = height - y2, height - y1
    edges = (x1, y1, x2, y2) if orientation < SWAPPED else (y1, x1, y2, x2)
    return torch.stack(edges, -1)


def upright_boxes(boxes: Tensor, size: tuple[int, int], orientation: int) -> Tensor:
    """Convert boxes from a picture's stored pixels to its pixels after it is turned upright.

    Args:
        boxes: `(N, 4)`, `(x1, y1, x2, y2)` in pixels.
        size: `(width, height)` of the stored picture.
        orientation: EXIF orientation of the file, 1 to 8.

    Returns:
        `(N, 4)`, in pixels of the upright picture.
    """
    return stored_boxes(boxes, size, _INVERSE.get(orientation, orientation))


def to_bytes(image: Tensor) -> NDArray[np.uint8]:
    """Convert an image `(3, H, W)`, which is RGB in [0, 1] or bytes, to bytes `(H, W, 3)`."""
    if image.dtype != torch.uint8:
        check_pixels(image, "image")
        image = image.clamp(0, 1).mul(255).round()
    return image.permute(1, 2, 0).to("cpu", torch.uint8).contiguous().numpy()
