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

_RESULT_KINDS = (".coco.json", ".json", ".csv", ".geojson")
"""Ends of the names of files of results."""

_SHARE = 0.05  # of the time may be spent on writing results that are not complete yet

_DECISIONS = ("picture", "target", "outcome", "probability", "x", "y", "x1", "y1", "x2", "y2", "passes", "seconds")


def kind_of(path: Path) -> str | None:
    """The kind of a file of results by its name; None for a folder.

    >>> kind_of(Path("boxes.json")), kind_of(Path("boxes.coco.json")), kind_of(Path("runs/one"))
    ('.json', '.coco.json', None)
    """
    name = path.name.lower()
    kind = next((kind for kind in _RESULT_KINDS if name.endswith(kind)), None)
    fits = kind is not None or not path.suffix or path.is_dir()
    check(fits, "out", f"a folder, or a file that ends in {', '.join(_RESULT_KINDS)}", path)
    return kind


def result_row(
    record: GazeRecord, name: str, seconds: float, kind: str | None, file: Path | None = None
) -> dict[str, Any]:
    """Make the entry of a picture in a file of results."""
    row: dict[str, Any] = {"picture": {**_summary(name, record, seconds), "objects": record.object_rows()}}
    if kind == ".geojson":
        collection = record.to_geojson(source=file)
        row["coordinates"] = collection["coordinates"]
        row["parts"] = [
            {**each, "properties": {"picture": name, **each["properties"]}} for each in collection["features"]
        ]
    elif kind == ".coco.json":
        row["categories"] = _categories(record.classes[1:])
        row["parts"] = [
            {**each, "area": each["bbox"][2] * each["bbox"][3], "iscrowd": 0}
            for each in record.to_coco(0, row["categories"])
        ]
    return row


class ResultsFile:
    """A file of results that is complete for the pictures so far, whenever the command ends."""

    def __init__(self, path: Path, kind: str, *, searched: bool) -> None:
        self.path, self.kind, self.searched = path, kind, searched
        self._rows: dict[int, dict[str, Any]] = {}
        self._skipped: dict[int, dict[str, str]] = {}
        self._due = 0.0

    def add(self, number: int, row: dict[str, Any]) -> None:
        """Add a picture."""
        self._rows[number] = row
        if time.monotonic() >= self._due:
            self.write()

    def skip(self, number: int, name: str, reason: str) -> None:
        """Add a picture that could not be read, and the reason."""
        self._skipped[number] = {"picture": name, "error": reason}

    def write(self) -> None:
        """Write the file, atomically."""
        began = time.monotonic()
        write_text(self.path, self._text())
        took = time.monotonic() - began
        self._due = began + took / _SHARE

    def _text(self) -> str:
        rows = [self._rows[number] for number in sorted(self._rows)]
        pictures = [row["picture"] for row in rows]
        whole: dict[str, Any] = {
            "pictures": pictures, "skipped": [self._skipped[number] for number in sorted(self._skipped)]
        }  # fmt: skip
        if self.kind == ".csv":
            return self._csv(pictures)
        if self.kind == ".geojson":
            unit = "; ".join(sorted({row["coordinates"] for row in rows}))
            features = [each for row in rows for each in row["parts"]]
            whole = {"type": "FeatureCollection", "coordinates": unit, "features": features}
        elif self.kind == ".coco.json":
            images = [
                {"id": number, "file_name": each["picture"], "width": each["width"], "height": each["height"]}
                for number, each in enumerate(pictures, 1)
            ]
            objects = [{**each, "image_id": number} for number, row in enumerate(rows, 1) for each in row["parts"]]
            annotations = [{"id": number, **each} for number, each in enumerate(objects, 1)]
            categories = rows[0]["categories"] if rows else []
            whole = {"images": images, "annotations": annotations, "categories": categories}
        return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"

    def _csv(self, pictures: list[dict[str, Any]]) -> str:
        text = io.StringIO()
        if self.searched:
            rows, names = pictures, list(_DECISIONS)
        else:
            rows = [{"picture": each["picture"], **row} for each in pictures for row in each["objects"]]
            names = list(rows[0]) if rows else ["picture", "class", "score", "x1", "y1", "x2", "y2"]
        table = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
        return text.getvalue()


def _summary(name: str, record: GazeRecord, seconds: float) -> dict[str, Any]:
    """Values of a picture as a whole: its size, the decision with its place, passes and seconds."""
    width, height = record.size
    row: dict[str, Any] = {"picture": name, "width": width, "height": height, "target": record.target_name}
    if record.decision is not None:
        point, box = found_place(record, record.decision) if record.decision.outcome == "found" else (None, None)
        row |= {"outcome": record.decision.outcome, "probability": record.decision.probability}
        row |= dict(zip("xy", point or (None, None), strict=True))
        row |= dict(zip(("x1", "y1", "x2", "y2"), box or [None] * 4, strict=True))
    figures = {"least": record.least, "expected": record.expected, "passes": record.passes}
    return {**row, **figures, "seconds": round(seconds, 3), "ended": record.why_it_ended()}


def _categories(classes: Sequence[str]) -> list[dict[str, Any]]:
    """Categories of the classes: COCO's own, or numbers from 1 if COCO has not all of them."""
    from semfov.paths.conversion import coco_categories

    categories = coco_categories()
    if {canonical_name(name) for name in classes} <= {canonical_name(each["name"]) for each in categories}:
        return categories
    return [{"id": number, "name": name} for number, name in enumerate(classes, 1)]
