"""Reading of text files in Unicode, or in the encoding of older Windows programs."""

import re
import warnings
from os import PathLike

from semfov.data.fixations.record import Fixations
from semfov.errors import check_data
from semfov.io.files import read_encoded

WINDOWS = "cp1252"
"""Encoding of texts that are not in Unicode, as older programs of Windows write them in Western Europe."""

_NO_TEXT = re.compile(r"[\x00-\x08\x0e-\x19\x1b-\x1f\ufffd]")  # signs that no text has; 1a ends those of DOS


def read_recording(path: str | PathLike[str]) -> tuple[str, str]:
    """Read a text in Unicode (UTF-8, UTF-16 or UTF-32), or else in Windows' encoding for Western Europe.

    Args:
        path: the file.

    Returns:
        The text and its encoding.

    Raises:
        DataError: it cannot be read, or is no text.
    """
    text, encoding = read_encoded(path, WINDOWS)
    is_text = encoding != WINDOWS or _NO_TEXT.search(text) is None
    check_data(is_text, path, "a file of text", "other bytes; save it as UTF-8")
    return text, encoding


def file_name(path: str) -> str:
    """Return the file name in a path of Windows or Unix, which may be in quotes as in trackers' messages."""
    return path.strip('"').replace("\\", "/").rpartition("/")[2]


def warn_of_letters(source: str | PathLike[str], encoding: str, fixations: list[Fixations]) -> list[Fixations]:
    """Warn of names with letters that may be wrong because the file's encoding is only assumed.

    Args:
        source: the file, for the message.
        encoding: in which it was read.
        fixations: the records.

    Returns:
        The records.
    """
    if encoding != WINDOWS:
        return fixations
    names: list[str] = []
    for record in fixations:
        names += [record.picture, record.subject, record.target or ""]
    # Letters of ASCII are the same in all encodings that are read.
    uncertain = [name for name in names if not name.isascii()]
    if uncertain:
        warnings.warn(
            f"{source}: is not UTF-8, so names are read as Western European ones of Windows ({WINDOWS}), such as "
            f"{uncertain[0]!r}; if that is wrong, save the file as UTF-8",
            stacklevel=3,
        )
    return fixations
