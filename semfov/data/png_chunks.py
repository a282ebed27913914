"""Chunks of a PNG, some of which may say how it is turned, also behind its pixels."""

from collections.abc import Iterator
from typing import IO

_SIGNATURE = 8  # bytes before the first chunk
_HEAD = 8  # bytes of a chunk before its content: its length and its kind
_CHECKSUM = 4  # bytes behind it
_MOST_KEYWORD = 79  # bytes (PNG, 11.3.3)
_TEXTS = b"tEXt", b"zTXt", b"iTXt"
_KEYWORDS = b"Raw profile type exif", b"XML:com.adobe.xmp"
"""Keywords of texts in which Pillow looks for an orientation."""


def has_late_orientation(file: IO[bytes]) -> bool:
    """Tell whether chunks behind the first pixels of a PNG may hold an orientation, without decoding any.

    Args:
        file: the file, whose place is kept.

    Returns:
        Whether some may.
    """
    place = file.tell()
    try:
        return _has_late_orientation(file)
    finally:
        file.seek(place)


def _has_late_orientation(file: IO[bytes]) -> bool:
    """Do what `has_late_orientation` does, and move the place of the file."""
    is_late = False
    for kind in _kinds_of_chunks(file):
        if is_late and _may_orient(kind, file):
            return True
        is_late = is_late or kind == b"IDAT"
    return False


def _kinds_of_chunks(file: IO[bytes]) -> Iterator[bytes]:
    """Go from chunk to chunk up to the last one, and give the kind of each; the place of the file is at its content."""
    start = _SIGNATURE
    while True:
        file.seek(start)
        head = file.read(_HEAD)
        kind = head[4:]
        if len(head) < _HEAD or kind == b"IEND":
            return
        yield kind
        start += _HEAD + int.from_bytes(head[:4], "big") + _CHECKSUM


def _may_orient(kind: bytes, file: IO[bytes]) -> bool:
    """Tell whether a chunk of a kind, at whose content the file is, may hold an orientation."""
    if kind not in _TEXTS:
        return kind == b"eXIf"
    keyword = file.read(_MOST_KEYWORD + 1).partition(b"\0")[0]
    return keyword in _KEYWORDS
