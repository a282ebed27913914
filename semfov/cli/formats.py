"""Formats of result files: what a picture adds to a file, and how the file is written.

A format is one class, which is registered under its suffix by being defined. The command, its help and its checks know
it from then on. Formats are text: a binary one also needs `semfov.cli.results`. This file imports no tensors, as the
help needs it.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from semfov.io.tables import csv_text, pixels

if TYPE_CHECKING:
    from semfov.cli.truth import Truth
    from semfov.paths import Record

Values = dict[str, Any]
"""JSON values by name."""

Row = Mapping[str, Any]
"""What a file has of a picture, as JSON values: under `picture` its outcome and its objects, or its name and the
`error` for which it was skipped, and beside it what its format adds."""

FORMATS: dict[str, type[ResultsFormat]] = {}
"""The formats by the ends of the names of their files."""


class ResultsFormat(ABC):
    """Format of a file of results.

    Attributes:
        suffix: end of the names of its files.
        note: what the help says of it beside the suffix.
        grows: whether a picture is added at the end of the file; other files are written anew.

    Args:
        searched: whether the pictures are searched for a class, so that each has a decision.
    """

    suffix: ClassVar[str]
    note: ClassVar[str] = ""
    grows: ClassVar[bool] = False

    def __init__(self, *, searched: bool = False) -> None:
        self.searched = searched

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "suffix" in vars(cls):
            FORMATS[cls.suffix] = cls

    def check_files(self, files: Sequence[Path | None]) -> None:  # noqa: B027 (most formats hold any pictures)
        """Raise `InputError` where one file cannot hold the results of all these pictures."""

    def added(self, record: Record, name: str, file: Path | None) -> Values:
        """Make the values in a picture's row of this format, besides `picture`.

        Args:
            record: the record of the picture.
            name: name of the picture.
            file: file of the picture; None if it does not come from a file.

        Returns:
            JSON values by name.
        """
        return {}

    @abstractmethod
    def text(self, rows: Sequence[Row]) -> str:
        """Write the file of the pictures so far, in their order, or the part of these pictures if it `grows`."""

    def judgement(self, rows: Sequence[Row]) -> str | None:
        """Judge the objects of all pictures against annotations, in words; None without annotations."""
        return None


class Json(ResultsFormat):
    """Format of one JSON object with all pictures."""

    suffix = ".json"

    def text(self, rows: Sequence[Row]) -> str:
        """Write pictures and skipped pictures."""
        return _json({"pictures": [row["picture"] for row in _looked_at(rows)], "skipped": _skipped(rows)})


class JsonLines(ResultsFormat):
    """Format of a JSON object a line for each picture.

    Args:
        searched: whether the pictures are searched for a class.
        ascii_only: whether to escape other letters, for a stream that may have another encoding.
    """

    suffix = ".jsonl"
    grows = True

    def __init__(self, *, searched: bool = False, ascii_only: bool = False) -> None:
        super().__init__(searched=searched)
        self.ascii_only = ascii_only

    def text(self, rows: Sequence[Row]) -> str:
        """Write a line for each picture."""
        return "".join(json.dumps(row["picture"], ensure_ascii=self.ascii_only) + "\n" for row in rows)


class Csv(ResultsFormat):
    """Format of a table: of a search with a line for each picture, else with one for each object."""

    suffix = ".csv"

    def text(self, rows: Sequence[Row]) -> str:
        """Write the table with its header."""
        from semfov.paths.conversion import COLUMNS, DECISION_COLUMNS

        pictures: list[Values] = [row["picture"] for row in rows]
        if self.searched:
            return _table(["picture", *DECISION_COLUMNS, "seconds", "error"], pictures)
        columns = dict.fromkeys(["picture", "width", "height", *COLUMNS, *_EXPECTED, "error"])
        lines: list[Values] = []
        for picture in pictures:
            lines += _object_lines(picture)
        # Objects of a head have directions, too, which come last.
        for line in lines:
            columns |= dict.fromkeys(line)
        return _table(list(columns), lines)


_EXPECTED = ("expected", "expected_error", "expected_guessed")
"""What is known of the number in the whole picture, which stands in the lines of each class."""


def _object_lines(picture: Values) -> list[Values]:
    """Make a line for each object, and one without an object for each class that has none, or for an empty picture."""
    if "error" in picture:
        return [picture]
    objects: list[Values] = picture["objects"]
    present = {line["class"] for line in objects}
    absent = [{"class": name} for name in picture["targets"] if name not in present]
    # A picture in which nothing was found, when nothing in particular was looked for, has a line, too.
    lines = [*objects, *absent] or [{"class": None}]
    return [_with_picture(line, picture) for line in lines]


def _with_picture(line: Values, picture: Values) -> Values:
    """Put what is known of the picture before the line of an object, and of the class after it."""
    of_picture = {name: picture[name] for name in ("picture", "width", "height")}
    of_class = {name: picture[name].get(line["class"]) for name in _EXPECTED}
    return {**of_picture, **line, **of_class}


class GeoJson(ResultsFormat):
    """Format of GeoJSON: a polygon for each object, on earth or in pixels."""

    suffix = ".geojson"

    def check_files(self, files: Sequence[Path | None]) -> None:
        """Raise `InputError` where only some pictures have a place on earth, as one collection has one unit."""
        from semfov.errors import check
        from semfov.paths.georeference import georeference

        examples: dict[bool, Path | None] = {}
        for file in files:
            with suppress(Exception):  # it is skipped when it is opened
                on_earth = file is not None and georeference(str(file)) is not None
                examples.setdefault(on_earth, file)
        check(
            len(examples) < 2,
            "out",
            "pictures that all have a georeference, or none, for .geojson",
            f"{examples.get(True)} with one and {examples.get(False)} without; look at them apart, or write .json",
        )

    def added(self, record: Record, name: str, file: Path | None) -> Values:
        """Make the features of a picture, with its name, and the unit of their coordinates."""
        collection = record.to_geojson(source=file)
        features = [
            {**feature, "properties": {"picture": name, **feature["properties"]}} for feature in collection["features"]
        ]
        return {"coordinates": collection["coordinates"], "parts": features}

    def text(self, rows: Sequence[Row]) -> str:
        """Write the collection of all features."""
        looked_at = _looked_at(rows)
        return _json(
            {
                "type": "FeatureCollection",
                "coordinates": looked_at[0]["coordinates"] if looked_at else "",
                "features": _parts(looked_at),
                "skipped": _skipped(rows),
            }
        )


class Coco(ResultsFormat):
    """Format of a data set of COCO, with scores."""

    suffix = ".coco.json"
    note = "--annotations FILE: with its ids, and AP"

    def added(self, record: Record, name: str, file: Path | None) -> Values:
        """Make the annotations of a picture without ids, and the categories: COCO's own, or those of the detector."""
        from semfov.data.classes import canonical_name
        from semfov.paths.conversion import coco_categories

        names = record.classes[1:]
        categories = coco_categories()
        names_in_coco = {canonical_name(category["name"]) for category in categories}
        if not {canonical_name(name) for name in names} <= names_in_coco:
            categories = [{"id": number, "name": name} for number, name in enumerate(names, 1)]
        annotations = []
        for result, confirmed in zip(record.to_coco(0, categories), record.confirmed.tolist(), strict=True):
            _, _, width, height = result["bbox"]
            # One that a closer look confirmed is listed whatever its score.
            annotations.append({**result, "area": pixels(width * height), "iscrowd": 0, "confirmed": confirmed})
        return {"categories": categories, "parts": annotations}

    def text(self, rows: Sequence[Row]) -> str:
        """Write images, annotations and categories; pictures and annotations are numbered from 1."""
        # Rows have no ids, since pictures come in any order, and those before them may be skipped.
        looked_at = _looked_at(rows)
        images = []
        annotations: list[Values] = []
        for image_id, row in enumerate(looked_at, 1):
            picture = row["picture"]
            images.append(
                {
                    "id": image_id,
                    "file_name": picture["picture"],
                    "width": picture["width"],
                    "height": picture["height"],
                }
            )
            for part in row["parts"]:
                annotations.append({"id": len(annotations) + 1, **part, "image_id": image_id})
        return _json(
            {
                "images": images,
                "annotations": annotations,
                "categories": looked_at[0]["categories"] if looked_at else [],
                "skipped": _skipped(rows),
            }
        )


class CocoResults(ResultsFormat):
    """Format of a list of COCO results with the ids of an annotation file, by which they are judged.

    It stands in place of `Coco` where annotations are given. Boxes are in the frame of the annotations (`Truth`).
    """

    def __init__(self, truth: Truth) -> None:
        super().__init__()
        self.truth = truth

    def added(self, record: Record, name: str, file: Path | None) -> Values:
        """Make the results of a picture; objects of classes that the annotations lack cannot be judged."""
        from semfov.data.classes import canonical_name
        from semfov.data.images import stored_boxes
        from semfov.detection.exchange import coco_results

        image_id = self.truth.image_id(name)
        sought = [record.classes[label] for label in record.sought] or record.classes[1:]
        categories = self.truth.categories(sought)
        names = [canonical_name(name) for name in record.classes]
        ids = {label: categories[class_name] for label, class_name in enumerate(names) if class_name in categories}
        objects = record.objects.of([*ids])
        boxes = stored_boxes(objects.boxes, record.size, self.truth.orientation(image_id, name, record.size, file))
        results = coco_results(image_id, boxes, objects.labels, objects.scores, ids)
        return {"image_id": image_id, "classes": list(categories), "parts": results}

    def text(self, rows: Sequence[Row]) -> str:
        """Write the list of all results."""
        return json.dumps(_parts(_looked_at(rows)), indent=1) + "\n"

    def judgement(self, rows: Sequence[Row]) -> str:
        """Compute AP and AP50 of the objects against the annotations."""
        looked_at = _looked_at(rows)
        classes = {name for row in looked_at for name in row["classes"]}
        return self.truth.judge(_parts(looked_at), [row["image_id"] for row in looked_at], classes)


def suffix_of(name: str) -> str | None:
    """Find the format of a file by its name.

    Args:
        name: name of the file.

    Returns:
        Suffix of the format; None if there is none.
    """
    return next((suffix for suffix in suffixes() if name.lower().endswith(suffix)), None)


def suffixes() -> list[str]:
    """List the suffixes of all formats, those that end in another one before it."""
    return sorted(FORMATS, key=lambda suffix: -suffix.count("."))


def suffixes_in_words() -> str:
    """List the suffixes of all formats for the help, with what is to say of them."""
    notes = [f"{suffix} ({described.note})" if described.note else suffix for suffix, described in FORMATS.items()]
    return ", ".join(notes)


def _looked_at(rows: Iterable[Row]) -> list[Row]:
    """Select the rows of pictures that were looked at."""
    return [row for row in rows if "error" not in row["picture"]]


def _skipped(rows: Iterable[Row]) -> list[Values]:
    """Select the names and errors of the pictures that were skipped."""
    return [row["picture"] for row in rows if "error" in row["picture"]]


def _parts(rows: Iterable[Row]) -> list[Values]:
    """Join what the pictures add to the list of the file, such as features."""
    parts: list[Values] = []
    for row in rows:
        parts += row["parts"]
    return parts


def _json(values: Values) -> str:
    """Write JSON values, indented."""
    return json.dumps(values, indent=1, ensure_ascii=False) + "\n"


def _table(columns: Sequence[str], lines: Iterable[Values]) -> str:
    """Write lines as CSV with these columns; what a line has not stays empty."""
    rows = [[line.get(name) for name in columns] for line in lines]
    return csv_text([columns, *rows])
