"""Conversion of a record to tables, and of its objects to the formats of other libraries and of maps."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from os import PathLike, fspath
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from semfov.data.classes import canonical_name
from semfov.data.inputs import ImageLike
from semfov.data.large import open_large
from semfov.data.windowed import LargePicture
from semfov.detection.exchange import category_ids, coco_results, named_detections
from semfov.errors import InputError, check, needing
from semfov.io.files import write_text
from semfov.io.tables import csv_text, digits, pixels
from semfov.paths.georeference import box_on_earth, georeference
from semfov.paths.look import confident_detections
from semfov.paths.outcome import Outcome
from semfov.words import RECORD, OtherWords

if TYPE_CHECKING:
    import pandas
    import supervision

_Table = Literal["looks", "objects"]  # tables of a record

_PLACE = ("x", "y", "x1", "y1", "x2", "y2")
COLUMNS = ("object", "class", "score", "confirmed", *_PLACE, "look")
"""Columns of the table of objects."""


class Conversion(Outcome, OtherWords):
    """Conversion of looks and objects to tables, and of objects to the formats of other libraries and of maps."""

    _columns: ClassVar[tuple[str, ...]] = COLUMNS
    """Columns of the table of objects."""

    _other_words = RECORD

    def rows(self) -> list[dict[str, Any]]:
        """The looks as a table of plain values, one row for each look, whose first columns all kinds of records have.

        `look` is the number of the look, `x` and `y` are the fixated point, and `x1`, `y1`, `x2` and `y2` the part of
        the picture that it shows, in picture pixels. `detections` counts those from score 0.1 on, `seen` is the class
        of the most confident one, and `score` its confidence. `seconds` is the time at the end of the look, on the
        clock of the episode. `value` is that for which the look was chosen. `closer` is the probability that the target
        is there, by a closer look that this is, or that follows it. `brought` is the number of objects that it shows
        most sharply. The columns that the kind adds come last.

        Returns:
            One dictionary for each look.
        """
        closer = {look.of_look: look.place for look in sorted(self.closer, key=lambda each: each.place)}
        brought = Counter(self.objects.passes.tolist())
        rows: list[dict[str, Any]] = []
        for look in self:
            seen = confident_detections(look.detections)
            count = int(seen.count)
            rows.append(
                {
                    "look": look.number,
                    **dict(zip(_PLACE, map(pixels, (*look.fixation, *look.region)), strict=True)),
                    "detections": count,
                    "seen": self.classes[int(seen.labels[0, 0])] if count else None,
                    "score": digits(float(seen.confidence[0, 0])) if count else None,
                    "seconds": None if look.seconds is None else round(look.seconds, 3),
                    "value": digits(look.value),
                    "closer": digits(closer.get(look.number)),
                    "brought": brought[look.number],
                    **{name: digits(each) if isinstance(each, float) else each for name, each in look.more.items()},
                }
            )
        return rows

    def to_dict(self) -> dict[str, Any]:
        """The outcome, the objects (`object_rows`) and the looks (`rows`) as JSON values, without unclaimed numbers.

        Returns:
            Values by name; None for the box of what was not found, and for numbers and errors that are not claimed.
        """
        (width, height), decision = self.size, self.decision
        values: dict[str, Any] = {"picture": self.source, "width": width, "height": height, "target": self.target_name}
        values["targets"] = [self.classes[label] for label in self._sought]
        if decision is not None:
            box = decision.box.tolist() if decision.outcome == "found" and decision.box is not None else [None] * 4
            values |= {"outcome": decision.outcome, "probability": digits(decision.probability)}
            edges = (*(self.found_at or (None, None)), *box)
            values |= {name: None if edge is None else pixels(edge) for name, edge in zip(_PLACE, edges, strict=True)}
        values["least"] = self.least
        for key, numbers in (("expected", self.expected), ("expected_error", self.expected_error)):
            values[key] = {name: None if math.isnan(number) else digits(number) for name, number in numbers.items()}
        values["passes"] = self.passes
        return {**values, "summary": self.summary(), "objects": self.object_rows(), "looks": self.rows()}

    def object_rows(self) -> list[dict[str, Any]]:
        """The objects as a table of plain values, one row for each object, most confident first.

        `x1`, `y1`, `x2` and `y2` are its box and `x` and `y` the middle of the box, in picture pixels. `look` is the
        number of the look that shows it most sharply.

        Returns:
            One dictionary for each object.
        """
        objects = self.objects
        columns = (objects.labels, objects.scores, self.confirmed, objects.passes, objects.boxes)
        return [
            {
                "object": number,
                "class": self.classes[label],
                "score": digits(score),
                "confirmed": sure,
                **dict(zip(_PLACE, map(pixels, ((x1 + x2) / 2, (y1 + y2) / 2, x1, y1, x2, y2)), strict=True)),
                "look": look,
            }
            for number, (label, score, sure, look, (x1, y1, x2, y2)) in enumerate(
                zip(*(column.tolist() for column in columns), strict=True)
            )
        ]

    def to_frame(self, table: _Table = "looks") -> pandas.DataFrame:
        """A table of the record as a pandas data frame.

        Args:
            table: `looks`, the table of `rows`, or `objects`, that of `object_rows`.

        Returns:
            One row for each look or object.

        Raises:
            InputError: there is no such table, or pandas is not installed.
        """
        rows, columns = self._table(table)
        with needing("pandas", "to_frame"):
            import pandas
        return pandas.DataFrame(rows, columns=columns)

    def to_csv(self, path: str | PathLike[str] | None = None, table: _Table = "looks") -> str:
        """A table of the record as CSV, with a header.

        Args:
            path: the file to write; None writes none.
            table: `looks`, the table of `rows`, or `objects`, that of `object_rows`.

        Returns:
            The text of the file.

        Raises:
            InputError: there is no such table.
            DataError: the file cannot be written.

        Example::

            agent.find_all("harbour.tif", "person").to_csv("people.csv", "objects")
        """
        rows, columns = self._table(table)
        return _written(csv_text([columns, *([row.get(name) for name in columns] for row in rows)]), path)

    def to_json(self, path: str | PathLike[str] | None = None) -> str:
        """The record as JSON: the values of `to_dict`.

        Args:
            path: the file to write; None writes none.

        Returns:
            The text of the file.

        Raises:
            DataError: the file cannot be written.
        """
        return _written(json.dumps(self.to_dict(), indent=1, ensure_ascii=False, allow_nan=False) + "\n", path)

    def _table(self, table: str) -> tuple[list[dict[str, Any]], list[str]]:
        check(table in get_args(_Table), "table", "looks or objects", table)
        rows = self.rows() if table == "looks" else self.object_rows()
        return rows, list(self._columns if table == "objects" else dict.fromkeys(name for row in rows for name in row))

    def to_supervision(self) -> supervision.Detections:
        """Convert the objects to `supervision.Detections`, for its annotators, trackers and metrics.

        Supervision numbers classes from 0, without background. `data` has the names of the classes as `class_name`,
        which its annotators show, the number of the look that each box comes from as `look`, and which of the objects
        were confirmed as `confirmed`.

        Returns:
            The objects for Supervision.

        Raises:
            InputError: Supervision is not installed.

        Example::

            found = agent.find_all("harbour.tif", "person").to_supervision()
            picture = supervision.LabelAnnotator().annotate(picture, found)
        """
        objects = self.objects
        data = {"look": objects.passes.numpy(), "confirmed": self.confirmed.numpy()}
        return named_detections(objects.boxes, objects.labels, objects.scores, self.classes[1:], data)

    def to_torchvision(self) -> dict[str, Tensor]:
        """The objects as torchvision's detectors and `torchmetrics` have them: boxes, labels from 1, and scores."""
        objects = self.objects
        return {"boxes": objects.boxes.clone(), "labels": objects.labels.clone(), "scores": objects.scores.clone()}

    def to_coco(
        self, image_id: int | str = 1, categories: Sequence[int | str] | Sequence[Mapping[str, Any]] | None = None
    ) -> list[dict[str, Any]]:
        """Convert the objects to COCO results, for `pycocotools.COCO.loadRes`.

        Args:
            image_id: id of the image in the annotation file.
            categories: the `categories` of the annotation file, in which classes are found by name, or the category id
                of each class. None takes COCO's own ids, if all classes of the objects are among COCO's 80.

        Returns:
            `image_id`, `category_id`, `bbox` as `[x, y, width, height]`, and `score` of each object.

        Raises:
            InputError: the class of an object has no category.
        """
        objects, names = self.objects, self.classes[1:]
        if categories is None:
            categories = coco_categories()
            category_names = {canonical_name(str(each["name"])) for each in categories}
            strange = [name for name in names if canonical_name(name) not in category_names]
            check(not strange, "categories", "those of the annotation file, for classes that COCO has not",
                  f"None with the class {', '.join(strange[:3])}")  # fmt: skip
        if any(isinstance(each, Mapping) for each in categories):
            present = sorted(set(objects.labels.tolist()))
            numbers = category_ids(categories, [names[label - 1] for label in present])
            ids = dict(zip(present, numbers, strict=True))
        else:
            check(len(categories) == len(names), "categories", f"{len(names)} ids", len(categories))
            ids = dict(enumerate(category_ids(categories), 1))
        return coco_results(image_id, objects.boxes, objects.labels, objects.scores, ids)

    def to_yolo(self, path: str | PathLike[str] | None = None) -> str:
        """Convert the objects to labels in the format of YOLO: a line of class, x, y, width and height for each.

        Classes are numbered from 0, without background. `x` and `y` are the middle of the box, and all four are shares
        of the width and height of the picture. Boxes end at its borders.

        Args:
            path: the file to write; None writes none.

        Returns:
            The text of the file; empty without objects.

        Raises:
            DataError: the file cannot be written.
        """
        width, height = self.size
        lines = []
        for label, (x1, y1, x2, y2) in zip(self.objects.labels.tolist(), self._inside(), strict=True):
            shares = (x1 + x2) / 2 / width, (y1 + y2) / 2 / height, (x2 - x1) / width, (y2 - y1) / height
            lines.append(f"{label - 1} {' '.join(f'{share:.6f}' for share in shares)}\n")
        return _written("".join(lines), path)

    def crops(self, picture: LargePicture | ImageLike | None = None) -> list[Tensor]:
        """Cut what the box of each object shows out of the picture.

        Args:
            picture: the picture in full size; None takes the file that the record comes from, with the values and
                bands that were shown.

        Returns:
            `(3, h, w)` bytes of each of the objects, in their order, at least a pixel wide and high.

        Raises:
            InputError: no picture is given, or the record's is not known, or it has another size.
            DataError: the file cannot be read.
        """
        shown = self.shown if picture is None and self.shown is not None else {}
        picture = self.source if picture is None else picture
        if picture is None:
            raise InputError("picture: expected the picture, as the record does not come from a file, got None")
        opened, (width, height) = open_large(picture, **shown), self.size
        check(opened.size == (width, height), "picture", f"the record's, {width} × {height} px", opened.size)
        crops = []
        for x1, y1, x2, y2 in self._inside():
            left, top = min(int(x1), width - 1), min(int(y1), height - 1)
            crops.append(opened.read((left, top, max(math.ceil(x2), left + 1), max(math.ceil(y2), top + 1))))
        return crops

    def _inside(self) -> list[list[float]]:
        """Boxes of the objects, cut at the borders of the picture."""
        width, height = self.size
        return self.objects.boxes.minimum(torch.tensor([width, height] * 2)).clamp(min=0).tolist()

    def to_geojson(
        self, path: str | PathLike[str] | None = None, *, source: str | PathLike[str] | None = None
    ) -> dict[str, Any]:
        """Convert the objects to GeoJSON (RFC 7946): a polygon for each box, with class, score and look.

        For a picture from a GeoTIFF coordinates are longitude and latitude (WGS 84), and a box over the antimeridian
        has two polygons, one on each side. Other pictures have no place on earth: their coordinates are pixels with y
        down, as the member `coordinates` of the collection says.

        Args:
            path: the file to write; None writes none.
            source: the GeoTIFF; None takes the file that the picture of the record comes from, if it is known.

        Returns:
            The `FeatureCollection`, as JSON values.

        Raises:
            InputError: the picture has a georeference, and rasterio is not installed.
            DataError: a file cannot be read or written.

        Example::

            record = agent.find_all("harbour.tif", "boat")
            record.to_geojson("boats.geojson")
        """
        file = self.source if source is None else fspath(source)
        place = None if file is None else georeference(file)
        rows = self.object_rows()
        corners = [
            [(row["x1"], row["y2"]), (row["x2"], row["y2"]), (row["x2"], row["y1"]), (row["x1"], row["y1"])]
            for row in rows
        ]
        if place is None:
            shapes = [
                {"type": "Polygon", "coordinates": [[[*point] for point in (*ring, ring[0])]]} for ring in corners
            ]
        else:
            shapes = [box_on_earth(np.array(ring), place) for ring in corners]
        names = "object", "class", "score", "confirmed", "look"
        collection: dict[str, Any] = {
            "type": "FeatureCollection",
            "coordinates": "longitude and latitude, WGS 84"
            if place is not None
            else "pixels of the picture: x to the right, y down",
            "features": [
                {
                    "type": "Feature",
                    "properties": {name: row[name] for name in names},
                    "geometry": shape,
                }
                for row, shape in zip(rows, shapes, strict=True)
            ],
        }
        _written(json.dumps(collection, allow_nan=False), path)
        return collection


def _written(text: str, path: str | PathLike[str] | None) -> str:
    """The text, after it was written to a file if one is named."""
    if path is not None:
        write_text(path, text)
    return text


def coco_categories() -> list[dict[str, Any]]:
    """The categories of COCO's annotation files, as torchvision has them."""
    from torchvision.models.detection import FasterRCNN_ResNet50_FPN_Weights

    names = FasterRCNN_ResNet50_FPN_Weights.DEFAULT.meta["categories"]
    return [{"id": number, "name": name} for number, name in enumerate(names) if number and name != "N/A"]
