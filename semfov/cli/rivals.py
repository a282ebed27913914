"""Ways to look at pictures, compared: by semfov, at all slices, and at the best slices first."""

import time
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.agent import ActivePerception
from semfov.cli.truth import Truth
from semfov.data.annotations import Annotations, Entry, Id, annotation_of
from semfov.data.classes import canonical_name
from semfov.data.images import stored_boxes
from semfov.data.scene import Annotation
from semfov.data.windowed import LargePicture
from semfov.detection.exchange import coco_results
from semfov.detection.objects import SCORE_THRESHOLD, Objects
from semfov.errors import check_data
from semfov.metrics.average_precision import average_precision
from semfov.observation.matching import right_boxes
from semfov.paths import Record
from semfov.zoom.episode import look_by_look
from semfov.zoom.eye import WindowEye
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import LiveWindowLooks, Window, WindowLook
from semfov.zoom.objects import merge
from semfov.zoom.slices import ranked, slices

SEMFOV = "semfov"
ALL_SLICES = "all slices"

_AFTER = (1, 2, 4, 8, 16, 24, 32, 48, 64)  # passes after which the objects found so far are compared


class Finding(NamedTuple):
    """Objects that one way of looking has found in a picture.

    Attributes:
        passes: passes of the detector so far.
        seconds: seconds so far, with choosing and merging, without reading the file.
        objects: all objects, from low scores on, most confident first.
        threshold: score from which on they are listed.
    """

    passes: int
    seconds: float
    objects: Objects
    threshold: float


Way = Callable[[LargePicture], list[Finding]]
"""Looks at a picture, and returns what it has found after some numbers of passes."""


@dataclass(frozen=True)
class Point:
    """Result of one way of looking with a number of passes, over all pictures.

    Attributes:
        way: name of the way.
        passes: mean number of passes for a picture.
        seconds: mean number of seconds for a picture.
        ap50: average precision at an overlap of 0.5 against the reference; None where that has no objects.
        listed: number of objects that are listed.
        right: how many of these are in the reference.
        reference: number of objects in the reference.
    """

    way: str
    passes: float
    seconds: float
    ap50: float | None
    listed: int
    right: int
    reference: int

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of objects: listed, of these right, and in the reference."""
        return self.listed, self.right, self.reference


def by_semfov(agent: ActivePerception, labels: Sequence[int], passes: int, picture: LargePicture) -> list[Finding]:
    """Look as an agent does, which chooses each window and may end before its last pass.

    Args:
        agent: the agent.
        labels: classes 1..K to find; none for all.
        passes: most passes.
        picture: the picture.

    Returns:
        What was found after some numbers of passes.
    """
    wanted = _wanted(passes)
    stops: list[tuple[float, Record]] = []
    began = time.perf_counter()

    def stop_the_clock(record: Record) -> None:
        if record.passes in wanted:
            stops.append((time.perf_counter() - began, record))

    last = agent.find_all(picture, [*labels] or None, how="windows", passes=passes, on_look=stop_the_clock)
    # The last record counts also where it ends between two of the numbers.
    if not stops or stops[-1][1].passes < last.passes:
        stops.append((time.perf_counter() - began, last))
    findings = []
    for seconds, record in stops:
        # Objects are merged after the search, and the time for that is added to each point.
        merging = time.perf_counter()
        objects = record.candidates.of(labels)
        seconds += time.perf_counter() - merging
        findings.append(Finding(record.passes, seconds, objects, record.score_threshold))
    return findings


def all_slices(
    eye: WindowEye, labels: Sequence[int], side: int, overlap: float, picture: LargePicture
) -> list[Finding]:
    """Look at the whole picture and at all its slices, as SAHI does (Akyon et al., 2022).

    Args:
        eye: the eye, with the detector.
        labels: classes 1..K to find; none for all.
        side: of a slice in pixels.
        overlap: share of its side that the next one repeats.
        picture: the picture.

    Returns:
        What was found after all passes.
    """
    clock = _Clock()
    source = LiveWindowLooks(eye, eye.open(picture))
    windows = [Window.overview(source.lattice), *_slices_of(source.lattice, side, overlap)]
    # Slices are not chosen by hints, so that no time is spent on making them.
    looks = [source.see([window], hints=False)[0] for window in windows]
    return [clock.finding(looks, labels)]


def best_slices(
    eye: WindowEye, labels: Sequence[int], side: int, overlap: float, passes: int, picture: LargePicture
) -> list[Finding]:
    """Look at the slices in the order of the raw scores that the whole picture has in them.

    Args:
        eye: the eye, with the detector.
        labels: classes 1..K to find; none for all.
        side: of a slice in pixels.
        overlap: share of its side that the next one repeats.
        passes: most passes.
        picture: the picture.

    Returns:
        What was found after some numbers of passes.
    """
    wanted = _wanted(passes)
    clock = _Clock()
    source = LiveWindowLooks(eye, eye.open(picture))
    order = ranked(_slices_of(source.lattice, side, overlap), labels)
    looks: list[WindowLook] = []
    findings = []
    for step in islice(look_by_look(source, order, None), passes):
        looks.append(step.look)
        if len(looks) in wanted:
            findings.append(clock.finding(looks, labels))
    # The last look counts also where there are no more slices before the next of the numbers.
    if len(looks) not in wanted:
        findings.append(clock.finding(looks, labels))
    return findings


class _Clock:
    """Time of a run since this was made.

    Objects are merged for each point on the way, which a run that ends at a later point does not do: a merge counts
    for its own point alone.
    """

    def __init__(self) -> None:
        self._began = time.perf_counter()

    def finding(self, looks: Sequence[WindowLook], labels: Sequence[int]) -> Finding:
        """Merge what the looks so far show, and tell the time with this merge."""
        merging = time.perf_counter()
        objects = merge(looks, labels)
        merged = time.perf_counter()
        finding = Finding(len(looks), merged - self._began, objects, SCORE_THRESHOLD)
        self._began += merged - merging
        return finding


def warm_up(eye: WindowEye, picture: LargePicture) -> None:
    """Read a picture and run the detector on it once, so that the first way that is timed does not pay for that."""
    view = eye.open(picture)
    eye.look(view, torch.tensor([Window.overview(view.lattice).fixation]))


def _wanted(passes: int) -> set[int]:
    """Choose the numbers of passes after which objects are compared."""
    return {number for number in _AFTER if number < passes} | {passes}


def _slices_of(lattice: Lattice, side: int, overlap: float) -> list[Window]:
    """Cut the slices of a picture; one that is as large as the picture would only repeat the look at it."""
    if side >= max(lattice.size):
        return []
    return slices(lattice, side, max(1, int(side * (1 - overlap))))


class Reference(ABC):
    """Reference that says which objects count as right.

    Args:
        classes: names of the detector's classes.
        labels: classes 1..K that are sought.

    Attributes:
        ids: ids of the categories by the labels of the classes that are judged.
        pictures: annotation of each picture so far, by its id.
    """

    def __init__(self, classes: Sequence[str], labels: Sequence[int]) -> None:
        self.classes = classes
        self.ids: dict[int, Id] = {label: label for label in labels}
        self.pictures: dict[Id, Annotation] = {}

    @abstractmethod
    def image_of(self, name: str, size: tuple[int, int], file: Path | None) -> Id:
        """Find the id of a picture.

        Args:
            name: path of the picture.
            size: `(width, height)` in pixels.
            file: its file, if it has one.
        """

    def placed(self, image: Id, boxes: Tensor) -> Tensor:
        """Move boxes `(N, 4)` that were found in a picture to the frame in which this has its objects."""
        return boxes

    @abstractmethod
    def add(self, image: Id, size: tuple[int, int], findings: Mapping[str, list[Finding]]) -> None:
        """Add the annotation of a picture.

        Args:
            image: its id.
            size: `(width, height)` in pixels.
            findings: what each way has found in it.
        """

    @abstractmethod
    def annotations(self) -> Annotations:
        """Return the annotations of all pictures in the form of a file."""

    @property
    def objects(self) -> int:
        """Number of objects that can be found."""
        return sum(int((~annotation.crowd).sum()) for annotation in self.pictures.values())


class SlicesReference(Reference):
    """Reference from the detector itself: the objects that it finds in all slices."""

    def image_of(self, name: str, size: tuple[int, int], file: Path | None) -> Id:
        return len(self.pictures) + 1

    def add(self, image: Id, size: tuple[int, int], findings: Mapping[str, list[Finding]]) -> None:
        (finding,) = findings[ALL_SLICES]
        objects = finding.objects.above(finding.threshold)
        crowd = torch.zeros(len(objects), dtype=torch.bool)
        self.pictures[image] = Annotation(objects.boxes, objects.labels, crowd, size)

    def annotations(self) -> Annotations:
        objects: dict[Id, list[Entry]] = {}
        for image, annotation in self.pictures.items():
            scores = torch.ones(len(annotation.labels))
            rows = coco_results(image, annotation.boxes, annotation.labels, scores, self.ids)
            objects[image] = [{**row, "iscrowd": 0} for row in rows]
        images: dict[Id, Entry] = {image: {"file_name": str(image)} for image in self.pictures}
        categories: dict[Id, Entry] = {id_: {"name": self.classes[label - 1]} for label, id_ in self.ids.items()}
        return Annotations(images, categories, objects, "")


class AnnotatedReference(Reference):
    """Reference from an annotation file: its boxes, and its ids of pictures and categories.

    Args:
        classes: names of the detector's classes.
        labels: classes 1..K that are sought.
        truth: the annotations.
    """

    def __init__(self, classes: Sequence[str], labels: Sequence[int], truth: Truth) -> None:
        super().__init__(classes, labels)
        self.truth = truth
        sought = {canonical_name(classes[label - 1]): label for label in labels}
        categories = truth.categories([classes[label - 1] for label in labels])
        self.ids = {sought[name]: id_ for name, id_ in categories.items()}
        self._frames: dict[Id, tuple[tuple[int, int], int]] = {}  # sizes of upright pictures, and orientations of boxes

    def image_of(self, name: str, size: tuple[int, int], file: Path | None) -> Id:
        """Find the id of a picture; raises `DataError` where the file lacks it, or has it twice or in another size."""
        image = self.truth.image_id(name)
        check_data(image not in self.pictures, name, "a picture that was not named before", "it again")
        self._frames[image] = (size, self.truth.orientation(image, name, size, file))
        return image

    def placed(self, image: Id, boxes: Tensor) -> Tensor:
        size, orientation = self._frames[image]
        return stored_boxes(boxes, size, orientation)

    def add(self, image: Id, size: tuple[int, int], findings: Mapping[str, list[Finding]]) -> None:
        """Add the entries of the file, those of the classes that are sought, without boxes that have no area."""
        label_of_category = {category: label for label, category in self.ids.items()}
        sought = []
        for entry in self.truth.annotations.objects[image]:
            has_area = min(entry["bbox"][2:]) > 0
            if has_area and entry["category_id"] in label_of_category:
                sought.append(entry)
        self.pictures[image] = annotation_of(sought, label_of_category, self.truth.annotations.size(image) or size)

    def annotations(self) -> Annotations:
        return self.truth.annotations


class Scores:
    """What ways of looking find in pictures, beside a reference: annotations, or the objects that all slices list.

    Args:
        classes: names of the detector's classes.
        labels: classes 1..K that are sought; none for all.
        truth: the annotations; None takes what all slices list.

    Attributes:
        pictures: number of pictures so far.
    """

    def __init__(self, classes: Sequence[str], labels: Sequence[int], truth: Truth | None) -> None:
        self.classes = classes
        sought = [*labels] or [*range(1, len(classes) + 1)]
        self._reference: Reference = SlicesReference(classes, sought)
        if truth is not None:
            self._reference = AnnotatedReference(classes, sought, truth)
        self._found: dict[str, dict[Id, list[Finding]]] = defaultdict(dict)

    @property
    def pictures(self) -> int:
        """Number of pictures so far."""
        return len(self._reference.pictures)

    def image_of(self, name: str, size: tuple[int, int], file: Path | None) -> Id:
        """Find the id of a picture in the annotations; without these they are counted.

        Args:
            name: path of the picture.
            size: `(width, height)` in pixels.
            file: its file, if it has one.

        Returns:
            The id.

        Raises:
            DataError: the annotations lack it, or have it twice or in another size.
        """
        return self._reference.image_of(name, size, file)

    def add(self, image: Id, size: tuple[int, int], findings: Mapping[str, list[Finding]]) -> None:
        """Add a picture.

        Args:
            image: its id.
            size: `(width, height)` in pixels.
            findings: what each way has found in it.
        """
        self._reference.add(image, size, findings)
        for way, findings_of_way in findings.items():
            self._found[way][image] = findings_of_way

    def points(self) -> list[Point]:
        """List the results of each way of looking after each number of passes.

        Returns:
            The points, way by way in the order of their passes.
        """
        points = []
        annotations = self._reference.annotations()
        for way, found in self._found.items():
            for passes in _compared_passes(way, found.values()):
                # A picture in which a way ended before has the objects that it had then.
                found_by_then = {image: _after(passes, findings) for image, findings in found.items()}
                points.append(self._point(way, found_by_then, annotations))
        return points

    def _point(self, way: str, found: Mapping[Id, Finding], annotations: Annotations) -> Point:
        """Judge what was found in all pictures."""
        ids = self._reference.ids
        results: list[Entry] = []
        verdicts: list[int] = []
        for image, finding in found.items():
            sought = _of_classes(finding.objects, ids)
            objects = replace(sought, boxes=self._reference.placed(image, sought.boxes))
            rows = coco_results(image, objects.boxes, objects.labels, objects.scores, ids)
            results += [dict(row) for row in rows]
            verdicts += right_boxes(objects.above(finding.threshold), self._reference.pictures[image]).tolist()
        names = [self.classes[label - 1] for label in ids]
        precision = average_precision(annotations, results, images=[*found], classes=names)
        # Of each object that is listed 1 is right, 0 is wrong, and -1 is not judged.
        return Point(
            way,
            passes=fmean(finding.passes for finding in found.values()),
            seconds=fmean(finding.seconds for finding in found.values()),
            ap50=None if precision is None else precision[1],
            listed=verdicts.count(0) + verdicts.count(1),
            right=verdicts.count(1),
            reference=self._reference.objects,
        )


def _compared_passes(way: str, findings_of_pictures: Iterable[Sequence[Finding]]) -> list[int]:
    """List the numbers of passes after which a way is compared: those of `_AFTER`, and the last one."""
    findings = chain.from_iterable(findings_of_pictures)
    numbers = sorted({finding.passes for finding in findings})
    if way == ALL_SLICES:  # which are looked at together: fewer passes are those of smaller pictures
        return numbers[-1:]
    return [number for number in numbers if number in _AFTER or number == numbers[-1]]


def _after(passes: int, findings: Sequence[Finding]) -> Finding:
    """Take the last finding with at most so many passes, or the first one."""
    until_then = [finding for finding in findings if finding.passes <= passes]
    return until_then[-1] if until_then else findings[0]


def _of_classes(objects: Objects, labels: Iterable[int]) -> Objects:
    """Take the objects of classes that are judged."""
    is_judged = [label in labels for label in objects.labels.tolist()]
    return objects[torch.tensor(is_judged, dtype=torch.bool)]
