"""The page of one record, as its method `report` writes it."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from torch import Tensor

from semfov.data.inputs import ImageLike, as_image
from semfov.data.large import LargePicture
from semfov.paths import Record, Scanpath
from semfov.report.episode import episode_data
from semfov.report.page import write_page
from semfov.report.zoom import zoom_data
from semfov.viz.drawing import photograph_of


def write_record(
    record: Record,
    path: str | PathLike[str],
    *,
    picture: LargePicture | ImageLike | None = None,
    name: str | None = None,
) -> Path:
    """Write the page of a record with its windows, objects and looks.

    Args:
        record: the record.
        path: the HTML file.
        picture: the picture in full size, in which narrow windows are sharp; None takes the one that the record kept.
        name: name of the picture on the page; None takes that of its file, or its size.

    Returns:
        The path.

    Raises:
        InputError: the picture was neither kept nor given, or has other proportions.
        DataError: the file cannot be written.
    """
    data = zoom_data(record, picture, name=_name(record, name))
    return write_page(Path(path), f"semfov: {record.describe()}", [data])


def write_scanpath(
    scanpath: Scanpath,
    path: str | PathLike[str],
    *,
    picture: ImageLike | None = None,
    name: str | None = None,
    boxes: Tensor | None = None,
) -> Path:
    """Write the page on which a reader steps through a scanpath.

    Args:
        scanpath: the scanpath.
        path: the HTML file.
        picture: the photograph; None takes the one that the scanpath kept.
        name: name of the photograph on the page; None takes that of its file, or its size.
        boxes: `(M, 4)`, true boxes of the target.

    Returns:
        The path.

    Raises:
        InputError: the photograph was neither kept nor given.
        DataError: the file cannot be written.
    """
    image = photograph_of(scanpath, None if picture is None else as_image(picture))
    views = None if scanpath.stimulus is None else scanpath.views()
    data = episode_data(scanpath, image, views, name=_name(scanpath, name), boxes=boxes)
    return write_page(Path(path), f"semfov: {scanpath.describe()}", [data])


def _name(record: Record, name: str | None) -> str:
    """Name of the picture of a record."""
    width, height = record.size
    return name or (Path(record.source).name if record.source else f"{width} × {height} px")
