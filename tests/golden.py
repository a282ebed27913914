"""Texts that people read, kept as files in `tests/golden`.

A test compares what is printed with its file. `pytest --accept` writes what is printed now, so that a new wording is
one command, and a reviewer reads it in the difference.
"""

import re
from collections.abc import Mapping
from pathlib import Path

FOLDER = Path(__file__).parent / "golden"

# Numbers that differ in the last digit from machine to machine; other tests compute them.
_VARYING = {
    r"\d+,\d+–\d+,\d+": "BOX",
    r"\(\d+, \d+\)": "(X, Y)",
    r"\b\d+\.\d+\b": "N",
    r"(?<=\S) {2,}": "  ",  # columns are as wide as their numbers
    r" +$": "",
}


def written(printed: str, names: Mapping[Path, str]) -> str:
    """Write what is printed without what differs from run to run.

    Args:
        printed: the text.
        names: what stands for paths, the longest of which go first.

    Returns:
        The text with words for paths, boxes, points, and numbers with decimals.
    """
    for path in sorted(names, key=lambda path: -len(str(path))):
        printed = printed.replace(str(path), names[path])
    printed = printed.replace("\\", "/")  # of names within a folder on Windows
    for pattern, word in _VARYING.items():
        printed = re.sub(pattern, word, printed, flags=re.MULTILINE)
    return printed


def check_golden(name: str, text: str, *, accept: bool) -> None:
    """Compare a text with its file, or write the file.

    Args:
        name: name of the file, without `.txt`.
        text: the text.
        accept: whether the text is taken for the right one from now on.
    """
    path = FOLDER / f"{name}.txt"
    if accept:
        FOLDER.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
    assert path.is_file(), f"{path.name} is not there; pytest --accept writes it"
    assert text == path.read_text(encoding="utf-8"), "another text is printed; pytest --accept takes it"
