"""Readers and writers of the common file formats of fixations, and checks for suspicious fixations."""

from semfov.human.fixations.exports import read_export
from semfov.human.fixations.eyelink import read_eyelink
from semfov.human.fixations.formats import (
    coco_name,
    read_cocosearch,
    read_osie,
    read_ruarte,
    write_cocosearch,
    write_osie,
    write_ruarte,
)
from semfov.human.fixations.pysaliency import from_pysaliency, to_pysaliency
from semfov.human.fixations.reading import read_fixations
from semfov.human.fixations.suspicions import suspicions
from semfov.human.fixations.table import read_table, write_table

__all__ = [
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
