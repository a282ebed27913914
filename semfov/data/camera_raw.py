"""Raw files of cameras: TIFFs in which decoders find a thumbnail at most, as the picture itself is raw values."""

from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import BinaryIO

from semfov.data.tiff_tags import PHOTOMETRIC, SUB_PAGES, TiffTags
from semfov.errors import check_data

_RAW = (32803, 34892)  # photometric: values behind a mosaic of colours, and these with the mosaic filled in
_HEADS = (b"II*\0", b"MM\0*")
_MOST_PAGES = 8  # below the first one that are looked at; cameras write two or three


def check_no_raw(path: str | PathLike[str]) -> None:
    """Raise `DataError` for a raw file of a camera, because only its thumbnail would be read.

    Args:
        path: the file, of any kind.
    """
    photometrics: list[int] = []
    if not Path(path).is_file():
        return  # a pipe would be waited for; it is refused where it is read
    # What is no TIFF, or is damaged, is refused where it is decoded.
    with suppress(Exception), Path(path).open("rb") as file:
        photometrics = _photometrics_of(file)
    is_raw = not set(photometrics).isdisjoint(_RAW)
    got = (
        "the raw values of a camera (such as DNG or NEF); convert it to JPEG or TIFF by the camera's program or a raw "
        "converter"
    )
    check_data(not is_raw, f"image {Path(path)}", "a picture", got)


def _photometrics_of(file: BinaryIO) -> list[int]:
    """List what the numbers of the first page of a TIFF, and of the pages below it, stand for; none of other files."""
    head = file.read(8)
    if not head.startswith(_HEADS):
        return []
    # Imported for a TIFF alone, as it takes a twentieth of the time to the first answer.
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    first = ImageFileDirectory_v2(head)
    file.seek(first.next)
    first.load(file)
    photometrics = [TiffTags(first).photometric] if PHOTOMETRIC in first else []
    places = first.get(SUB_PAGES, ())
    for place in [places] if isinstance(places, int) else places[:_MOST_PAGES]:
        below = ImageFileDirectory_v2(head)
        file.seek(place)
        below.load(file)
        photometrics.append(TiffTags(below).photometric)
    return photometrics
