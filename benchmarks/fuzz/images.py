"""Fuzz image files of many kinds, valid or damaged."""

import io
import struct
import tempfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from benchmarks.fuzz.runner import attempt, choose, draw_rng, failed, outcome
from semfov.data.images import MAX_PIXELS, read_image

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


def image_files(data: st.DataObject) -> str:
    """`read_image`: the pixels that numpy computes if the file is valid and lossless, else an image or `DataError`."""
    mode = choose(data, KINDS, "mode")
    kind = choose(data, KINDS[mode], "format")
    wide = mode == "L" and kind == "png" and data.draw(st.integers(0, 30), label="wide") == 0
    size = (20_000, 1) if wide else (data.draw(st.integers(1, 24)), data.draw(st.integers(1, 24)))
    rng = draw_rng(data)
    image, expected = picture(mode, size, rng)
    orientation = data.draw(st.integers(0, 9), label="orientation") if kind in ("jpeg", "png", "tiff", "webp") else 1
    frames = data.draw(st.integers(1, 3), label="frames") if kind in ("gif", "webp", "tiff") else 1
    content = encode(image, kind, orientation, frames, rng)
    damage = choose(data, DAMAGES, "damage")
    content = damaged(content, damage, rng)
    oriented = data.draw(st.integers(0, 3), label="as stored") > 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"image.{kind}")
        path.write_bytes(content)
        result = attempt(lambda: read_image(path, oriented=oriented))
    if failed(result):
        assert damage != "none", result
        return outcome(result)
    assert isinstance(result, torch.Tensor)
    assert result.dtype == torch.float32
    assert result.shape[0] == 3
    assert 0 < result.shape[1] * result.shape[2] <= MAX_PIXELS
    assert bool(((result >= 0) & (result <= 1)).all())
    assert damage not in ("garbage", "empty", "huge header"), "an image out of nothing"
    if damage == "none":
        upright = turned(expected, orientation) if oriented else expected
        assert result.shape[1:] == upright.shape[:2]
        if kind not in ("jpeg", "webp", "gif"):
            np.testing.assert_allclose(result.permute(1, 2, 0).numpy(), upright, atol=2.01 / 255)
    return "result"


def picture(mode: str, size: tuple[int, int], rng: np.random.Generator) -> tuple[Any, NDArray[np.float64]]:
    """A random picture of a Pillow mode, and the RGB values `(H, W, 3)` that it represents."""
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
    """The contents of the file after the damage."""
    if damage == "cut":
        return content[: int(rng.integers(1, len(content)))]
    if damage == "bytes":
        changed = np.frombuffer(content, np.uint8).copy()
        places = rng.integers(0, len(changed), int(rng.integers(1, 9)))
        changed[places] = rng.integers(0, 256, len(places))
        return changed.tobytes()
    if damage == "huge header":
        side = int(rng.integers(10_000, 2**31 - 1))
        header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
        chunk = struct.pack(">I", 13) + b"IHDR" + header + struct.pack(">I", zlib.crc32(b"IHDR" + header))
        return b"\x89PNG\r\n\x1a\n" + chunk + content[-64:]
    if damage == "garbage":
        return rng.bytes(int(rng.integers(1, 200)))
    return b"" if damage == "empty" else content


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
