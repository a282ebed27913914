"""Fixations of people and of models: one record, and readers and writers for the file formats of the field.

Points are `(x, y)` in pixels, pixel centres at integers, as everywhere in semfov. Files give them in pixels of a
screen, in pixels of a picture, or in cells. `Letterbox` and `Fixations.resized` convert between these.
"""

from typing import TYPE_CHECKING

from semfov.data.fixations.record import Fixations, Letterbox, by_picture

if TYPE_CHECKING:
    from semfov.human.fixations import (
        coco_name,
        from_pysaliency,
        read_cocosearch,
        read_export,
        read_eyelink,
        read_fixations,
        read_osie,
        read_ruarte,
        read_table,
        suspicions,
        to_pysaliency,
        write_cocosearch,
        write_osie,
        write_ruarte,
        write_table,
    )

__all__ = [
    "Fixations",
    "Letterbox",
    "by_picture",
    "coco_name",
    "from_pysaliency",
    "read_cocosearch",
    "read_export",
    "read_eyelink",
    "read_fixations",
    "read_osie",
    "read_ruarte",
    "read_table",
    "suspicions",
    "to_pysaliency",
    "write_cocosearch",
    "write_osie",
    "write_ruarte",
    "write_table",
]


def __getattr__(name: str) -> object:
    """Import a reader or a writer of files when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import semfov.human.fixations

    return getattr(semfov.human.fixations, name)
