"""Data sets in COCO's format as scenes for visual search."""

import logging
import os
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from semfov.data.annotations import Annotations, Entry, Id, read_annotations, warn_of_form
from semfov.data.classes import canonical_name, class_indices
from semfov.data.images import SWAPPED, file_orientation, upright_boxes
from semfov.data.large import picture_size
from semfov.data.reading import read_image
from semfov.data.scene import Annotation, Coverage, Scene, Scenes, legal_targets
from semfov.errors import DataError, check, check_data, checked_keywords
from semfov.io.files import check_regular, inside, json_sha256, sha256

_log = logging.getLogger(__name__)

_MOST_REPAIRS = 8  # that a message lists by their reasons


class CocoScenes(Scenes):
    """Photographs with COCO annotations, selected by the criteria of the published experiments.

    An image is kept if it has at least `min_instances` boxes (of any category) and at least one legal target. A legal
    target is a class whose boxes cover at most `max_target_area` of the image. Categories are matched to `classes` by
    name, in COCO's or in Darknet's spelling.

    Boxes are cut to their image. Boxes without area inside the image are dropped, and so are boxes of categories that
    are not in `classes` and, with `crowd="drop"`, boxes of crowds. `repairs` counts the boxes of the whole file that
    were cut or dropped, and a warning of the logger `semfov.data.coco` lists them. Any other error in the file raises.

    Photographs are turned upright by their EXIF orientation, as viewers and programs for annotation show them. Boxes
    refer to the upright photograph. If the size in the annotation file is that of the photograph before turning, boxes
    are turned with it; a photograph that is square, upside down or mirrored has the same size before and after.

    Args:
        root: folder of the images.
        annotations: COCO instances file.
        classes: names of the detector's classes 1..K.
        min_instances: smallest number of boxes of an image.
        max_target_area: largest fraction of the image that a target may cover; None allows any fraction, and keeps
            images without targets.
        limit: largest number of images; those with the lowest ids are kept.
        ids: ids of the images to select from; None for all.
        coverage: how the fraction is measured (`semfov.data.scene.box_coverage`): `sum` of the boxes' areas, or area of
            their `union`, which is smaller where they overlap. On the 300 photographs of the results tables the sum
            admits 1,079 image-target pairs, the union 1,090.
        crowd: `keep` treats a box around a crowd as an ordinary box (a gaze on a crowd of people is on people), and
            `drop` leaves it out.

    Attributes:
        classes: names of the detector's classes.
        ids: ids of the kept images, ascending.
        repairs: how many boxes were cut or dropped, by reason.
        fingerprint: sha256 of the annotation file, the settings, and the names and sizes of the image files.

    Raises:
        DataError: a file is missing or damaged, is not a regular file or is outside `root`, or no image is left.

    Example::

        scenes = CocoScenes("val2017", "annotations/instances_val2017.json", detector.classes, limit=300)
        scene = scenes[0]
        scene.image, scene.boxes, [scenes.classes[target - 1] for target in scenes.targets(0)]
    """

    ids: list[Any]

    @checked_keywords
    def __init__(
        self,
        root: str | PathLike[str],
        annotations: str | PathLike[str],
        classes: Sequence[str],
        *,
        min_instances: int = 8,
        max_target_area: float | None = 0.2,
        limit: int | None = None,
        ids: Collection[int | str] | None = None,
        coverage: Coverage = "sum",
        crowd: Literal["keep", "drop"] = "keep",
    ) -> None:
        check(min_instances >= 0, "min_instances", "at least 0", min_instances)
        check(max_target_area is None or max_target_area > 0, "max_target_area", "above 0 or None", max_target_area)
        check(limit is None or limit >= 1, "limit", "at least 1 or None", limit)
        check(coverage in ("sum", "union"), "coverage", "'sum' or 'union'", repr(coverage))
        check(crowd in ("keep", "drop"), "crowd", "'keep' or 'drop'", repr(crowd))
        self.classes = tuple(classes)
        self._name = f"annotations {annotations}"
        file = read_annotations(annotations)
        labels = _labels_of(file, self.classes, self._name)
        self._packed = _Packed(file, labels, annotations, drop_crowds=crowd == "drop")
        self.repairs = self._packed.repairs
        if self.repairs:
            _log.warning("%s: %s", annotations, _in_words(self.repairs))

        criteria = _Criteria(min_instances, max_target_area, coverage)
        targets_by_row = self._select(criteria, self._rows_of(ids), limit)
        got = f"none among {len(self._packed.ids)}; relax min_instances or max_target_area"
        check_data(bool(targets_by_row), self._name, f"images with {criteria.words}", got)
        self._rows = list(targets_by_row)
        self._targets = list(targets_by_row.values())
        self.ids = [self._packed.ids[row] for row in self._rows]
        names = [self._packed.names[row] for row in self._rows]
        self._files = _files_of(root, names)
        self._orientations: dict[int, int] = {}  # those that were asked for, by the position of the scene

        # Names and sizes tell another copy of the images apart without reading them.
        settings = [file.digest, self.classes, self.ids, max_target_area, coverage, crowd]
        sizes = [path.stat().st_size for path in self._files]
        self.fingerprint = json_sha256([settings, names, sizes])

    def _rows_of(self, ids: Collection[int | str] | None) -> list[int]:
        """Find the rows of the images to select from, ascending; raises `DataError` for ids of no image."""
        image_ids = [str(image) for image in self._packed.ids]
        if ids is None:
            return list(range(len(image_ids)))
        chosen = {str(image) for image in ids}
        missing = sorted(chosen - set(image_ids))
        if missing:
            first = ", ".join(missing[:5])
            others = ", …" if len(missing) > 5 else ""
            raise DataError(
                f"{self._name}: expected an image for each of {len(chosen)} ids, got none for {len(missing)} of them: "
                f"{first}{others}; correct ids or the annotations"
            )
        return [row for row, image in enumerate(image_ids) if image in chosen]

    def _select(self, criteria: "_Criteria", rows: Sequence[int], limit: int | None) -> dict[int, list[int]]:
        """Select the first images that meet the criteria; returns their legal targets by their rows."""
        selected: dict[int, list[int]] = {}
        for row in rows:
            if len(selected) == limit:
                break
            if self._packed.instances[row] < criteria.min_instances:
                continue
            targets = legal_targets(self._packed.annotation(row), criteria.max_target_area, criteria.coverage)
            if targets or criteria.max_target_area is None:
                selected[row] = targets
        return selected

    def __getitem__(self, index: int) -> Scene:
        """Decode an image, and turn it upright."""
        annotation = self.annotation(index)
        path = self._files[index]
        width, height = annotation.size
        image = read_image(path)
        got = f"{image.shape[-1]} × {image.shape[-2]}; use the image that the annotations were made for"
        is_annotated = image.shape[-2:] == (height, width)
        check_data(is_annotated, f"image {path}", f"{width} × {height} pixels as annotated", got)
        name = self._packed.names[self._rows[index]]
        return Scene(self.ids[index], name, image, annotation.boxes, annotation.labels)

    def annotation(self, index: int) -> Annotation:
        """Return the objects of a scene, of the detector's classes, without decoding its image.

        Args:
            index: position of the scene in the set.

        Returns:
            The objects, in pixels of the upright photograph.

        Raises:
            DataError: the size of a photograph on its side cannot be read.
        """
        annotation = self._packed.annotation(self._rows[index])
        orientation = self._annotated_orientation(index)
        if orientation < SWAPPED:
            return annotation
        width, height = annotation.size
        boxes = upright_boxes(annotation.boxes, annotation.size, orientation)
        return replace(annotation, boxes=boxes, size=(height, width))

    def _annotated_orientation(self, index: int) -> int:
        """Tell in which EXIF orientation a photograph is annotated: 1 for upright, else that of its stored pixels."""
        if index not in self._orientations:
            path = self._files[index]
            width, height = self._packed.sizes[self._rows[index]]
            # A square has one size in both frames.
            orientation = 1 if width == height else file_orientation(path)
            is_stored = orientation >= SWAPPED and picture_size(path) == (height, width)
            self._orientations[index] = orientation if is_stored else 1
        return self._orientations[index]

    def targets(self, index: int) -> list[int]:
        """List the classes of a scene that may be searched for, 1..K, ascending.

        Args:
            index: position of the scene in the set.

        Returns:
            Class indices.
        """
        return list(self._targets[index])

    def digest(self, index: int) -> str:
        """Compute the sha256 of an image file and of the size in its annotations.

        Args:
            index: position of the scene in the set.

        Returns:
            64 hexadecimal digits.

        Raises:
            DataError: the file is missing or cannot be read.
        """
        path = self._files[index]
        return json_sha256([sha256(path, f"image {path}"), self._packed.sizes[self._rows[index]]])


@dataclass(frozen=True)
class _Criteria:
    """Which images and targets are taken, as in `CocoScenes`."""

    min_instances: int
    max_target_area: float | None
    coverage: Coverage

    @property
    def words(self) -> str:
        """What an image must have, in words."""
        return f"at least {self.min_instances} boxes and a class that covers at most {self.max_target_area} of them"


def _in_words(repairs: Counter[str]) -> str:
    """Name the most frequent repairs with their numbers, and the sum of the others."""
    counts = repairs.most_common()
    words = ", ".join(f"{repair}: {count}" for repair, count in counts[:_MOST_REPAIRS])
    others = [count for _, count in counts[_MOST_REPAIRS:]]
    if others:
        words += f", and {sum(others)} boxes cut or dropped for {len(others)} more reasons"
    return words


def _files_of(root: str | PathLike[str], names: Sequence[str]) -> list[Path]:
    """Find the files of images inside their folder; raises `DataError` unless all are there and regular."""
    files = [inside(root, name) for name in names]
    for path in files:
        check_regular(path, f"image {path}")
    missing = [path for path in files if not os.path.exists(path)]  # also names that are too long
    if missing:
        counts = f"{len(missing)} of {len(names)} are missing"
        raise DataError(f"image {missing[0]}: no such file ({counts}); check data.root")
    return files


class _Packed:
    """The objects of all images of a file, concatenated in a few tensors, which are cheap to send to workers.

    Attributes:
        ids: ids of the images, ascending; the place of an image in this list is its row.
        names: names of their files.
        sizes: `(width, height)` of each image.
        instances: number of boxes of each image, of any category, after the repairs.
        repairs: how many boxes were cut or dropped, by reason.

    Private attributes: `_boxes`, `_labels` and `_crowd` have the objects of the detector's classes, row after row, and
    `_ends` where the objects of each row end.

    Invariant: the objects of row r are those from `_ends[r - 1]` (0 for the first row) to before `_ends[r]`; all lists
    have an entry for each row, and `instances[r]` is at least the number of these objects.
    """

    def __init__(self, file: Annotations, labels: dict[Id, int], path: object, *, drop_crowds: bool) -> None:
        self.ids: list[Any] = sorted(file.images)
        self.names: list[str] = [file.images[image]["file_name"] for image in self.ids]
        self.sizes = [_size_of(file, image, path) for image in self.ids]
        self.repairs: Counter[str] = Counter()

        entries, rows = _entries_by_row(file, self.ids)
        categories = [entry["category_id"] for entry in entries]
        label = torch.tensor([labels[category] for category in categories], dtype=torch.int64)
        crowd = torch.tensor([bool(entry["iscrowd"]) for entry in entries], dtype=torch.bool)

        bboxes = _bboxes_of(entries)
        limits = _limits_of(self.sizes, rows)
        warn_of_form(bboxes, limits, path, stacklevel=5)
        boxes, is_cut = _cut_to_image(bboxes, limits)

        has_area = (boxes[:, 2:] > boxes[:, :2]).all(-1)
        is_dropped_crowd = has_area & crowd & drop_crowds
        is_valid = has_area & ~is_dropped_crowd
        is_known = label > 0
        self._note("boxes without area in the image, dropped", ~has_area)
        self._note("boxes of crowds, dropped", is_dropped_crowd)
        self._note("boxes cut to the image", is_valid & is_cut)
        for number in (is_valid & ~is_known).nonzero()[:, 0].tolist():
            name = file.categories[categories[number]]["name"]
            self.repairs[f"boxes of {name!r}, which the detector does not know, dropped"] += 1

        # Boxes of all categories count for `min_instances`; those of the detector's classes are objects.
        is_object = is_valid & is_known
        self.instances: list[int] = _counts_by_row(rows[is_valid], len(self.ids)).tolist()
        self._boxes = boxes[is_object]
        self._labels = label[is_object]
        self._crowd = crowd[is_object]
        self._ends: list[int] = _counts_by_row(rows[is_object], len(self.ids)).cumsum(0).tolist()

    def _note(self, repair: str, is_repaired: Tensor) -> None:
        """Note how many of all boxes got a repair, `(N,)` boolean, if any did."""
        if is_repaired.any():
            self.repairs[repair] = int(is_repaired.sum())

    def annotation(self, row: int) -> Annotation:
        """Return the objects of an image, of the detector's classes."""
        start = self._ends[row - 1] if row else 0
        objects = slice(start, self._ends[row])
        boxes = self._boxes[objects].clone()
        labels = self._labels[objects].clone()
        crowd = self._crowd[objects].clone()
        return Annotation(boxes, labels, crowd, self.sizes[row])


def _entries_by_row(file: Annotations, ids: Sequence[Id]) -> tuple[list[Entry], Tensor]:
    """List the N entries of all images, row after row, and the row of each, `(N,)`."""
    entries: list[Entry] = []
    rows: list[int] = []
    for row, image in enumerate(ids):
        entries_of_image = file.objects[image]
        entries += entries_of_image
        rows += [row] * len(entries_of_image)
    return entries, torch.tensor(rows, dtype=torch.int64)


def _bboxes_of(entries: Sequence[Entry]) -> Tensor:
    """Take the boxes of entries, `(N, 4)`: left upper corner, width and height in pixels."""
    # In float64, in which a box that ends at the border of its image is not beyond it.
    numbers = [list(map(float, entry["bbox"])) for entry in entries]
    return torch.tensor(numbers, dtype=torch.float64).reshape(-1, 4)


def _limits_of(sizes: Sequence[tuple[int, int]], rows: Tensor) -> Tensor:
    """Repeat the size of the image of each box, from its row `(N,)`, for both of its corners, `(N, 4)`."""
    sides = torch.tensor(sizes, dtype=torch.float64).reshape(-1, 2)[rows]
    return torch.cat([sides, sides], -1)


def _counts_by_row(rows: Tensor, count: int) -> Tensor:
    """Count the objects `(N,)` of each row; also of the last rows, which may have none, `(count,)`."""
    return rows.bincount(minlength=count)


def _size_of(file: Annotations, image: Id, path: object) -> tuple[int, int]:
    """Tell `(width, height)` of an image; raises `DataError` where the file does not say."""
    size = file.size(image)
    if size is None:
        raise DataError(f"annotations {path}: expected width and height of image {image!r}, got none")
    return size


def _cut_to_image(bboxes: Tensor, limits: Tensor) -> tuple[Tensor, Tensor]:
    """Cut boxes to their images.

    Args:
        bboxes: `(N, 4)`, `[x, y, width, height]`.
        limits: `(N, 4)`, width and height of the image of each box, twice.

    Returns:
        Corners `(N, 4)` in float32, and whether the cut moved one, `(N,)`.
    """
    corner, extent = bboxes.split(2, -1)
    edges = torch.cat([corner, corner + extent], -1)
    cut = edges.clamp(min=0).minimum(limits)
    # Official files have two decimals, so a difference of up to 0.01 is rounding.
    is_cut = ((edges - cut).abs() > 0.01).any(-1)
    return cut.float(), is_cut


def _labels_of(file: Annotations, classes: tuple[str, ...], name: str) -> dict[Id, int]:
    """Find the index of the class by category id, 0 for categories that the detector does not have."""
    indices = class_indices(classes)
    names = {category: entry["name"] for category, entry in file.categories.items()}
    labels = {category: indices.get(canonical_name(label), 0) for category, label in names.items()}
    expected = f"some of the detector's {len(classes)} classes ({', '.join(classes[:5])}, ...) among the categories"
    first_names = list(names.values())[:5]
    check_data(any(labels.values()), name, expected, ", ".join(map(ascii, first_names)) or "none")
    return labels
