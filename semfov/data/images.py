"""Reading image files of any common format into RGB tensors."""

import logging
import math
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from os import PathLike
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.deep import deep_values, is_deep
from semfov.data.tone import White, between, black_and_white
from semfov.data.windowed import LargePicture
from semfov.errors import DataError, SemfovError, check_data, check_pixels
from semfov.io.files import check_regular

MAX_PIXELS = 89_478_485
"""Largest number of pixels of a picture that is read (1 GiB as float32 RGB): Pillow's limit on decompression bombs."""

_FORMATS = ("JPEG", "JPEG2000", "PNG", "WEBP", "AVIF", "HEIF", "TIFF", "GIF", "BMP", "PPM")
"""Formats of photographs, which are told by the content of a file (AVIF and HEIF where Pillow has them).

Pillow knows others, of which some start programs (EPS) or are made of other files.
"""

_UNKNOWN = f"not an image in a format that is read ({', '.join(_FORMATS)}); convert it"
"""What is said of the content of a file that is none of these."""

_SMALLER = "reduce it, or look at it by windows (how='windows'; the largest as a tiled TIFF)"
_SMALL = 2**24  # pixels of a picture that may be blank
_MOST_A_BYTE = 2**11  # pixels; the best of the common packers keeps about a thousand numbers in a byte
_ORIENTATION_TAG = 0x0112
_PHOTOMETRIC_TAG = 0x0106
_SUBFILE, _PAGES = 254, 64  # tag of a TIFF with its first bit for a reduced copy, and pages that are looked through
# Moves that turn a picture with this orientation upright. All are their own inverse except 6 and 8, which are inverse
# to each other.
_MOVES = (
    *("", "", "FLIP_LEFT_RIGHT", "ROTATE_180", "FLIP_TOP_BOTTOM"),
    *("TRANSPOSE", "ROTATE_270", "TRANSVERSE", "ROTATE_90"),
)
_INVERSE = {6: 8, 8: 6}
_WIDTH_TAG, _HEIGHT_TAG = 256, 257
SIXTEEN_BITS = ("I;16", "I;16L", "I;16B", "I;16N", "I")

_PLAIN = ("RGB", "RGBA", "L", "LA", "P", "1", "CMYK", "YCbCr")  # modes of up to 8 bits
_ROWS = 64  # of a decoded picture that are converted at once: more leave the cache of the processor


def read_photograph(path: str | PathLike[str], *, oriented: bool = True, white: White | None = None) -> Tensor:
    """Read an image file by Pillow alone (`read_image`)."""
    with opening(Path(path), "decoded"), open_pillow(path) as image:
        check_proportion(image.size, Path(path).stat().st_size, path)
        check_area(image.size, f"image {Path(path)}")
        deep = is_deep(image)
        wide = deep or image.mode in SIXTEEN_BITS
        if not deep:
            array = shown = _pixels(image, f"image {Path(path)}", upright=oriented, white=white)
    if deep:
        array, shown = _deep_pixels(path, upright=oriented, white=white)
    if wide and white is None:
        warn_of_range(float(shown.min()) * 65535, float(shown.max()) * 65535, path)
    return torch.from_numpy(array).permute(2, 0, 1).contiguous()


def _deep_pixels(
    path: str | PathLike[str], *, upright: bool, white: White | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pixels `(H, W, 3)` in [0, 1] of a file with more than 8 bits a channel, over white, and its colours alone."""

    def turned(image: Any) -> Any:
        stored = _orientation(image)
        image.load()
        return _turned(image, stored, _orientation(image), upright=upright)

    with opening(Path(path), "decoded"), open_pillow(path) as image, open_pillow(path) as again:
        values, most = deep_values((image, again), turned)
    count = values.shape[-1]
    colours = values[..., : count - (count in (2, 4))]
    shown = between(colours, (0.0, float(most)) if white is None else black_and_white(white, colours))
    pixels = shown if shown.shape[-1] == 3 else np.repeat(shown, 3, -1)
    if count in (2, 4):
        share = between(values[..., -1:], (0.0, float(most)))
        pixels = pixels * share + (1 - share)
    return pixels, shown


def warn_of_range(least: float, most: float, path: str | PathLike[str]) -> None:
    """Warn of a picture of 16 bits with less than a quarter of their range, of which little is seen."""
    if 0 < most - least < 65535 / 4:
        warnings.warn(
            f"image {Path(path)}: values from {least:.0f} to {most:.0f} of 16 bits, whose white is 65535, show little; "
            f"give the value that is white, white={most:.0f}, or white='auto' for percentiles",
            stacklevel=3,
        )


class _Quiet:
    """Silence of decoders, which begins with the first thread in it and ends with the last one."""

    # Filters and levels are those of all threads: if each put back what it had found, one that began in another's
    # silence would leave it behind for ever.

    def __init__(self) -> None:
        self._lock, self._inside, self._before = Lock(), 0, ExitStack()

    def __enter__(self) -> None:
        with self._lock:
            self._inside += 1
            if self._inside == 1:
                self._before.enter_context(warnings.catch_warnings())
                warnings.simplefilter("ignore")
                for log in (logging.getLogger(name) for name in ("PIL", "tifffile")):
                    self._before.callback(log.setLevel, log.level)
                    log.setLevel(logging.CRITICAL)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._before.close()


quiet_decoders = _Quiet()
"""A context in which nothing is said of damaged metadata, and of large files, which the limits refuse."""


@contextmanager
def opening(path: Path | str, what: str) -> Iterator[None]:
    """Raise `DataError` for a file, or an open picture by its name, that cannot be read, for any error of a decoder."""
    name, damage = (f"image {path}", "of an unsupported kind") if isinstance(path, Path) else (path, "closed")
    if isinstance(path, Path):
        check_regular(path, name)
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
            if type(error).__name__ == "DecompressionBombError":
                most = f"expected at most {2 * MAX_PIXELS:,} pixels of a file that is decoded as a whole"
                raise DataError(f"{name}: {most}, got more; convert it to a tiled TIFF") from None
            if type(error).__name__ == "UnidentifiedImageError":
                raise DataError(f"{name}: {_UNKNOWN}") from None
            reason = " ".join(str(error).split()) or type(error).__name__
            way = "replace it" if isinstance(path, Path) else "open it again or replace it"
            raise DataError(f"{name}: truncated, damaged or {damage}, and cannot be {what} ({reason}); {way}") from None


@contextmanager
def open_pillow(path: str | PathLike[str]) -> Iterator[Any]:
    """The Pillow image of a file in one of `_FORMATS`, not decoded yet."""
    from PIL import Image

    check_regular(path, f"image {Path(path)}")
    Image.init()
    # Given a file name, Pillow would map a plain TIFF into memory and mix up its rows when turning it.
    with Path(path).open("rb") as file, Image.open(file, formats=[n for n in _FORMATS if n in Image.OPEN]) as image:
        if image.format == "TIFF":
            page: Any = image
            if page.tag_v2.get(_SUBFILE, 0) & 1:  # a reduced copy, such as a thumbnail, of another page
                for number in range(1, min(getattr(page, "n_frames", 1), _PAGES)):
                    page.seek(number)
                    if not page.tag_v2.get(_SUBFILE, 0) & 1:
                        break
                else:
                    page.seek(0)
            tags: Any = getattr(image, "tag_v2", {})
            side = (tags[322], tags[323]) if 322 in tags else (image.width, tags.get(278, image.height))
            bits = tags.get(258, (1,))
            signed = 2 in tags.get(339, ()) and max(bits) == 8  # Pillow would read -1 as 255
            check_data(not signed, f"image {Path(path)}", "8 bits without a sign", "some with one; convert it")
            size = math.prod(side) * max(tags.get(277, 1), len(bits)) * max(bits) // 8
            for count in tags.get(325 if 322 in tags else 279, ()):
                check_tile(size, count, f"image {Path(path)}")
        yield image


def check_proportion(size: tuple[int, int], held: int, path: str | PathLike[str]) -> None:
    """Raise `DataError` for a large picture that claims more pixels than the bytes of its files may hold."""
    most = max(_SMALL, _MOST_A_BYTE * held)
    pixels = math.prod(size)
    got = f"{pixels:,} in {held:,} bytes; replace it"
    check_data(pixels <= most, f"image {Path(path)}", f"at most {most:,} pixels, in proportion to the file", got)


def check_tile(size: int, stored: int, name: str) -> None:
    """Raise `DataError` for a tile (or strip) that is stored in far more or far fewer bytes than its pixels take."""
    got, blank = f"one that is stored in {stored:,}, out of proportion; replace it", stored > 0 and size > 3 * _SMALL
    fits = stored <= 2 * size + 2**16 and not (blank and size > _MOST_A_BYTE * stored)
    check_data(fits, name, f"tiles of {size:,} bytes", got)


def from_pillow(image: Any, name: str, white: White | None = None) -> Tensor:
    """A Pillow image of any mode as `read_image` would read its file, `(3, H, W)`; `name` is for messages."""
    with opening(name, "decoded"):
        check_area(image.size, name)
        array = _pixels(image, name, upright=True, white=white)
    return torch.from_numpy(array).permute(2, 0, 1).contiguous()


def check_area(size: tuple[int, int], name: str) -> None:
    fits, got = 0 < math.prod(size) <= MAX_PIXELS, f"{size[0]} × {size[1]}; {_SMALLER}"
    check_data(fits, name, f"1 to {MAX_PIXELS:,} pixels", got)


def _orientation(image: Any) -> int:
    """The EXIF orientation, 1 to 8; 1 (as stored) where the metadata are damaged or hold another value."""
    try:
        orientation = image.getexif().get(_ORIENTATION_TAG, 1)
    except Exception:
        return 1
    return int(orientation) if orientation in range(1, len(_MOVES)) else 1


def _turned(image: Any, stored: int, left: int, *, upright: bool) -> Any:
    """Turn a picture upright, or back to the orientation of its file."""
    from PIL.Image import Transpose

    orientation = left if upright else _INVERSE.get(stored, stored) if left != stored else 1
    return image if orientation == 1 else image.transpose(Transpose[_MOVES[orientation]])


def _pixels(image: Any, name: str, *, upright: bool, white: White | None) -> NDArray[np.float32]:
    """Pixels `(H, W, 3)` in [0, 1], upright or as stored."""
    stored = _orientation(image)
    # Pillow turns white-is-zero TIFFs of 8 bits into black-is-zero, but not those of 16.
    inverted = image.mode in SIXTEEN_BITS and getattr(image, "tag_v2", {}).get(_PHOTOMETRIC_TAG) == 0
    image.load()
    image = _turned(image, stored, _orientation(image), upright=upright)
    wide = image.mode in SIXTEEN_BITS or image.mode == "F"
    pixels = np.asarray(image if wide else _over_white(image).convert("RGB"))
    if white is not None:
        pixels = between(pixels, black_and_white(white, pixels))
    elif not wide:
        pixels = pixels.astype(np.float32) / np.float32(255)
    else:
        most = 1.0 if image.mode == "F" else 65535.0
        low, high = pixels.min(), pixels.max()
        got = f"{low:g} to {high:g}; give white='auto', or the values that are black and white"
        fits = bool(low >= 0 and high <= most)  # also refuses NaN
        check_data(fits, name, f"values from 0 to {most:g} in mode {image.mode}", got)
        pixels = pixels.astype(np.float32) / np.float32(most)
    pixels = np.repeat(pixels[..., None], 3, axis=-1) if wide else pixels
    return 1 - pixels if inverted else pixels


def _over_white(image: Any) -> Any:
    """A Pillow image, whose transparent pixels are blended with white."""
    from PIL import Image

    if not ("transparency" in image.info or image.mode in ("RGBA", "LA", "PA", "RGBa", "La")):
        return image
    if image.mode == "La":
        image = image.convert("LA")
    image = image.convert("RGBA")
    return Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)


class PhotographPicture(LargePicture):
    """A picture in a file that Pillow reads."""

    path: Path

    def __init__(self, path: str | PathLike[str], white: White | None = None) -> None:
        self.path, self._white = Path(path), white
        self._array: NDArray[np.uint8] | None = None
        with opening(self.path, "opened"), open_pillow(self.path) as image:
            check_proportion(image.size, self.path.stat().st_size, self.path)
            self.size = upright_size(image)

    def pixels(self, box: tuple[int, int, int, int]) -> NDArray[np.uint8]:
        x1, y1, x2, y2 = box
        if self._array is None:
            with opening(self.path, "decoded"), open_pillow(self.path) as image:
                if image.mode in _PLAIN and self._white is None and not is_deep(image):
                    stored = _orientation(image)
                    image.load()
                    whole = _turned(image, stored, _orientation(image), upright=True)
                    width, height = whole.size
                    array = np.empty((height, width, 3), np.uint8)
                    for top in range(0, height, _ROWS):
                        rows = whole.crop((0, top, width, min(top + _ROWS, height)))
                        array[top : top + _ROWS] = np.asarray(_over_white(rows).convert("RGB"))
                    self._array = array  # only now that it is whole
        if self._array is None:
            self._array = to_bytes(read_photograph(self.path, white=self._white))  # which may warn
        return self._array[y1:y2, x1:x2]


def upright_size(image: Any) -> tuple[int, int]:
    """Size of a Pillow image after it is turned upright."""
    if _orientation(image) < 5:
        return image.size
    # Pillow swaps the sides of TIFFs itself before it turns them.
    tags = getattr(image, "tag_v2", {})
    width, height = tags.get(_WIDTH_TAG, image.size[0]), tags.get(_HEIGHT_TAG, image.size[1])
    return height, width


def to_bytes(image: Tensor) -> NDArray[np.uint8]:
    """Bytes `(H, W, 3)` of an image `(3, H, W)`, which is RGB in [0, 1] or bytes."""
    if image.dtype != torch.uint8:
        check_pixels(image, "image")
        image = image.clamp(0, 1).mul(255).round()
    return image.permute(1, 2, 0).to("cpu", torch.uint8).contiguous().numpy()
