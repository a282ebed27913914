"""Data sets in COCO's format as scenes for visual search."""

import logging
import os
from collections import Counter
from collections.abc import Collection, Sequence
from os import PathLike
from typing import Any, Literal

import torch

from semfov.data.annotations import Annotations, Id, read_annotations, warn_of_form
from semfov.data.classes import canonical_name, class_indices
from semfov.data.reading import read_image
from semfov.data.scene import Annotation, Scene, Scenes, legal_targets
from semfov.errors import DataError, check, check_data
from semfov.io.files import check_regular, inside, json_sha256, sha256

_log = logging.getLogger(__name__)


class CocoScenes(Scenes):
    """Photographs with COCO annotations, selected by the criteria of the published experiments.

    An image is kept if it has at least `min_instances` boxes (of any category) and at least one legal target. A legal
    target is a class whose boxes cover at most `max_target_area` of the image. Categories are matched to `classes` by
    name, in COCO's or in Darknet's spelling.

    Boxes are cut to their image. Boxes without area inside the image are dropped, and so are boxes of categories that
    are not in `classes` and, with `crowd="drop"`, boxes of crowds. `repairs` counts the boxes of the whole file that
    were cut or dropped, and a warning of the logger `semfov.data.coco` lists them. Any other error in the file raises.

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
        coverage: Literal["sum", "union"] = "sum",
        crowd: Literal["keep", "drop"] = "keep",
    ) -> None:
        check(min_instances >= 0, "min_instances", "at least 0", min_instances)
        check(max_target_area is None or max_target_area > 0, "max_target_area", "above 0 or None", max_target_area)
        check(limit is None or limit >= 1, "limit", "at least 1 or None", limit)
        check(coverage in ("sum", "union"), "coverage", "'sum' or 'union'", repr(coverage))
        check(crowd in ("keep", "drop"), "crowd", "'keep' or 'drop'", repr(crowd))
        self.classes = tuple(classes)
        file = read_annotations(annotations)
        packed = _Packed(file, _match(file, self.classes, annotations), annotations, drop_crowds=crowd == "drop")
        self.repairs = packed.repairs
        if self.repairs:
            first = ", ".join(f"{what}: {n}" for what, n in self.repairs.most_common(8))
            rest = [n for _, n in self.repairs.most_common()[8:]]
            _log.warning(
                "%s: %s",
                annotations,
                first + (f", and {sum(rest)} boxes cut or dropped for {len(rest)} more reasons" if rest else ""),
            )

        self._packed = packed
        self._rows: list[int] = []
        self._targets: list[list[int]] = []
        chosen = None if ids is None else _checked_ids(ids, packed.ids, annotations)
        for row, instances in enumerate(packed.instances):
            if instances < min_instances or len(self._rows) == limit:
                continue
            if chosen is not None and str(packed.ids[row]) not in chosen:
                continue
            targets = legal_targets(packed.annotation(row), max_target_area, coverage)
            if targets or max_target_area is None:
                self._rows.append(row)
                self._targets.append(targets)
        some = f"images with at least {min_instances} boxes and a class that covers at most {max_target_area} of them"
        got = f"none among {len(packed.ids)}; relax min_instances or max_target_area"
        check_data(bool(self._rows), f"annotations {annotations}", some, got)
        self.ids = [packed.ids[row] for row in self._rows]
        names = [packed.names[row] for row in self._rows]
        self._files = [inside(root, name) for name in names]
        for path in self._files:
            check_regular(path, f"image {path}")
        if missing := [path for path in self._files if not os.path.exists(path)]:  # also names that are too long
            counts = f"{len(missing)} of {len(names)} are missing"
            raise DataError(f"image {missing[0]}: no such file ({counts}); check data.root")
        settings = [file.digest, self.classes, self.ids, max_target_area, coverage, crowd]
        self.fingerprint = json_sha256([settings, names, [path.stat().st_size for path in self._files]])

    def __getitem__(self, index: int) -> Scene:
        """Decode an image: upright, or as stored where only the stored pixels have the recorded size."""
        annotation = self.annotation(index)
        path, (width, height) = self._files[index], annotation.size
        image = read_image(path)
        high, wide = image.shape[-2:]
        if (wide, high) != annotation.size:
            image = read_image(path, oriented=False)
            got = f"{wide} × {high}; use the image that the annotations were made for"
            fits = image.shape[-2:] == (height, width)
            check_data(fits, f"image {path}", f"{width} × {height} pixels as annotated", got)
        name = self._packed.names[self._rows[index]]
        return Scene(self.ids[index], name, image, annotation.boxes, annotation.labels)

    def annotation(self, index: int) -> Annotation:
        """Return the objects of a scene, of the detector's classes, without decoding its image.

        Args:
            index: position of the scene in the set.

        Returns:
            The objects.
        """
        return self._packed.annotation(self._rows[index])

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


def _checked_ids(ids: Collection[int | str], image_ids: Sequence[Any], annotations: str | PathLike[str]) -> set[str]:
    """Ids as text, checked to be in the annotations."""
    chosen = {str(i) for i in ids}
    missing = sorted(chosen - {str(i) for i in image_ids})
    some = ", ".join(missing[:5]) + (", …" if len(missing) > 5 else "")
    got = f"none for {len(missing)} of them: {some}; correct ids or the annotations"
    check_data(not missing, f"annotations {annotations}", f"an image for each of {len(chosen)} ids", got)
    return chosen


class _Packed:
    """The objects of all images of a file, concatenated in a few tensors, which are cheap to send to workers."""

    def __init__(self, file: Annotations, labels: dict[Id, int], path: object, *, drop_crowds: bool) -> None:
        self.ids: list[Any] = sorted(file.images)
        self.names: list[str] = [file.images[i]["file_name"] for i in self.ids]
        self.sizes: list[tuple[int, int]] = []
        for image in self.ids:
            size = file.size(image)
            if size is None:
                raise DataError(f"annotations {path}: expected width and height of image {image!r}, got none")
            self.sizes.append(size)
        self.repairs: Counter[str] = Counter()

        entries = [(row, entry) for row, i in enumerate(self.ids) for entry in file.objects[i]]
        rows = torch.tensor([row for row, _ in entries], dtype=torch.int64)
        label = torch.tensor([labels[entry["category_id"]] for _, entry in entries], dtype=torch.int64)
        crowd = torch.tensor([bool(entry["iscrowd"]) for _, entry in entries], dtype=torch.bool)
        bboxes = torch.tensor([[float(v) for v in entry["bbox"]] for _, entry in entries], dtype=torch.float64)
        limits = torch.tensor([self.sizes[row] * 2 for row, _ in entries], dtype=torch.float64).reshape(-1, 4)

        corner, extent = bboxes.reshape(-1, 4).split(2, -1)
        edges = torch.cat([corner, corner + extent], -1)
        warn_of_form(bboxes.reshape(-1, 4), limits, path, stacklevel=5)
        cut = edges.clamp(min=0).minimum(limits)
        boxes = cut.float()
        solid = (boxes[:, 2:] > boxes[:, :2]).all(-1)
        dropped = solid & crowd & drop_crowds
        valid = solid & ~dropped
        labelled = valid & (label > 0)
        # official files have two decimals, so a difference of up to 0.01 is rounding
        outside = valid & ((edges - cut).abs() > 0.01).any(-1)
        for what, which in (
            ("without area in the image, dropped", ~solid),
            ("of crowds, dropped", dropped),
            ("cut to the image", outside),
        ):
            if which.any():
                self.repairs[f"boxes {what}"] = int(which.sum())
        for at in (valid & ~labelled).nonzero()[:, 0].tolist():
            name = file.categories[entries[at][1]["category_id"]]["name"]
            self.repairs[f"boxes of {name!r}, which the detector does not know, dropped"] += 1

        self.instances: list[int] = rows[valid].bincount(minlength=len(self.ids)).tolist()
        self._boxes, self._labels, self._crowd = boxes[labelled], label[labelled], crowd[labelled]
        self._ends: list[int] = rows[labelled].bincount(minlength=len(self.ids)).cumsum(0).tolist()

    def annotation(self, row: int) -> Annotation:
        own = slice(self._ends[row - 1] if row else 0, self._ends[row])
        boxes, labels, crowd = self._boxes[own], self._labels[own], self._crowd[own]
        return Annotation(boxes.clone(), labels.clone(), crowd.clone(), self.sizes[row])


def _match(file: Annotations, classes: tuple[str, ...], path: str | PathLike[str]) -> dict[Id, int]:
    """Index of the class by category id, 0 for categories that the detector does not have."""
    indices = class_indices(classes)
    labels = {i: indices.get(canonical_name(category["name"]), 0) for i, category in file.categories.items()}
    names = ", ".join(ascii(category["name"]) for category in list(file.categories.values())[:5]) or "none"
    some = f"some of the detector's {len(classes)} classes ({', '.join(classes[:5])}, ...) among the categories"
    check_data(any(labels.values()), f"annotations {path}", some, names)
    return labels
