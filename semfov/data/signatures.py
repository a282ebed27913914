"""Kinds of files by their first bytes, so that a file that is no picture here is refused by its name."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from semfov.io.files import reading

_Name = TypeVar("_Name", bound=str)

Marks = Mapping[tuple[int, bytes], _Name]
"""Names by bytes that tell them, with their place in the file; of two that a file has, the first counts."""

_READ = {
    (0, b"\xff\xd8\xff"): "JPEG",
    (0, b"\x89PNG\r\n\x1a\n"): "PNG",
    (0, b"GIF8"): "GIF",
    (0, b"BM"): "BMP",
    (0, b"\0\0\0\x0cjP  "): "JPEG2000",
    (0, b"\xff\x4f\xff\x51"): "JPEG2000",
    (0, b"II*\0"): "TIFF",
    (0, b"MM\0*"): "TIFF",
    (0, b"II+\0"): "TIFF",
    (0, b"MM\0+"): "TIFF",
    (8, b"WEBP"): "WEBP",
    (4, b"ftypavif"): "AVIF",
    (4, b"ftypavis"): "AVIF",
}
"""Formats of photographs that Pillow reads by itself. A TIFF may have any bytes at other places, so its marks lead."""

_OTHERS = {
    (0, b"\xff\x0a"): "JPEG XL",
    (0, b"\0\0\0\x0cJXL "): "JPEG XL",
    (0, b"II\xbc"): "JPEG XR",
    (4, b"ftyphei"): "HEIC (`heif-convert FILE photo.jpg`)",
    (4, b"ftyphev"): "HEIC (`heif-convert FILE photo.jpg`)",
    (4, b"ftypmif1"): "HEIC (`heif-convert FILE photo.jpg`)",
    (4, b"ftypmsf1"): "HEIC (`heif-convert FILE photo.jpg`)",
    (4, b"ftypcrx"): "a raw photograph of a camera (CR3)",
    (4, b"ftyp"): "a video (MP4)",
    (0, b"\x1a\x45\xdf\xa3"): "a video (Matroska)",
    (8, b"AVI "): "a video (AVI)",
    (0, b"FUJIFILM"): "a raw photograph of a camera (RAF)",
    (0, b"8BPS"): "Photoshop's PSD (`magick FILE[0] picture.png`)",
    (0, b"%PDF"): "PDF (`pdftoppm -r 150 -png FILE page`)",
    (0, b"%!PS"): "PostScript (`ps2pdf`, then `pdftoppm`)",
    (0, b"\x76\x2f\x31\x01"): "OpenEXR",
    (0, b"#?RADIANCE"): "Radiance HDR",
    (0, b"#?RGBE"): "Radiance HDR",
    (0, b"P7\n"): "PAM",
    (0, b"PF\n"): "PFM in colour",
    (0, b"qoif"): "QOI",
    (0, b"\0\0\x01\0"): "ICO",
    (0, b"DDS "): "DDS",
    (0, b"SIMPLE  ="): "FITS",
    (0, b"\x89HDF"): "HDF5",
    (128, b"DICM"): "DICOM",
    (0, b"\x93NUMPY"): "an array of NumPy (give numpy.load(file))",
    (0, b"PK\x03\x04"): "a ZIP archive (unpack it)",
    (0, b"<svg"): "SVG (`inkscape -o picture.png FILE`, or a browser)",
    (0, b"<?xml"): "XML, such as SVG (`inkscape -o picture.png FILE`, or a browser)",
    (0, b"<!DOCTYPE"): "a web page (of a failed download)",
    (0, b"<!doctype"): "a web page (of a failed download)",
    (0, b"<html"): "a web page (of a failed download)",
    (0, b"version https://git-lfs"): "a pointer of Git LFS (git lfs pull)",
}
"""Other kinds of files that are taken for photographs."""

_HEAD = 160  # bytes that tell a kind


def name_by_marks(head: bytes, marks: Marks[_Name]) -> _Name | None:
    """Find the name whose mark the first bytes of a file have; None where they have none.

    >>> name_by_marks(b"GIF89a", {(0, b"BM"): "BMP", (0, b"GIF8"): "GIF"})
    'GIF'
    """
    return next((name for (place, mark), name in marks.items() if head.startswith(mark, place)), None)


def kind_of(path: Path) -> tuple[str, bool]:
    """Tell the kind of a file by its first bytes.

    Args:
        path: the file.

    Returns:
        Its name in words, empty where the bytes tell none, and whether it is a photograph that Pillow reads by itself.

    Raises:
        DataError: the file cannot be read.
    """
    with reading(path), path.open("rb") as file:
        head = file.read(_HEAD)
    if not head:
        return "an empty file", False
    name = name_by_marks(head, _READ)
    if name is not None:
        return name, True
    return name_by_marks(head, _OTHERS) or "", False
