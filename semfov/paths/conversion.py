"""Conversion of a record to words and tables, and of its objects to the formats of other libraries and of maps."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import chain
from os import PathLike, fspath
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from semfov.attribute_words import RECORD, OtherWords
from semfov.data.classes import canonical_name
from semfov.data.inputs import ImageLike
from semfov.data.large import open_large
from semfov.data.windowed import LargePicture
from semfov.detection.exchange import CocoResult, category_ids, coco_results, named_detections
from semfov.errors import InputError, check, needing
from semfov.io.files import write_text
from semfov.io.tables import csv_text, digits, pixels, share
from semfov.paths.georeference import Geometry, PlaceOnEarth, box_on_earth, georeference
from semfov.paths.look import RecordedLook, confident_detections
from semfov.paths.outcome import Outcome
from semfov.paths.words import Words

if TYPE_CHECKING:
    import pandas
    import supervision

Values = dict[str, Any]
"""JSON values by name: a row of a table, or an object of a file."""

_Table = Literal["looks", "objects"]  # tables of a record

_PLACE = ("x", "y", "x1", "y1", "x2", "y2")
COLUMNS = ("object", "class", "score", "confirmed", *_PLACE, "look")
"""Columns of the table of objects."""

DECISION_COLUMNS = ("target", "outcome", "probability", "score", "assumed", "place_probability", *_PLACE, "passes")
"""Values of `to_dict` that stand in a table of searches, a line for each picture."""


class Conversion(Outcome, OtherWords):
    """Converts a record to words, its looks and objects to tables, and the objects to other formats."""

    _other_words = RECORD
    _objects = "record.objects"

    _words: ClassVar[type[Words]]
    """Class of the words for the record."""

    _columns: ClassVar[tuple[str, ...]] = COLUMNS
    """Columns of the table of objects."""

    @property
    def words(self) -> Words:
        """The words for the record (`semfov.paths.words.Words`)."""
        return self._words(self)

    def describe(self) -> str:
        """Say in one line what a search decided, or which objects the looks found.

        Returns:
            The line.
        """
        return self.words.describe()

    def why_it_ended(self) -> str:
        """Explain in one sentence why the search or the exploration ended.

        Returns:
            The sentence; empty if the reason is not known.
        """
        return self.words.why_it_ended()

    def summary(self) -> str:
        """Describe the outcome, explain why the search or exploration ended, and name the best place if in doubt.

        Returns:
            The sentences.
        """
        return self.words.summary()

    def rows(self) -> list[Values]:
        """Make a table of the looks, of plain values. All kinds of records have the first columns.

        `look` is the number of the look, from 1, `x` and `y` are the fixated point, and `x1`, `y1`, `x2` and `y2` the
        part of the picture that it shows, in picture pixels. `detections` counts those from score 0.1 on, `seen` is the
        class of the most confident one, and `score` its confidence. `seconds` is the time at the end of the look, on
        the clock of the episode. `value` is the value for which the look was chosen. `closer` is the probability that
        the target is at the place, if this is a closer look, or a closer look follows. `brought` is the number of
        objects that no other look shows more sharply. The columns of the kind of look come last.

        Returns:
            One dictionary for each look.
        """
        # Of several closer looks after one look, the surest counts: it comes last.
        closer = {look.index_of_look: look.place for look in sorted(self.closer, key=lambda look: look.place)}
        brought = Counter(self.objects.passes.tolist())
        rows: list[Values] = []
        for look in self:
            row: Values = {
                "look": look.number,
                **_rounded_place(*look.fixation, *look.region),
                **self._detection_columns(look),
                "seconds": None if look.seconds is None else round(look.seconds, 3),
                "value": digits(look.value),
                "closer": digits(closer.get(look.index)),
                "brought": brought[look.index],
            }
            for name, value in look.more.items():
                row[name] = digits(value) if isinstance(value, float) else value
            rows.append(row)
        return rows

    def _detection_columns(self, look: RecordedLook) -> Values:
        """Count the detections of a look from score 0.1 on, with class and confidence of the most confident one."""
        detections = confident_detections(look.detections)
        count = int(detections.count)
        if count == 0:
            return {"detections": 0, "seen": None, "score": None}
        return {
            "detections": count,
            "seen": self.classes[int(detections.labels[0, 0])],
            "score": digits(float(detections.confidence[0, 0])),
        }

    def to_dict(self) -> Values:
        """Convert the outcome, the objects (`object_rows`) and the looks (`rows`) to JSON values.

        Returns:
            Values by name. If the target was found, point and box are those of the target, otherwise those of its best
            place; `place_probability` is the probability that the target is there, and `probability` that it is
            anywhere in the picture. Without fitted models both are None, and `score` is the number on which the
            decision rests. Unknown values are None.
        """
        width, height = self.size
        return {
            "picture": self.source,
            "width": width,
            "height": height,
            "target": self.target_name,
            "targets": [self.classes[label] for label in self.sought],
            **self._decision_values(),
            "score_threshold": self.score_threshold,
            "expected": _without_nan(self.expected),
            "expected_error": _without_nan(self.expected_error),
            "expected_guessed": self.expected_guessed,
            "passes": self.passes,
            "summary": self.summary(),
            "objects": self.object_rows(),
            "looks": self.rows(),
        }

    def _decision_values(self) -> Values:
        """Make JSON values of the decision, with the place of the target or the best place; empty without one."""
        decision = self.decision
        if decision is None:
            return {}
        is_probability = self.words.decided_by == "probability"
        return {
            "outcome": decision.outcome,
            "probability": digits(decision.probability) if is_probability else None,
            "score": None if is_probability else digits(decision.probability),
            "confirm": digits(decision.confirm),
            "prior": self.prior,
            "assumed": share(self.assumed),
            "place_probability": digits(self.place_probability) if is_probability else None,
            **self._decided_place(),
        }

    def _decided_place(self) -> dict[str, float | None]:
        """Make JSON values of the place of a found target, or of the best place: a point and a box."""
        if self.best_place is not None:
            return _middle_and_box(*self.best_place[0].tolist())
        if self._find is not None and self._find.box is not None:
            return _middle_and_box(*self._find.box.tolist())
        x, y = self.found_at or (None, None)
        return _rounded_place(x, y, *[None] * 4)

    def object_rows(self) -> list[Values]:
        """Make a table of the objects, of plain values, most confident first.

        `x1`, `y1`, `x2` and `y2` are the box of the object and `x` and `y` the middle of the box, in picture pixels.
        `look` is the number, from 1, of the look that shows it most sharply.

        Returns:
            One dictionary for each object.
        """
        objects = self.objects
        columns = (objects.labels, objects.scores, self.confirmed, objects.passes, objects.boxes)
        rows: list[Values] = []
        for label, score, confirmed, index, box in zip(*(column.tolist() for column in columns), strict=True):
            rows.append(
                {
                    "object": len(rows),
                    "class": self.classes[label],
                    "score": digits(score),
                    "confirmed": confirmed,
                    **_middle_and_box(*box),
                    "look": index + 1,
                }
            )
        return rows

    def to_frame(self, table: _Table = "looks") -> pandas.DataFrame:
        """Convert a table of the record to a pandas data frame.

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
        """Convert a table of the record to CSV, with a header.

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
        lines = [[row.get(name) for name in columns] for row in rows]
        return _written(csv_text([columns, *lines]), path)

    def to_json(self, path: str | PathLike[str] | None = None) -> str:
        """Convert the record to JSON, the values of `to_dict`.

        Args:
            path: the file to write; None writes none.

        Returns:
            The text of the file.

        Raises:
            DataError: the file cannot be written.
        """
        return _written(json.dumps(self.to_dict(), indent=1, ensure_ascii=False, allow_nan=False) + "\n", path)

    def _table(self, table: str) -> tuple[list[Values], list[str]]:
        """Make the rows and the names of the columns of a table."""
        check(table in get_args(_Table), "table", "looks or objects", table)
        rows = self.object_rows() if table == "objects" else self.rows()
        # A table without objects has a head, too.
        head = self._columns if table == "objects" else ()
        # Looks of one record may have other columns, which stand in the order in which rows first have them.
        columns = dict.fromkeys([*head, *chain.from_iterable(rows)])
        return rows, list(columns)

    def to_supervision(self) -> supervision.Detections:
        """Convert the objects to `supervision.Detections`, for its annotators, trackers and metrics.

        Supervision numbers classes from 0, without background. `data` has the names of the classes as `class_name`,
        which its annotators show, the number of the look that each box comes from as `look`, and which of the objects
        were confirmed as `confirmed`. Objects of a stream have their numbers as `tracker_id`.

        Returns:
            The objects for Supervision.

        Raises:
            InputError: Supervision is not installed.

        Example::

            found = agent.find_all("harbour.tif", "person").to_supervision()
            picture = supervision.LabelAnnotator().annotate(picture, found)
        """
        objects = self.objects
        data = {"look": objects.passes.numpy() + 1, "confirmed": self.confirmed.numpy()}
        columns = (objects.boxes, objects.labels, objects.scores)
        return named_detections(*columns, self.classes[1:], data, objects.track_ids)

    def to_torchvision(self) -> dict[str, Tensor]:
        """Convert the objects to what torchvision's detectors return and `torchmetrics` takes.

        Returns:
            `boxes` `(M, 4)`, `labels` `(M,)` from 1, and `scores` `(M,)`.
        """
        objects = self.objects
        return {"boxes": objects.boxes.clone(), "labels": objects.labels.clone(), "scores": objects.scores.clone()}

    def to_coco(
        self, image_id: int | str = 1, categories: Sequence[int | str] | Sequence[Mapping[str, Any]] | None = None
    ) -> list[CocoResult]:
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
        if categories is None:
            categories = coco_categories()
            self._check_classes_in(categories)
        objects = self.objects
        return coco_results(image_id, objects.boxes, objects.labels, objects.scores, self._category_ids(categories))

    def _check_classes_in(self, categories: Sequence[Mapping[str, Any]]) -> None:
        """Raise `InputError` unless all classes are among COCO's own categories."""
        names_in_coco = {canonical_name(str(category["name"])) for category in categories}
        unknown = [name for name in self.classes[1:] if canonical_name(name) not in names_in_coco]
        expected = "those of the annotation file, for classes that COCO has not"
        check(not unknown, "categories", expected, f"None with the class {', '.join(unknown[:3])}")

    def _category_ids(self, categories: Sequence[int | str] | Sequence[Mapping[str, Any]]) -> dict[int, int | str]:
        """Find the category id of each class 1..K, or in categories of a file of each class that an object has."""
        names = self.classes[1:]
        if any(isinstance(category, Mapping) for category in categories):
            # A file may lack classes of the detector, of which there is no object.
            labels = sorted(set(self.objects.labels.tolist()))
            ids = category_ids(categories, [names[label - 1] for label in labels])
            return dict(zip(labels, ids, strict=True))
        check(len(categories) == len(names), "categories", f"{len(names)} ids", len(categories))
        return dict(enumerate(category_ids(categories), 1))

    def to_yolo(self, path: str | PathLike[str] | None = None) -> str:
        """Convert the objects to labels in the format of YOLO: a line of class, x, y, width and height for each.

        Classes are numbered from 0, without background. `x` and `y` are the middle of the box, and all four are shares
        of the width and height of the picture. Boxes are cut at its borders. The format has no scores; an object that
        the decision or a closer look confirmed is included, whatever its score (`confirmed`).

        Args:
            path: the file to write; None writes none.

        Returns:
            The text of the file; empty without objects.

        Raises:
            DataError: the file cannot be written.
        """
        width, height = self.size
        lines = []
        boxes = self._boxes_inside(self.objects.boxes)
        for label, (x1, y1, x2, y2) in zip(self.objects.labels.tolist(), boxes, strict=True):
            middle = f"{(x1 + x2) / 2 / width:.6f} {(y1 + y2) / 2 / height:.6f}"
            extent = f"{(x2 - x1) / width:.6f} {(y2 - y1) / height:.6f}"
            lines.append(f"{label - 1} {middle} {extent}\n")
        return _written("".join(lines), path)

    def crops(self, picture: LargePicture | ImageLike | None = None, *, boxes: Tensor | None = None) -> list[Tensor]:
        """Cut the box of each object out of the picture.

        Args:
            picture: the picture in full size; None: the file of the record, read with the same settings (`shown`).
            boxes: `(M, 4)`, other boxes to cut out, such as that of the best place; None takes those of the objects.

        Returns:
            `(3, h, w)` bytes of each of the boxes, in their order, at least a pixel wide and high.

        Raises:
            InputError: no picture is given and the record has no file, or the picture has another size.
            DataError: the file cannot be read.
        """
        opened = self._opened(picture)
        width, height = self.size
        check(opened.size == (width, height), "picture", f"the record's, {width} × {height} px", opened.size)
        crops = []
        for x1, y1, x2, y2 in self._boxes_inside(self.objects.boxes if boxes is None else boxes):
            # A box without area, or at the right or lower border, still has a pixel.
            left = min(int(x1), width - 1)
            top = min(int(y1), height - 1)
            right = max(math.ceil(x2), left + 1)
            bottom = max(math.ceil(y2), top + 1)
            crops.append(opened.read((left, top, right, bottom)))
        return crops

    def _opened(self, picture: LargePicture | ImageLike | None) -> LargePicture:
        """Open a picture, or the file that the record comes from with the values and bands that were shown."""
        if picture is not None:
            return open_large(picture)
        if self.source is None:
            raise InputError("picture: expected the picture, as the record does not come from a file, got None")
        return open_large(self.source, **(self.shown or {}))

    def _boxes_inside(self, boxes: Tensor) -> list[list[float]]:
        """Cut boxes `(M, 4)` at the borders of the picture."""
        width, height = self.size
        return boxes.minimum(torch.tensor([width, height] * 2)).clamp(min=0).tolist()

    def to_geojson(
        self, path: str | PathLike[str] | None = None, *, source: str | PathLike[str] | None = None
    ) -> Values:
        """Convert the objects to GeoJSON (RFC 7946): a polygon for each box, with class, score and look.

        For a picture from a GeoTIFF coordinates are longitude and latitude (WGS 84), and a box over the antimeridian
        has two polygons, one on each side. For other pictures coordinates are pixels with y down, as the member
        `coordinates` of the collection says.

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
        in_pixels = "pixels of the picture: x to the right, y down"
        collection: Values = {
            "type": "FeatureCollection",
            "coordinates": in_pixels if place is None else "longitude and latitude, WGS 84",
            "features": [_feature(row, place) for row in self.object_rows()],
        }
        _written(json.dumps(collection, allow_nan=False), path)
        return collection


def _feature(row: Values, place: PlaceOnEarth | None) -> Values:
    """Make the GeoJSON feature of an object, on earth or in pixels."""
    properties = {name: row[name] for name in COLUMNS if name not in _PLACE}
    return {"type": "Feature", "properties": properties, "geometry": _geometry(row, place)}


def _geometry(row: Values, place: PlaceOnEarth | None) -> Geometry:
    """Make the GeoJSON geometry of an object's box, on earth or in pixels."""
    x1, y1, x2, y2 = (row[name] for name in ("x1", "y1", "x2", "y2"))
    # Outer rings are counterclockwise (RFC 7946, 3.1.6), as seen with y down in the picture and with north up on earth.
    corners = [[x1, y2], [x2, y2], [x2, y1], [x1, y1]]
    if place is not None:
        return box_on_earth(np.array(corners), place)
    return {"type": "Polygon", "coordinates": [[*corners, corners[0]]]}


def _middle_and_box(x1: float, y1: float, x2: float, y2: float) -> dict[str, float | None]:
    """Round a box for a table, with its middle as the point."""
    return _rounded_place((x1 + x2) / 2, (y1 + y2) / 2, x1, y1, x2, y2)


def _rounded_place(*edges: float | None) -> dict[str, float | None]:
    """Round a point `x`, `y` and a box `x1`, `y1`, `x2`, `y2` for a table; None stays."""
    return {name: None if edge is None else pixels(edge) for name, edge in zip(_PLACE, edges, strict=True)}


def _without_nan(numbers: Mapping[str, float]) -> dict[str, float | None]:
    """Round numbers of classes for JSON, which has no NaN: these become None."""
    return {name: None if math.isnan(number) else digits(number) for name, number in numbers.items()}


def _written(text: str, path: str | PathLike[str] | None) -> str:
    """Return a text, after it was written to a file if one is named."""
    if path is not None:
        write_text(path, text)
    return text


def coco_categories() -> list[Values]:
    """Return the categories of COCO's annotation files, as torchvision has them: `id` and `name` of each."""
    from torchvision.models.detection import FasterRCNN_ResNet50_FPN_Weights

    names = FasterRCNN_ResNet50_FPN_Weights.DEFAULT.meta["categories"]
    return [{"id": number, "name": name} for number, name in enumerate(names) if number and name != "N/A"]
