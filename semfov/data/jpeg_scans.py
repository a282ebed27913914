"""Check for JPEG files with too many scans, each of which costs a pass over all pixels."""

import re
from typing import IO

MOST_SCANS = 100
"""Largest number of scans of a JPEG that is decoded, as in libtiff; programs write at most a few dozen."""

# Markers begin with 0xFF (ITU-T T.81, B.1.1). In coded data 0xFF is followed by 0 or by the number of a restart.
_MARKER = re.compile(rb"\xff([^\x00\xff\xd0-\xd7])")
_ALONE = b"\x01", b"\xd8"  # TEM and SOI, which have no length
_SCAN = b"\xda"
_END = b"\xd9"


def has_many_scans(file: IO[bytes]) -> bool:
    """Tell whether the first picture in a JPEG file has more than `MOST_SCANS` scans.

    Args:
        file: the file, whose place is moved.

    Returns:
        Whether it has.
    """
    file.seek(0)
    content = file.read()
    if content.count(b"\xff" + _SCAN) <= MOST_SCANS:  # which nearly every file tells at once
        return False
    scans = 0
    place = 0
    while scans <= MOST_SCANS:
        marker = _MARKER.search(content, place)
        if marker is None or marker[1] == _END:
            return False
        scans += marker[1] == _SCAN
        place = marker.end()
        if marker[1] not in _ALONE:
            # What a segment holds, such as a thumbnail with scans of its own, is no part of the picture.
            place += int.from_bytes(content[place : place + 2], "big")
    return True
