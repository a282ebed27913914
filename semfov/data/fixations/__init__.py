"""Fixations of people and of models: one record, and readers and writers for the file formats of the field.

Points are `(x, y)` in pixels, pixel centres at integers, as everywhere in semfov. Files give them in pixels of a
screen, in pixels of a picture, or in cells. `Letterbox` and `Fixations.resized` convert between these.
"""

from semfov.data.fixations.exports import read_export
from semfov.data.fixations.eyelink import read_eyelink
from semfov.data.fixations.formats import (
    coco_name,
    read_cocosearch,
    read_osie,
    read_ruarte,
    write_cocosearch,
    write_osie,
    write_ruarte,
)
from semfov.data.fixations.pysaliency import from_pysaliency, to_pysaliency
from semfov.data.fixations.reading import read_fixations
from semfov.data.fixations.record import Fixations, Letterbox, by_picture
from semfov.data.fixations.suspicions import suspicions
from semfov.data.fixations.table import read_table, write_table

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
