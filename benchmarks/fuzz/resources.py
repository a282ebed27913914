"""Fuzz what a picture makes the process do, at every door: files, requests, processes, memory and time."""

import contextlib
import io
import struct
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

from benchmarks.fuzz.runner import Case, Draw, changed
from benchmarks.fuzz.watch import MOST_SECONDS, Outcome, listener, opened_files, watched
from semfov import ActivePerception, read_image
from semfov.cli import app
from semfov.cli.main import main
from semfov.data.large import open_large
from semfov.errors import DataError

SIDE = 48
CONTAINERS = ("png", "jpg", "tif", "bigtiff", "sparse", "webp", "gif", "bmp", "ppm", "jp2", "vrt", "eps", "svg")
CONTENTS = ("sound", "sound", "mosaic behind it", "head of a mosaic", "cut", "bytes")
SIDECARS = ("none", "{name}.ovr", "{name}.aux.xml", "{name}.msk", "{stem}.wld", "{stem}.prj", "{stem}.json")
CLAIMS = (SIDE, SIDE, 20_000, 100_000, 1_000_000, 2**31 - 1)
MOST_BYTES = 512 << 20
BYTES_PER_BYTE = 200
_ENDS = {"bigtiff": "tif", "sparse": "tif"}
_LONG = 4  # a type of values in a TIFF: 4 bytes without a sign
_FORMATS = {"jpg": "JPEG", "tif": "TIFF", "jp2": "JPEG2000", "ppm": "PPM"}


def resources(draw: Draw, folder: Path) -> Case:
    """Every door: a result or an error, within memory and time, and no other file, request or process."""
    public = folder / "public"
    private = folder / "private"
    for place in (public, private):
        place.mkdir()
    secret = private / "secret.tif"
    Image.new("RGB", (SIDE, SIDE), (201, 201, 201)).save(secret)
    container = draw.choose(CONTAINERS, "container")
    content = draw.choose(CONTENTS, "content")
    sidecar = draw.choose(SIDECARS, "sidecar")
    claim = draw.choose(CLAIMS, "claimed side")
    door = draw.choose(DOORS, "door")
    path = public / f"a.{_ENDS.get(container, container)}"

    def call() -> Outcome:
        with listener() as (address, requests):
            names = [str(secret), f"/vsicurl/{address}/a.tif"]
            path.write_bytes(_content(container, content, claim, names, draw.rng))
            if sidecar != "none":
                beside = public / sidecar.format(name=path.name, stem=path.stem)
                beside.write_text(_mosaic(draw.rng.choice(names), SIDE))
            most = MOST_BYTES + BYTES_PER_BYTE * path.stat().st_size
            _agent()  # is loaded once
            with opened_files(public, private) as opened:
                outcome = watched(lambda: DOORS[door](path), most)
        strange = sorted(opened - {path.name, "people.csv"}) + [str(request) for request in requests]
        assert outcome.fault is None, outcome.fault
        assert not outcome.forbidden + strange, outcome.forbidden + strange
        assert outcome.bytes <= most, f"{outcome.bytes:,} bytes, at most {most:,}"
        assert outcome.seconds <= MOST_SECONDS, f"{outcome.seconds:.1f} s"
        if outcome.refused is not None:
            raise DataError(outcome.refused)
        return outcome

    return Case(call, lambda _: None, may=True, must=False)


def _content(container: str, content: str, claim: int, names: Sequence[str], rng: np.random.Generator) -> bytes:
    """Make the bytes of a picture, of which the head claims a side, and in which there may be something else."""
    text = _mosaic(rng.choice(names), claim).encode()
    written = text if container == "vrt" else _claiming(container, _picture(container, claim), claim)
    if content == "mosaic behind it":
        return written + text
    if content == "head of a mosaic":
        return written[: int(rng.integers(4, 40))] + text
    return changed(written, content, rng)


def _picture(container: str, claim: int) -> bytes:
    """Encode a sound picture; of a TIFF that is sparse, one of its tiles is stored."""
    if container == "eps":
        return b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 48 48\nshowpage\n"
    if container == "svg":
        return b'<svg xmlns="http://www.w3.org/2000/svg" width="48" height="48"><rect width="9" height="9"/></svg>'
    pixels = np.random.default_rng(0).integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
    stream = io.BytesIO()
    if container == "sparse":
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
    elif container == "bigtiff":
        tifffile.imwrite(stream, pixels, photometric="rgb", bigtiff=True)
    else:
        Image.fromarray(pixels).save(stream, _FORMATS.get(container, container.upper()))
    return stream.getvalue()


def _claiming(container: str, content: bytes, side: int) -> bytes:
    """Change the sides in the head of a picture."""
    if side == SIDE:
        return content
    head = bytearray(content)
    wide = min(side, 65_535)
    if container == "png":
        head[16:24] = struct.pack(">II", side, side)
        head[29:33] = struct.pack(">I", zlib.crc32(head[12:29]))
    elif container == "bmp":
        head[18:26] = struct.pack("<ii", side, side)
    elif container == "gif":
        head[6:10] = struct.pack("<HH", wide, wide)
    elif container == "jpg":
        place = head.index(b"\xff\xc0") + 5
        head[place : place + 4] = struct.pack(">HH", wide, wide)
    elif container == "jp2":
        place = head.index(b"ihdr") + 4
        head[place : place + 8] = struct.pack(">II", side, side)
        place = head.index(b"\xff\x51") + 6
        head[place : place + 8] = struct.pack(">II", side, side)
    elif container == "ppm":
        return content.replace(b"48 48", f"{side} {side}".encode(), 1)
    elif container in ("tif", "bigtiff"):
        return _tiff_claiming(content, side)
    return bytes(head)


def _tiff_claiming(content: bytes, side: int) -> bytes:
    """Change the width and the height in the tags of a TIFF."""
    head = bytearray(content)
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        for name in ("ImageWidth", "ImageLength"):
            tag = file.pages.first.tags[name]
            struct.pack_into("<H", head, tag.offset + 2, _LONG)
            struct.pack_into("<I", head, tag.valueoffset, side)
    return bytes(head)


def _mosaic(name: str, side: int) -> str:
    """Write a mosaic with one source, as GDAL has it."""
    rect = f'xOff="0" yOff="0" xSize="{side}" ySize="{side}"'
    source = f'<SimpleSource><SourceFilename relativeToVRT="0">{name}</SourceFilename><SourceBand>1</SourceBand>'
    source += f"<SrcRect {rect}/><DstRect {rect}/></SimpleSource>"
    bands = "".join(f'<VRTRasterBand dataType="Byte" band="{band}">{source}</VRTRasterBand>' for band in (1, 2, 3))
    return f'<VRTDataset rasterXSize="{side}" rasterYSize="{side}">{bands}</VRTDataset>'


@cache
def _agent() -> ActivePerception:
    """Load the agent."""
    return ActivePerception.recommended()


def _open(path: Path) -> None:
    """Open a picture for windows, and look at the whole of it and at a corner."""
    picture = open_large(path)
    width, height = picture.size
    picture.read((0, 0, width, height), picture.reduction(width / 64))
    picture.read((0, 0, min(width, 64), min(height, 64)))


def _check(path: Path) -> None:
    """Check fixations by the picture."""
    people = path.with_name("people.csv")
    people.write_text("picture,subject,x,y,width,height\n" + f"{path.name},a,1,1,{SIDE},{SIDE}\n" * 6)
    _run("check", str(people), "--picture", str(path.parent))


def _run(*words: str) -> None:
    """Run the command; raises `DataError` with its last line where it fails."""
    told = io.StringIO()
    try:
        with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
            main([*words])
    except SystemExit as end:
        text = told.getvalue()
        assert "Traceback" not in text, text[-1000:]
        if end.code:
            raise DataError(text.strip().splitlines()[-1][:500]) from None


DOORS: dict[str, Callable[[Path], object]] = {
    "read": read_image,
    "open": _open,
    "search": lambda path: _agent().search(path, "cup", passes=2),
    "find": lambda path: _agent().find_all(path, "person", passes=2),
    "gaze": lambda path: _agent().gaze(path),
    "check": _check,
    "app": lambda path: app._read(str(path)),  # what reads uploads has no public name
    "command": lambda path: _run("find", str(path), "--target", "person", "--passes", "2"),
}
"""Ways of a picture into semfov."""
