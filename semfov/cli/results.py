"""Files of results: JSON, CSV, GeoJSON and COCO, written while pictures are looked at."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from semfov.cli.text import found_place
from semfov.data.classes import canonical_name
from semfov.errors import check
from semfov.io.files import write_text
from semfov.paths import GazeRecord

RESULT_KINDS = (".coco.json", ".json", ".csv", ".geojson")
"""Ends of the names of files of results."""

_SHARE = 0.05  # of the time may be spent on writing results that are not complete yet

_DECISIONS = ("picture", "target", "outcome", "probability", "x", "y", "x1", "y1", "x2", "y2", "passes", "seconds")


def kind_of(path: Path) -> str | None:
    """The kind of a file of results by its name; None for a folder.

    Args:
        path: a file or a folder.

    Returns:
        One of `RESULT_KINDS`.

    Raises:
        InputError: it is another kind of file.

    >>> kind_of(Path("boxes.json")), kind_of(Path("boxes.coco.json")), kind_of(Path("runs/one"))
    ('.json', '.coco.json', None)
    """
    name = path.name.lower()
    kind = next((kind for kind in RESULT_KINDS if name.endswith(kind)), None)
    known = kind is not None or not path.suffix or path.is_dir()
    check(known, "out", f"a folder, or a file that ends in {', '.join(RESULT_KINDS)}", path)
    return kind


class ResultsFile:
    """A file of results that is complete for the pictures so far, whenever the command ends.

    Args:
        path: the file.
        kind: one of `RESULT_KINDS`.
        searched: whether pictures were searched; a table then has a line for each picture and not for each object.
    """

    def __init__(self, path: Path, kind: str, *, searched: bool) -> None:
        self.path, self.kind, self.searched = path, kind, searched
        self._pictures: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []
        self._categories: list[dict[str, Any]] = []
        self._coordinates: set[str] = set()
        self._skipped: list[dict[str, str]] = []
        self._due = 0.0

    def add(self, name: str, record: GazeRecord, seconds: float, file: Path | None = None) -> None:
        """Add the record of a picture.

        Args:
            name: name of the picture.
            record: its record.
            seconds: time that it took.
            file: file of the picture, which may tell its place on earth; None for an embedded scene.
        """
        self._pictures.append({**_summary(name, record, seconds), "objects": record.object_rows()})
        if self.kind == ".geojson":
            collection = record.to_geojson(source=file)
            self._coordinates.add(collection["coordinates"])
            self._annotations += [_of_picture(each, name) for each in collection["features"]]
        elif self.kind == ".coco.json":
            self._categories = self._categories or _categories(record.classes[1:])
            found = record.to_coco(len(self._pictures), self._categories)
            first = len(self._annotations) + 1
            self._annotations += [{"id": number, **_area(each)} for number, each in enumerate(found, first)]
        if time.monotonic() >= self._due:
            self.write()

    def skip(self, name: str, reason: str) -> None:
        """Add a picture that could not be read, and the reason."""
        self._skipped.append({"picture": name, "error": reason})

    def write(self) -> None:
        """Write the file, atomically."""
        began = time.monotonic()
        write_text(self.path, self._text())
        took = time.monotonic() - began
        self._due = began + took / _SHARE

    def _text(self) -> str:
        if self.kind == ".csv":
            return self._csv()
        whole: dict[str, Any] = {"pictures": self._pictures, "skipped": self._skipped}
        if self.kind == ".geojson":
            unit = "; ".join(sorted(self._coordinates))
            whole = {"type": "FeatureCollection", "coordinates": unit, "features": self._annotations}
        elif self.kind == ".coco.json":
            images = [
                {"id": number, "file_name": each["picture"], "width": each["width"], "height": each["height"]}
                for number, each in enumerate(self._pictures, 1)
            ]
            whole = {"images": images, "annotations": self._annotations, "categories": self._categories}
        return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"

    def _csv(self) -> str:
        text = io.StringIO()
        if self.searched:
            rows, names = self._pictures, list(_DECISIONS)
        else:
            rows = [{"picture": each["picture"], **row} for each in self._pictures for row in each["objects"]]
            names = list(rows[0]) if rows else ["picture", "class", "score", "x1", "y1", "x2", "y2"]
        table = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
        return text.getvalue()


def _summary(name: str, record: GazeRecord, seconds: float) -> dict[str, Any]:
    """What a file says about a picture as a whole."""
    width, height = record.size
    found: dict[str, Any] = {"picture": name, "width": width, "height": height, "target": record.target_name}
    if record.decision is not None:
        point, box = found_place(record, record.decision) if record.decision.outcome == "found" else (None, None)
        found |= {"outcome": record.decision.outcome, "probability": record.decision.probability}
        found |= dict(zip("xy", point or (None, None), strict=True))
        found |= dict(zip(("x1", "y1", "x2", "y2"), box or [None] * 4, strict=True))
    said = {"least_score": record.least, "expected": record.expected, "passes": record.passes}
    return {**found, **said, "seconds": round(seconds, 3), "ended": record.why_it_ended()}


def _categories(classes: Sequence[str]) -> list[dict[str, Any]]:
    """Categories of the classes: COCO's own, or numbers from 1 if COCO has not all of them."""
    from semfov.paths.conversion import coco_categories

    categories = coco_categories()
    if {canonical_name(name) for name in classes} <= {canonical_name(each["name"]) for each in categories}:
        return categories
    return [{"id": number, "name": name} for number, name in enumerate(classes, 1)]


def _area(annotation: dict[str, Any]) -> dict[str, Any]:
    """An annotation as data sets have it, with its area."""
    *_, width, height = annotation["bbox"]
    return {**annotation, "area": width * height, "iscrowd": 0}


def _of_picture(feature: dict[str, Any], name: str) -> dict[str, Any]:
    return {**feature, "properties": {"picture": name, **feature["properties"]}}
