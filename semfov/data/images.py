"""Reading photographs of any common kind into RGB tensors."""

import warnings
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.errors import DataError

MAX_PIXELS = 89_478_485
"""Largest picture that is read, in pixels (1 GiB as float32 RGB): Pillow's limit against decompression bombs."""

_ORIENTATION_TAG = 0x0112
_SIXTEEN_BITS = ("I;16", "I;16L", "I;16B", "I;16N", "I")


def read_image(path: str | PathLike[str], *, oriented: bool = True) -> Tensor:
    """Read an image file as RGB.

    The EXIF orientation is applied, so the image stands as viewers show it. Grey images get three equal channels,
    CMYK and YCbCr are converted, transparent pixels are laid on white, 16-bit greys keep their depth, and of an
    animation the first frame is taken. Colour profiles are not applied.

    Args:
        path: a file in any format that Pillow reads.
        oriented: False leaves the pixels as they are stored, for annotations made in that frame.

    Returns:
        `(3, H, W)`, float32 in [0, 1].

    Raises:
        DataError: the file is missing, unreadable, not an image, truncated, or of more than `MAX_PIXELS` pixels.

    >>> import tempfile
    >>> from PIL import Image
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     Image.new("L", (4, 2), 255).save(folder + "/white.png")
    ...     read_image(folder + "/white.png").shape
    torch.Size([3, 2, 4])
    """
    from PIL import Image, UnidentifiedImageError

    name = f"image {Path(path)}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of damaged metadata and of large files; the limit below refuses the latter
        try:
            with Image.open(path) as image:
                _check_pixels(image.size, name)
                image.load()
                picture = _upright(image) if oriented else image
                array = _rgb(picture, name)
        except DataError:
            raise
        except FileNotFoundError:
            raise DataError(f"{name}: no such file; check data.root and the file names of the annotations") from None
        except IsADirectoryError:
            raise DataError(f"{name}: expected a file, got a folder") from None
        except PermissionError:
            raise DataError(f"{name}: no permission to read it; check the file's mode and owner") from None
        except UnidentifiedImageError:
            raise DataError(f"{name}: not an image in a format that Pillow reads; replace or remove it") from None
        except Image.DecompressionBombError:
            raise DataError(f"{name}: more than {MAX_PIXELS:,} pixels; reduce it") from None
        except Exception as error:  # damaged files raise nearly anything in Pillow's decoders
            reason = " ".join(str(error).split()) or type(error).__name__
            raise DataError(
                f"{name}: truncated, damaged or of a kind that is not supported ({reason}); replace it"
            ) from error
    return torch.from_numpy(array).permute(2, 0, 1).contiguous()


def _check_pixels(size: tuple[int, int], name: str) -> None:
    width, height = size
    if not 0 < width * height <= MAX_PIXELS:
        raise DataError(f"{name}: expected 1 to {MAX_PIXELS:,} pixels, got {width} × {height}; reduce or replace it")


def _upright(image: Any) -> Any:
    """Apply the EXIF orientation; a picture with damaged EXIF data stays as stored."""
    from PIL.Image import Transpose

    try:
        orientation = image.getexif().get(_ORIENTATION_TAG, 1)
    except Exception:
        return image
    moves = {
        2: Transpose.FLIP_LEFT_RIGHT,
        3: Transpose.ROTATE_180,
        4: Transpose.FLIP_TOP_BOTTOM,
        5: Transpose.TRANSPOSE,
        6: Transpose.ROTATE_270,
        7: Transpose.TRANSVERSE,
        8: Transpose.ROTATE_90,
    }
    return image.transpose(moves[orientation]) if orientation in moves else image


def _rgb(image: Any, name: str) -> NDArray[np.float32]:
    """Pixels `(H, W, 3)` in [0, 1] of a Pillow image of any mode."""
    from PIL import Image

    if image.mode in _SIXTEEN_BITS or image.mode == "F":
        grey = np.asarray(image, dtype=np.float32)
        white = 1.0 if image.mode == "F" else 65535.0
        if not (grey.min() >= 0 and grey.max() <= white):  # also refuses NaN
            raise DataError(f"{name}: expected values from 0 to {white:g} in mode {image.mode}; convert it to 8 bits")
        return np.repeat(grey[..., None] / np.float32(white), 3, axis=-1)
    if "transparency" in image.info or image.mode in ("RGBA", "LA", "PA", "RGBa", "La"):
        if image.mode == "La":
            image = image.convert("LA")
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255)
