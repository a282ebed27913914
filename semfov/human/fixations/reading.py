"""Reading of fixations from a file in any known format, which is recognised by its content."""

import re
from collections.abc import Callable, Iterable, Mapping
from inspect import signature
from os import PathLike
from pathlib import Path
from typing import Any

from semfov.data.fixations.record import Fixations
from semfov.errors import DataError, InputError, check, check_options
from semfov.human.fixations.columns import DataFrame
from semfov.human.fixations.encodings import WINDOWS
from semfov.human.fixations.exports import table_reader
from semfov.human.fixations.eyelink import read_eyelink
from semfov.human.fixations.formats import OSIE_FRAME, read_cocosearch, read_osie, read_ruarte
from semfov.io.files import read_text

_Reader = Callable[..., list[Fixations]]
DATA_SETS: dict[_Reader, str] = {
    read_cocosearch: "COCO-Search18",
    read_osie: "OSIE",
    read_ruarte: "Ruarte and others",
}
"""Readers of JSON, with the data set whose form they read."""
_BEGINNING = re.compile(r'\s*(?:(\[)|\{\s*"(?:[^"\\]|\\.)*"\s*:\s*(\[)|\{)')
"""How a file of JSON begins: with a list, with an object whose first value is a list, or with another object."""


def read_fixations(source: str | PathLike[str] | DataFrame, **options: Any) -> list[Fixations]:
    r"""Read fixations from a file in any known format, or from a `pandas.DataFrame`.

    Files `.asc`, and texts that begin like them, are EyeLink's (`read_eyelink`); files `.json` are those of
    COCO-Search18, OSIE, or Ruarte and others. All other files are tables, in the format of this library (`read_table`)
    or of an eye tracker's program (`read_export`). The names of the columns decide which, unless `columns` names the
    columns of the points.

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
    return read_by(reader_of(source, options.get("columns")), source, options)


def read_by(reader: _Reader, source: str | PathLike[str] | DataFrame, options: Mapping[str, object]) -> list[Fixations]:
    """Read a source with a reader; raises an error if the reader lacks one of the options.

    Args:
        reader: chosen by `reader_of`.
        source: the file, or a `pandas.DataFrame`.
        options: arguments of the reader; `size` is also the screen of a file of COCO-Search18.

    Returns:
        One record for each scanpath.

    Raises:
        InputError: the reader has no such argument.
        DataError: the content is not of its form.
    """
    if "size" in options:
        options = _with_frame(reader, source, options)
    name = source if isinstance(source, str | PathLike) else "it"
    check_options(options, [*signature(reader).parameters][1:], f"{reader.__name__}, which reads {name}")
    try:
        return reader(source, **options)
    except DataError as error:
        if reader not in DATA_SETS:
            raise
        raise DataError(f"{error}; it was read as a file of {DATA_SETS[reader]}") from None


def _with_frame(
    reader: _Reader, source: str | PathLike[str] | DataFrame, options: Mapping[str, object]
) -> Mapping[str, object]:
    """Name the size of the frame as the reader does; raises `InputError` where a data set has one in each trial."""
    # A file of OSIE has the size of its pictures.
    if reader not in (read_cocosearch, read_ruarte):
        return options
    expected = f"none for {source}, a file of {DATA_SETS[reader]}, whose frame is that of each trial"
    check(reader is read_cocosearch, "size", expected, options["size"])
    options_without_size = {name: value for name, value in options.items() if name != "size"}
    return {"screen": options["size"], **options_without_size}


def reader_of(source: str | PathLike[str] | DataFrame, columns: Mapping[str, str] | None = None) -> _Reader:
    """Choose the reader of a source by its ending and content.

    Args:
        source: the file, or a `pandas.DataFrame`.
        columns: as for `read_table`.

    Returns:
        The reader.

    Raises:
        DataError: a file `.json` is none, or a table is not read.
    """
    if not isinstance(source, str | PathLike):
        return table_reader(source, columns)
    kind = Path(source).suffix.lower()
    if kind == ".json":
        return _json_reader(source)
    # edf2asc writes .asc; some people rename it.
    is_eyelink = kind == ".asc" or (kind == ".txt" and _is_eyelink(source))
    return read_eyelink if is_eyelink else table_reader(source, columns)


def _json_reader(source: str | PathLike[str]) -> _Reader:
    """Choose the reader of a file of JSON by its beginning; raises `DataError` for other text."""
    beginning = _BEGINNING.match(read_text(source))
    if beginning is None:
        raise DataError(f"{source}: expected JSON, a list or an object, got other text; correct or replace the file")
    list_of_trials, list_of_people = beginning.groups()
    if list_of_trials:
        return read_cocosearch
    return read_osie if list_of_people else read_ruarte


def _is_eyelink(source: str | PathLike[str]) -> bool:
    """Tell whether a text is one of EyeLink by its beginning."""
    return read_text(source, WINDOWS).lstrip().startswith(("** CONVERTED FROM", "MSG\t"))


def check_usual_frame(path: str | PathLike[str], argument: str, sizes: Iterable[tuple[int, int]], how: str) -> None:
    """Refuse a file in OSIE's format if its pictures differ in size from OSIE's and no frame is given.

    Such a file does not tell its frame. In OSIE's, points of smaller pictures with the same proportions would lie too
    far left and up, and nothing would show it.

    Args:
        path: the file, read without a frame.
        argument: name of the argument, for the message.
        sizes: `(width, height)` of the pictures of the file.
        how: how a frame is given, with `{width}` and `{height}` in it.

    Raises:
        InputError: with how to give the frame.
    """
    size = next((size for size in sizes if tuple(size) != OSIE_FRAME), None)
    if size is None or reader_of(path) is not read_osie:
        return
    of_pictures, of_osie = (how.format(width=width, height=height) for width, height in (size, OSIE_FRAME))
    got = f"pictures of {size[0]} × {size[1]}"
    raise InputError(
        f"{argument}: expected the frame of {path}, which has none, got {got}: {of_pictures} if the fixations are in "
        f"their pixels, {of_osie} if in those of OSIE"
    )


def frame_of(text: str, name: str = "size") -> tuple[int, int]:
    """Parse the width and the height of a frame in the option `name`, such as `1920,1080` or `800x600`."""
    try:
        width, height = (int(side) for side in text.lower().replace("x", ",").split(","))
    except ValueError:
        raise InputError(f"{name}: expected a width and a height, as 1920,1080, got {text!r}") from None
    return width, height
