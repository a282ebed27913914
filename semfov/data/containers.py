"""Containers of video files, recognised by their first bytes, and checks of the length that they state."""

import re
from pathlib import Path
from typing import Literal

from semfov.data.signatures import Marks, name_by_marks
from semfov.io.files import reading

Container = Literal["animation", "avi", "matroska", "mp4", "text", "other"]

_MARKS: Marks[Container] = {
    (0, b"GIF8"): "animation",
    (8, b"WEBP"): "animation",
    (8, b"AVI "): "avi",
    (0, b"\x1a\x45\xdf\xa3"): "matroska",
    (4, b"ftyp"): "mp4",
}
"""Containers by their marks. WebM is Matroska."""

_LIST = re.compile(rb"(\xef\xbb\xbf)?(#EXTM3U|ffconcat|<|v=0)")
"""The first bytes of a list of films, whatever follows."""

_TEXT = re.compile(rb"(?!YUV4MPEG2 |nut/multimedia )(\xef\xbb\xbf)?[\t\n\r -~]+")
"""The first bytes of a text. FFmpeg would open the files and addresses that one names: a playlist, `ffconcat`, SDP."""

_HEAD = 16  # bytes of a file, or of a box of MP4, that tell what it is
_LEAST_FRAME = 8  # bytes of the smallest frame of an AVI file, those of its head
_MOST_BOXES = 100_000  # outer boxes of an MP4 file that are followed


def container_of(path: Path) -> Container:
    """Tell the container of a video by its first bytes; raises `DataError` for a file that cannot be read."""
    with reading(path, f"source: {path}"), path.open("rb") as file:
        head = file.read(_HEAD)
    if _LIST.match(head):
        return "text"
    container = name_by_marks(head, _MARKS)
    if container is not None:
        return container
    return "text" if _TEXT.fullmatch(head) else "other"


def frames_stated(path: Path, container: Container, count: float) -> int:
    """Tell how many frames a file should give, by the count that it states.

    An AVI file states a count that its bytes can hold. That of an MP4 file counts frames that are not to be shown, too,
    so that it tells what is missing only where the file was cut. In others, the count is estimated from a duration.

    Args:
        path: the file.
        container: its container.
        count: number of frames that it states.

    Returns:
        The number; 0 where the count does not tell it.
    """
    if container == "avi":
        is_true = count * _LEAST_FRAME <= path.stat().st_size
    else:
        is_true = container == "mp4" and _is_cut(path)
    return int(count) if is_true else 0


def _is_cut(path: Path) -> bool:
    """Tell whether the outer boxes of an MP4 file reach beyond its end."""
    end = path.stat().st_size
    start = 0  # of a box
    with path.open("rb") as file:
        for _ in range(_MOST_BOXES):
            file.seek(start)
            head = file.read(_HEAD)
            size = int.from_bytes(head[:4], "big")
            if size == 1:  # it is in the next eight bytes
                size = int.from_bytes(head[8:16], "big")
            if size < 8:  # 0 goes to the end of the file
                return False
            start += size
            if start >= end:
                return start > end
    return False
