"""Fuzz image files of many kinds, valid or damaged."""

import io
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from benchmarks.fuzz.runner import Case, Draw, changed
from semfov.data.images import MAX_PIXELS
from semfov.data.reading import read_image

# Pillow mode -> formats that keep it.
KINDS = {
    "1": ("png", "tiff"),
    "L": ("png", "tiff", "jpeg", "bmp"),
    "LA": ("png",),
    "P": ("png", "gif"),
    "RGB": ("png", "tiff", "jpeg", "bmp", "webp"),
    "RGBA": ("png", "tiff", "webp"),
    "CMYK": ("tiff", "jpeg"),
    "YCbCr": ("jpeg",),
    "I;16": ("png", "tiff"),
    "F": ("tiff",),
}
DAMAGES = ("none", "none", "cut", "bytes", "huge header", "garbage", "empty")
_ORIENTATION = 0x0112


def image_files(draw: Draw, folder: Path) -> Case:
    """`read_image`: the pixels that numpy computes if the file is valid and lossless, else an image or `DataError`."""
    mode = draw.choose(KINDS, "mode")
    kind = draw.choose(KINDS[mode], "format")
    wide = mode == "L" and kind == "png" and draw.integer(0, 30, "wide") == 0
    size = (20_000, 1) if wide else (draw.integer(1, 24, "width"), draw.integer(1, 24, "height"))
    image, expected = picture(mode, size, draw.rng)
    orientation = draw.integer(0, 9, "orientation") if kind in ("jpeg", "png", "tiff", "webp") else 1
    frames = draw.integer(1, 3, "frames") if kind in ("gif", "webp", "tiff") else 1
    content = encode(image, kind, orientation, frames, draw.rng)
    damage = draw.choose(DAMAGES, "damage")
    oriented = draw.integer(0, 3, "as stored") > 0
    path = folder / f"image.{kind}"
    path.write_bytes(damaged(content, damage, draw.rng))

    def read() -> Tensor:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".* pictures in it is shown")  # a TIFF of several pages says so
            return read_image(path, oriented=oriented)

    def check(pixels: Tensor) -> None:
        assert pixels.dtype == torch.float32
        assert pixels.shape[0] == 3
        assert 0 < pixels.shape[1] * pixels.shape[2] <= MAX_PIXELS
        assert bool(((pixels >= 0) & (pixels <= 1)).all())
        if damage == "none":
            upright = turned(expected, orientation) if oriented else expected
            assert pixels.shape[1:] == upright.shape[:2]
            if kind not in ("jpeg", "webp", "gif"):
                np.testing.assert_allclose(pixels.permute(1, 2, 0).numpy(), upright, atol=2.01 / 255)

    return Case(
        read,
        check,
        may=damage != "none",
        must=damage in ("garbage", "empty", "huge header"),
    )


def picture(mode: str, size: tuple[int, int], rng: np.random.Generator) -> tuple[Any, NDArray[np.float64]]:
    """Return a random picture of a Pillow mode, and the RGB values `(H, W, 3)` that it represents."""
    shape = size[::-1]
    if mode in ("1", "F", "I;16"):
        deep = rng.integers(0, 2**16, shape, dtype=np.uint16)
        kinds: dict[str, NDArray[Any]] = {"1": deep < 2**15, "F": (deep / 65535).astype(np.float32), "I;16": deep}
        stored = kinds[mode]
        return Image.fromarray(stored), (stored / (65535 if mode == "I;16" else 1.0))[..., None].repeat(3, -1)
    bands = {"LA": 2, "RGB": 3, "YCbCr": 3, "RGBA": 4, "CMYK": 4}.get(mode)
    pixels = rng.integers(0, 256, (*shape, bands) if bands else shape, dtype=np.uint8)
    image = Image.frombytes(mode, size, pixels.tobytes())
    values = pixels / 255
    if mode == "P":
        palette = rng.integers(0, 256, (256, 3), dtype=np.uint8)
        image.putpalette(palette.tobytes())
        values = palette[pixels] / 255
    elif mode == "L":
        values = values[..., None].repeat(3, -1)
    elif mode == "CMYK":
        values = (1 - values[..., :3]) * (1 - values[..., 3:])
    elif mode in ("LA", "RGBA"):
        alpha = values[..., -1:]
        values = np.broadcast_to(values[..., :-1] * alpha + 1 - alpha, (*shape, 3))
    return image, values


def encode(image: Any, kind: str, orientation: int, frames: int, rng: np.random.Generator) -> bytes:
    """Encode the picture as the first of `frames` in a file."""
    options: dict[str, Any] = {}
    if orientation != 1:
        exif = Image.Exif()
        exif[_ORIENTATION] = orientation
        options["exif"] = exif
    if frames > 1:
        other = Image.fromarray(rng.integers(0, 256, (image.height, image.width), dtype=np.uint8)).convert(image.mode)
        options |= {"save_all": True, "append_images": [other] * (frames - 1)}
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def damaged(content: bytes, damage: str, rng: np.random.Generator) -> bytes:
    """Return the contents of the file after the damage."""
    if damage == "huge header":
        side = int(rng.integers(10_000, 2**31 - 1))
        header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
        chunk = struct.pack(">I", 13) + b"IHDR" + header + struct.pack(">I", zlib.crc32(b"IHDR" + header))
        return b"\x89PNG\r\n\x1a\n" + chunk + content[-64:]
    if damage == "garbage":
        return rng.bytes(int(rng.integers(1, 200)))
    return b"" if damage == "empty" else changed(content, damage, rng)


def turned(pixels: NDArray[np.float64], orientation: int) -> NDArray[np.float64]:
    """Turn pixels `(H, W, 3)` by an EXIF orientation from 1 to 8; other values are ignored."""
    moves = {
        2: lambda p: p[:, ::-1],
        3: lambda p: p[::-1, ::-1],
        4: lambda p: p[::-1],
        5: lambda p: p.transpose(1, 0, 2),
        6: lambda p: np.rot90(p, -1),
        7: lambda p: p[::-1, ::-1].transpose(1, 0, 2),
        8: lambda p: np.rot90(p, 1),
    }
    return moves[orientation](pixels) if orientation in moves else pixels
