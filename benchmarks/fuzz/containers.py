"""Files that hold pictures, films and recordings of eyes, with heads that claim sizes, and with other files in them."""

import io
import struct
import tempfile
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from benchmarks.fuzz.runner import changed

SIDE = 48
CONTENTS = ("sound", "sound", "mosaic behind it", "head of a mosaic", "cut", "bytes")
_LONG = 4  # a type of values in a TIFF: 4 bytes without a sign
_MOST_PARTS = 100_000  # pages, scans or lines that a file really has, where it claims more
_MOST_TEXT = 10_000_000  # bytes of a text that a file really has
_SUFFIXES = {
    "animation": "gif",
    "bigtiff": "tif",
    "sparse": "tif",
    "strip": "tif",
    "pages": "tif",
    "ome": "ome.tif",
    "imagej": "tif",
    "jpg of scans": "jpg",
    "cmyk": "jpg",
    "ycck": "jpg",
    "ppm with a comment": "ppm",
    "png with a text": "png",
    "png of 16 bits": "png",
    "png with a palette": "png",
    "png with an alpha": "png",
}
_SAVED_AS = {"jpg": "JPEG", "tif": "TIFF", "jp2": "JPEG2000", "ppm": "PPM", "cmyk": "JPEG", "ycck": "JPEG"}


def suffix_of(container: str) -> str:
    """Name the end of a file of a container, such as `tif` of a sparse TIFF."""
    return _SUFFIXES.get(container, container)


def content_of(container: str, content: str, claim: int, names: Sequence[str], rng: np.random.Generator) -> bytes:
    """Make the bytes of a file.

    Args:
        container: any of `CONTAINERS`.
        content: any of `CONTENTS`.
        claim: the sides of the picture by its head, or the number of its parts.
        names: other files, of which one may be named in the file.
        rng: generator of what is drawn.

    Returns:
        The bytes.
    """
    name = rng.choice(names)
    text = mosaic(name, claim).encode()
    written = CONTAINERS[container](container, claim, name)
    if content == "mosaic behind it":
        return written + text
    if content == "head of a mosaic":
        return written[: int(rng.integers(4, 40))] + text
    return changed(written, content, rng)


def mosaic(name: str, side: int) -> str:
    """Write a mosaic with one source, as GDAL has it."""
    rect = f'xOff="0" yOff="0" xSize="{side}" ySize="{side}"'
    source = f'<SimpleSource><SourceFilename relativeToVRT="0">{name}</SourceFilename><SourceBand>1</SourceBand>'
    source += f"<SrcRect {rect}/><DstRect {rect}/></SimpleSource>"
    bands = "".join(f'<VRTRasterBand dataType="Byte" band="{band}">{source}</VRTRasterBand>' for band in (1, 2, 3))
    return f'<VRTDataset rasterXSize="{side}" rasterYSize="{side}">{bands}</VRTDataset>'


def _pixels() -> NDArray[np.uint8]:
    """Draw a picture."""
    return np.random.default_rng(0).integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)


def _mosaic(container: str, claim: int, name: str) -> bytes:
    """Write a mosaic that names another file."""
    return mosaic(name, claim).encode()


def _vectors(container: str, claim: int, name: str) -> bytes:
    """Write a page of PostScript or a drawing in SVG."""
    if container == "eps":
        return b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 48 48\nshowpage\n"
    return b'<svg xmlns="http://www.w3.org/2000/svg" width="48" height="48"><rect width="9" height="9"/></svg>'


def _saved(container: str, claim: int, name: str) -> bytes:
    """Encode a sound picture by Pillow, and change the sides in its head."""
    stream = io.BytesIO()
    Image.fromarray(_pixels()).save(stream, _SAVED_AS.get(container, container.upper()))
    return _claiming(container, stream.getvalue(), claim)


def _claiming(container: str, content: bytes, side: int) -> bytes:
    """Change the sides in the head of a picture."""
    if side == SIDE:
        return content
    head = bytearray(content)
    short_side = min(side, 65_535)  # where the head has two bytes
    if container == "png":
        head[16:24] = struct.pack(">II", side, side)
        head[29:33] = struct.pack(">I", zlib.crc32(head[12:29]))
    elif container == "bmp":
        head[18:26] = struct.pack("<ii", side, side)
    elif container == "gif":
        head[6:10] = struct.pack("<HH", short_side, short_side)
    elif container == "jpg":
        place = head.index(b"\xff\xc0") + 5
        head[place : place + 4] = struct.pack(">HH", short_side, short_side)
    elif container == "jp2":
        place = head.index(b"ihdr") + 4
        head[place : place + 8] = struct.pack(">II", side, side)
        place = head.index(b"\xff\x51") + 6
        head[place : place + 8] = struct.pack(">II", side, side)
    elif container == "ppm":
        return content.replace(b"48 48", f"{side} {side}".encode(), 1)
    elif container == "tif":
        return _tiff_claiming(content, {"ImageWidth": side, "ImageLength": side})
    return bytes(head)


def _tiff_claiming(content: bytes, numbers: dict[str, int]) -> bytes:
    """Change the numbers in some tags of a TIFF."""
    head = bytearray(content)
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        for name, number in numbers.items():
            tag = file.pages.first.tags[name]
            struct.pack_into("<H", head, tag.offset + 2, _LONG)
            struct.pack_into("<I", head, tag.valueoffset, number)
    return bytes(head)


def _bigtiff(container: str, claim: int, name: str) -> bytes:
    """Write a TIFF with offsets of 8 bytes."""
    stream = io.BytesIO()
    tifffile.imwrite(stream, _pixels(), photometric="rgb", bigtiff=True)
    content = stream.getvalue()
    return content if claim == SIDE else _tiff_claiming(content, {"ImageWidth": claim, "ImageLength": claim})


def _sparse(container: str, claim: int, name: str) -> bytes:
    """Write a large TIFF of which one tile is stored."""
    stream = io.BytesIO()
    side = min(claim, 100_000)
    tile = 4096
    tiles = [np.full((tile, tile), 99, np.uint8), *[None] * ((-(-side // tile)) ** 2 - 1)]
    tifffile.imwrite(
        stream,
        iter(tiles),
        shape=(side, side),
        dtype=np.uint8,
        tile=(tile, tile),
        photometric="minisblack",
        compression="zlib",
    )
    return stream.getvalue()


def _strip(container: str, claim: int, name: str) -> bytes:
    """Write a TIFF whose only strip has as many rows as are claimed."""
    stream = io.BytesIO()
    tifffile.imwrite(stream, _pixels(), photometric="rgb", rowsperstrip=SIDE, compression="zlib")
    return _tiff_claiming(stream.getvalue(), {"ImageLength": claim, "RowsPerStrip": claim})


def _pages(container: str, claim: int, name: str) -> bytes:
    """Write a TIFF of many pages, each of one grey pixel."""
    tags = {256: 1, 257: 1, 258: 8, 259: 1, 262: 1, 273: 8, 277: 1, 278: 1, 279: 1}
    entries = b"".join(struct.pack("<HHII", tag, _LONG, 1, value) for tag, value in tags.items())
    length = 2 + len(entries) + 4
    head = b"II*\0" + struct.pack("<I", 12) + b"\x63\0\0\0"  # the pixel, at 8
    pages = []
    number = min(claim, _MOST_PARTS)
    for page in range(number):
        following = 12 + (page + 1) * length if page + 1 < number else 0
        pages.append(struct.pack("<H", len(tags)) + entries + struct.pack("<I", following))
    return head + b"".join(pages)


def _series(container: str, claim: int, name: str) -> bytes:
    """Write channels as pages, whose description claims a number of them, and in OME another file that has them."""
    stream = io.BytesIO()
    channels = np.moveaxis(_pixels(), -1, 0)
    if container == "imagej":
        tifffile.imwrite(stream, channels, imagej=True, metadata={"axes": "CYX", "mode": "composite"})
        # The number keeps its length, as the description does.
        return stream.getvalue().replace(b"images=3", f"images={claim % 10}".encode(), 1)
    block = f'<UUID FileName="{name}">urn:uuid:0</UUID>'
    description = (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0">'
        f'<Pixels ID="Pixels:0" DimensionOrder="XYCZT" Type="uint8" SizeX="{SIDE}" SizeY="{SIDE}" SizeC="{claim}" '
        f'SizeZ="1" SizeT="1"><TiffData IFD="0" PlaneCount="{claim}">{block}</TiffData></Pixels></Image></OME>'
    )
    tifffile.imwrite(stream, channels, photometric="minisblack", description=description, metadata=None)
    return stream.getvalue()


def _of_scans(container: str, claim: int, name: str) -> bytes:
    """Write a JPEG that repeats its last scan."""
    stream = io.BytesIO()
    Image.fromarray(_pixels()).save(stream, "JPEG", progressive=True)
    content = stream.getvalue()
    last_scan = content[content.rindex(b"\xff\xda") : -2]
    return content[:-2] + last_scan * min(claim, _MOST_PARTS // 10) + content[-2:]


def _with_four_inks(container: str, claim: int, name: str) -> bytes:
    """Write a JPEG of four inks, as they are or as YCCK, which the last byte of Adobe's segment tells."""
    stream = io.BytesIO()
    Image.fromarray(_pixels()).convert("CMYK").save(stream, "JPEG")
    head = bytearray(stream.getvalue())
    if container == "ycck":
        head[head.index(b"Adobe") + 11] = 2
    return _claiming("jpg", bytes(head), claim)


def _with_comment(container: str, claim: int, name: str) -> bytes:
    """Write a PPM with a long comment."""
    return b"P6\n#" + b"a" * min(claim, _MOST_TEXT) + b"\n48 48\n255\n" + _pixels().tobytes()


def _chunk(kind: bytes, data: bytes) -> bytes:
    """Write a chunk of a PNG."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _with_text(container: str, claim: int, name: str) -> bytes:
    """Write a PNG with a long text and a compressed one."""
    stream = io.BytesIO()
    Image.fromarray(_pixels()).save(stream, "PNG")
    content = stream.getvalue()
    text = b"a" * min(claim, _MOST_TEXT)
    chunks = _chunk(b"tEXt", b"Comment\0" + text) + _chunk(b"zTXt", b"Title\0\0" + zlib.compress(text))
    return content[:33] + chunks + content[33:]


def _png(container: str, claim: int, name: str) -> bytes:
    """Write a PNG of 16 bits a channel, with a palette or with an alpha."""
    stream = io.BytesIO()
    picture = Image.fromarray(_pixels())
    if container == "png of 16 bits":
        pixels = _pixels().astype(">u2") * 257
        rows = b"".join(b"\0" + row.tobytes() for row in pixels)
        head = _chunk(b"IHDR", struct.pack(">IIBBBBB", SIDE, SIDE, 16, 2, 0, 0, 0))
        stream.write(b"\x89PNG\r\n\x1a\n" + head + _chunk(b"IDAT", zlib.compress(rows)) + _chunk(b"IEND", b""))
    elif container == "png with a palette":
        picture.quantize(17).save(stream, "PNG", transparency=3)
    else:
        picture.putalpha(99)
        picture.save(stream, "PNG")
    return _claiming("png", stream.getvalue(), claim)


def _film(container: str, claim: int, name: str) -> bytes:
    """Write a film of three frames, of which an AVI claims any number."""
    if container == "animation":
        stream = io.BytesIO()
        frames = [Image.new("RGB", (SIDE, SIDE), (shade, shade, shade)) for shade in (0, 90, 180)]
        frames[0].save(stream, "GIF", save_all=True, append_images=frames[1:])
        return _claiming("gif", stream.getvalue(), claim)
    head = bytearray(_encoded_film(container))
    if container == "avi":
        place = head.index(b"avih") + 8 + 16  # of the number of frames
        struct.pack_into("<I", head, place, claim)
    return bytes(head)


@cache
def _encoded_film(suffix: str) -> bytes:
    """Encode a film of three frames."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"film.{suffix}"
        code = cv2.VideoWriter.fourcc(*("MJPG" if suffix == "avi" else "mp4v"))
        writer = cv2.VideoWriter(str(path), code, 25, (SIDE, SIDE))
        for _ in range(3):
            writer.write(_pixels())
        writer.release()
        return path.read_bytes()


def _recording(container: str, claim: int, name: str) -> bytes:
    """Write fixations of a person in the picture `a.png`, whose frame has the sides that are claimed."""
    lines = range(min(claim, _MOST_PARTS // 10))
    if container == "csv":
        rows = "".join(f"a.png,ann,{line % 40},9.5,{claim},{SIDE}\n" for line in lines)
        return b"picture,subject,x,y,width,height\n" + rows.encode()
    events = "".join(f"EFIX R   {9 * line}\t{9 * line + 8}\t8\t {line % 40}.5\t 9.5\t 900\n" for line in lines)
    head = f"** CONVERTED FROM {name}\nMSG\t0 DISPLAY_COORDS 0 0 {claim} {SIDE}\nMSG\t0 !V IMGLOAD FILL a.png\n"
    return (head + events).encode()


RECORDINGS = ("csv", "asc")
"""Containers of fixations."""

_Writer = Callable[[str, int, str], bytes]

CONTAINERS: dict[str, _Writer] = {
    **dict.fromkeys(("png", "jpg", "tif", "webp", "gif", "bmp", "ppm", "jp2"), _saved),
    "bigtiff": _bigtiff,
    "sparse": _sparse,
    "strip": _strip,
    "pages": _pages,
    **dict.fromkeys(("ome", "imagej"), _series),
    "jpg of scans": _of_scans,
    **dict.fromkeys(("cmyk", "ycck"), _with_four_inks),
    "ppm with a comment": _with_comment,
    "png with a text": _with_text,
    **dict.fromkeys(("png of 16 bits", "png with a palette", "png with an alpha"), _png),
    "vrt": _mosaic,
    **dict.fromkeys(("eps", "svg"), _vectors),
    **dict.fromkeys(("animation", "avi", "mp4"), _film),
    **dict.fromkeys(RECORDINGS, _recording),
}
"""What writes a container, from its name, what it claims, and the name of another file."""
