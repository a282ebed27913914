"""Reading of fixations from a file of any format of this folder, which its content tells."""

from __future__ import annotations

import json
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any

from semfov.data.fixations.exports import is_export, read_export
from semfov.data.fixations.eyelink import read_eyelink
from semfov.data.fixations.formats import read_cocosearch, read_osie, read_ruarte
from semfov.data.fixations.record import Fixations
from semfov.data.fixations.table import of_source, read_table
from semfov.errors import DataError, InputError, check
from semfov.io.files import check_regular, read_text


def read_fixations(source: str | PathLike[str] | Any, **options: Any) -> list[Fixations]:
    r"""Read fixations from a file of any format that is known, or from a `pandas.DataFrame`.

    Files `.asc` are those of EyeLink (`read_eyelink`), files `.json` those of COCO-Search18, OSIE, or Ruarte and
    others. Other files are tables, as this library writes them (`read_table`) or as the programs of eye trackers export
    them (`read_export`), which the columns tell.

    Args:
        source: the file or table.
        **options: arguments of the reader, such as `size` (for a file of COCO-Search18 the screen).

    Returns:
        One record for each scanpath.

    Raises:
        InputError: the reader has no such argument.
        DataError: the content is of no known form.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "people.csv")
    ...     _ = path.write_text("picture,subject,x,y,width,height\na.jpg,1,40,30,80,60\n")
    ...     len(read_fixations(path))
    1
    """
    kind = Path(source).suffix.lower() if isinstance(source, str | PathLike) else ""
    if kind == ".asc":
        return read_eyelink(source, **options)
    if kind == ".json":
        name, reader = json_reader(Path(source))
        if "size" in options and reader is not read_osie:
            has = f"none for {source}, a file of {name}, whose frame is that of each trial"
            check(reader is read_cocosearch, "size", has, options["size"])
            options = {"screen": options["size"], **{key: each for key, each in options.items() if key != "size"}}
        try:
            return reader(source, **options)
        except DataError as error:
            raise DataError(f"{error}; it was read as a file of {name}") from None
    _, header, _ = of_source(source)
    ours = {"picture", "subject", "x", "y"} <= {name.lower() for name in header} or "columns" in options
    return read_export(source, **options) if is_export(header) and not ours else read_table(source, **options)


def json_reader(path: Path) -> tuple[str, Callable[..., list[Fixations]]]:
    """The data set that a file of JSON has the form of, and its reader."""
    check_regular(path)
    try:
        content = json.loads(read_text(path))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read as JSON ({error}); correct or replace the file") from None
    if isinstance(content, list):
        return "COCO-Search18", read_cocosearch
    people = isinstance(content, dict) and any(isinstance(each, list) for each in content.values())
    return ("OSIE", read_osie) if people else ("Ruarte and others", read_ruarte)


def frame_of(text: str) -> tuple[int, int]:
    """Width and height of a frame that a command line gives.

    >>> frame_of("1920,1080"), frame_of("800x600")
    ((1920, 1080), (800, 600))
    """
    try:
        width, height = (int(side) for side in text.lower().replace("x", ",").split(","))
    except ValueError:
        raise InputError(f"size: expected a width and a height, as 1920,1080, got {text!r}") from None
    return width, height
