"""Pictures that are read by windows: in memory, mapped from a file, tiled TIFF, or decoded when first needed."""

import warnings
import weakref
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.images import orientation, read_image, turned
from semfov.data.inputs import ImageLike, as_image, channels_first, pixels_of
from semfov.errors import DataError, SemfovError, check, check_pixels
from semfov.io.files import check_regular

Box = tuple[int, int, int, int]

_PLAIN = ("RGB", "L", "CMYK", "YCbCr")  # of 8 bits, and nothing is transparent
_STRIP = 1 << 24  # number of pixels that are read at once for a reduced view


class LargePicture(ABC):
    """A picture of bytes that is read by windows.

    Attributes:
        size: `(width, height)` in pixels.
    """

    size: tuple[int, int]

    @abstractmethod
    def pixels(self, box: Box) -> NDArray[np.uint8]:
        """Pixels `(h, w, 3)`, RGB, of a window `(x1, y1, x2, y2)` inside the picture."""

    def read(self, box: Box, reduction: int = 1) -> Tensor:
        """Read a window, reduced by a power of two where that keeps memory small.

        Large windows are read in strips. Each strip is averaged over squares of `reduction` pixels. So no more than a
        strip of 16 million pixels (48 MB) is held in memory, however large the window is.

        Args:
            box: `(x1, y1, x2, y2)` in whole pixels, inside the picture.
            reduction: factor, a power of two, by which the window may be reduced.

        Returns:
            `(3, h, w)`, bytes, channels last in memory.

        Raises:
            InputError: the box is empty or not inside the picture.
        """
        x1, y1, x2, y2 = box
        width, height = self.size
        check(0 <= x1 < x2 <= width and 0 <= y1 < y2 <= height, "box", f"inside {width} × {height}", box)
        if reduction <= 1 or (x2 - x1) * (y2 - y1) <= _STRIP:
            return _tensor(self.pixels(box))
        from PIL import Image

        rows = max(1, _STRIP // (x2 - x1) // reduction) * reduction
        strips = []
        for top in range(y1, y2, rows):
            strip = self.pixels((x1, top, x2, min(y2, top + rows)))
            strips.append(np.asarray(Image.fromarray(strip).reduce(reduction)))
        return _tensor(np.concatenate(strips))


class ArrayPicture(LargePicture):
    """An array of bytes, in memory or a `numpy.memmap`, of which only windows are read.

    Args:
        array: `(H, W, 3)` or `(H, W)`.

    Raises:
        InputError: the array has another shape or dtype, or no pixel.
    """

    def __init__(self, array: NDArray[np.uint8]) -> None:
        fits = array.dtype == np.uint8 and (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3))
        check(fits and array.size > 0, "array", "bytes of shape (H, W, 3) or (H, W)", f"{array.dtype} {array.shape}")
        self._array = array
        self.size = array.shape[1], array.shape[0]

    def pixels(self, box: Box) -> NDArray[np.uint8]:
        """A window."""
        x1, y1, x2, y2 = box
        window = self._array[y1:y2, x1:x2]
        return np.repeat(window[..., None], 3, -1) if window.ndim == 2 else window


class MemoryPicture(ArrayPicture):
    """A picture of any common kind (`semfov.as_image`), kept in memory as bytes.

    Args:
        image: the picture.

    Raises:
        InputError: it is no picture, or a batch of several.
    """

    def __init__(self, image: ImageLike) -> None:
        if isinstance(image, Tensor | np.ndarray) and image.dtype in (torch.uint8, np.dtype(np.uint8)):
            # Bytes are not converted to floats in between: a large picture would take four times the memory.
            pixels = channels_first(pixels_of(image, "picture"), "picture", choose=isinstance(image, Tensor))
            check(len(pixels) == 1, "picture", "one picture", f"a batch of {len(pixels)}; give them one by one")
            super().__init__(to_bytes(pixels[0]))
        else:
            super().__init__(to_bytes(as_image(image, argument="picture").detach()))


def to_bytes(image: Tensor) -> NDArray[np.uint8]:
    """Convert an image `(3, H, W)`, RGB in [0, 1] or bytes, to pixels `(H, W, 3)`, bytes."""
    if image.dtype != torch.uint8:
        check_pixels(image, "image")
        image = image.clamp(0, 1).mul(255).round()
    pixels: NDArray[np.uint8] = image.permute(1, 2, 0).to("cpu", torch.uint8).contiguous().numpy()
    return pixels


class PhotographPicture(LargePicture):
    """An image file that Pillow reads.

    Formats such as JPEG cannot be read by windows. The whole picture is decoded when a window is first needed (three
    bytes per pixel), and kept. A reduced view of a whole JPEG is decoded coarsely before that (`Image.draft`), which
    takes a small part of the memory and time.

    Args:
        path: path of the file.

    Raises:
        DataError: there is no such file, or it is no picture.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        from PIL import Image

        self.path = Path(path)
        self._array: NDArray[np.uint8] | None = None
        with _opening(self.path, "opened"), Image.open(self.path) as image:
            self.size = image.size
            upright = orientation(image) == 1
            self._drafts = image.format == "JPEG" and image.mode in ("RGB", "L")
        if not upright:
            # The upright picture may have another size, and windows refer to it.
            self.size = self._whole().shape[1::-1]

    def pixels(self, box: Box) -> NDArray[np.uint8]:
        """A window."""
        x1, y1, x2, y2 = box
        return self._whole()[y1:y2, x1:x2]

    def read(self, box: Box, reduction: int = 1) -> Tensor:
        """Read a window; the whole of a JPEG that was not decoded yet in the coarsest draft that is allowed."""
        whole = box == (0, 0, *self.size)
        if not (whole and reduction > 1 and self._drafts and self._array is None):
            return super().read(box, reduction)
        from PIL import Image

        with _opening(self.path, "decoded"), Image.open(self.path) as image:
            image.draft("RGB", (-(-self.size[0] // reduction), -(-self.size[1] // reduction)))
            return _tensor(np.asarray(image.convert("RGB")))

    def _whole(self) -> NDArray[np.uint8]:
        if self._array is None:
            from PIL import Image

            # Given a path, Pillow would map an uncompressed TIFF into memory, and mix up its rows when turning it.
            with _opening(self.path, "decoded"), self.path.open("rb") as file, Image.open(file) as image:
                if image.mode in _PLAIN and "transparency" not in image.info:
                    stored = orientation(image)
                    image.load()
                    self._array = np.asarray(turned(image, stored, orientation(image), upright=True).convert("RGB"))
                else:
                    self._array = to_bytes(read_image(self.path))
        return self._array


class TiffPicture(LargePicture):
    """A TIFF of bytes, read tile by tile (or strip by strip) by `tifffile`.

    Only the tiles that a window touches are decoded, one at a time.

    Args:
        path: path of the file, whose first page is read.

    Raises:
        DataError: `tifffile` is not installed, or the page is not grey or RGB of 8 bits.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        try:
            import tifffile
        except ImportError:
            raise DataError(f"{path}: tiled TIFFs need tifffile; pip install tifffile") from None
        self.path = Path(path)
        with _opening(self.path, "opened"):
            self._file = tifffile.TiffFile(path)
            weakref.finalize(self, self._file.close)
            page: Any = self._file.pages[0]
            shape = page.shape
        fits = page.dtype == np.uint8 and (len(shape) == 2 or (len(shape) == 3 and shape[2] in (3, 4)))
        if not fits or page.planarconfig not in (None, 1):
            raise DataError(f"{path}: expected grey or RGB of 8 bits, pixel by pixel, got {page.dtype} {shape}")
        self._page = page
        self.size = shape[1], shape[0]

    def pixels(self, box: Box) -> NDArray[np.uint8]:
        """A window."""
        with _opening(self.path, "decoded"):
            return self._tiles(box)

    def _tiles(self, box: Box) -> NDArray[np.uint8]:
        x1, y1, x2, y2 = box
        page = self._page
        wide, high = (page.tilewidth, page.tilelength) if page.is_tiled else (self.size[0], page.rowsperstrip)
        across = -(-self.size[0] // wide)
        window = np.zeros((y2 - y1, x2 - x1, 3), np.uint8)
        numbers = [
            row * across + column
            for row in range(y1 // high, -(-y2 // high))
            for column in range(x1 // wide, -(-x2 // wide))
        ]
        for number in numbers:
            offset, count = page.dataoffsets[number], page.databytecounts[number]
            if not count:
                continue  # a tile that the file does not hold is black
            self._file.filehandle.seek(offset)
            data = self._file.filehandle.read(count)
            tile = page.decode(data, number, jpegtables=page.jpegtables)[0][0]
            top, left = number // across * high, number % across * wide
            tile = tile[: self.size[1] - top, : self.size[0] - left]
            rows = slice(max(y1 - top, 0), min(y2 - top, tile.shape[0]))
            columns = slice(max(x1 - left, 0), min(x2 - left, tile.shape[1]))
            at = slice(top + rows.start - y1, top + rows.stop - y1)
            along = slice(left + columns.start - x1, left + columns.stop - x1)
            window[at, along] = tile[rows, columns, : min(3, tile.shape[-1])]
        return window


def open_large(source: LargePicture | ImageLike) -> LargePicture:
    """Open a picture to be read by windows.

    Args:
        source: a picture of any common kind (`semfov.as_image`), or a `LargePicture`. Arrays of bytes `(H, W, 3)` and
            `(H, W)` are not copied, and of a `numpy.memmap` only windows are read. Files with the ending `.tif` or
            `.tiff` are read tile by tile.

    Returns:
        The picture.

    Raises:
        InputError: the source is no picture.
        DataError: the file cannot be read.

    >>> open_large(torch.rand(3, 20, 30)).read((10, 5, 30, 15)).shape
    torch.Size([3, 10, 20])
    """
    if isinstance(source, LargePicture):
        return source
    if isinstance(source, np.ndarray) and source.dtype == np.uint8 and source.size and _by_rows(source.shape):
        return ArrayPicture(source)
    if not isinstance(source, str | PathLike):
        return MemoryPicture(source)
    check("://" not in str(source), "picture", "a file on this machine", f"{str(source)!r}; download it first")
    if Path(source).suffix.lower() in (".tif", ".tiff"):
        return TiffPicture(source)
    return PhotographPicture(source)


def _by_rows(shape: tuple[int, ...]) -> bool:
    """Tell whether a shape is `(H, W)` or `(H, W, 3)`, and cannot be `(3, H, W)`."""
    return len(shape) == 2 or (len(shape) == 3 and shape[2] == 3 and shape[0] != 3)


@contextmanager
def _opening(path: Path, what: str) -> Iterator[None]:
    """Raise `DataError` where a file cannot be read as a picture, whatever error a decoder raises."""
    check_regular(path, f"image {path}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of damaged metadata and of large files
        try:
            yield
        except FileNotFoundError:
            raise DataError(f"image {path}: no such file") from None
        except SemfovError:
            raise
        except Exception as error:  # decoders of damaged files raise errors of many kinds
            reason = " ".join(str(error).split()) or type(error).__name__
            raise DataError(f"image {path}: cannot be {what} ({reason}); replace it") from None


def _tensor(pixels: NDArray[np.uint8]) -> Tensor:
    """View bytes `(h, w, 3)` as `(3, h, w)`; they are copied only where torch cannot share their memory."""
    shared = pixels.flags.writeable and min(pixels.strides) >= 0
    return torch.from_numpy(pixels if shared else pixels.copy()).permute(2, 0, 1)
