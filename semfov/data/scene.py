"""Scenes (images with the boxes of their objects), the interface of their sets, and composed and chosen sets."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from semfov.errors import check, check_shape

Coverage = Literal["sum", "union"]
"""How the fraction that boxes cover is measured (`box_coverage`)."""


@dataclass(frozen=True)
class Annotation:
    """The objects of a scene, without its pixels.

    Attributes:
        boxes: `(M, 4)` float32, `(x1, y1, x2, y2)`, pixel edges; 0 is the left (top) border of the image.
        labels: `(M,)` int64, class indices 1..K in the detector's order.
        crowd: `(M,)` bool, true where a box frames a group of objects (COCO's `iscrowd`).
        size: `(width, height)` of the image in pixels.

    >>> boxes, labels = torch.tensor([[0.0, 0.0, 50.0, 40.0]]), torch.tensor([1])
    >>> Annotation(boxes, labels, torch.tensor([False]), (640, 480)).size
    (640, 480)
    """

    boxes: Tensor
    labels: Tensor
    crowd: Tensor
    size: tuple[int, int]

    def take(self, rows: Tensor) -> "Annotation":
        """Select objects by index.

        Args:
            rows: their numbers, or a boolean `(M,)`.

        Returns:
            The objects, in the order of the rows.
        """
        return Annotation(self.boxes[rows], self.labels[rows], self.crowd[rows], self.size)


@dataclass(frozen=True)
class Scene:
    """An image and its objects.

    Attributes:
        id: identifier, unique in its set.
        name: name for people: a file name, or the title of an embedded scene.
        image: `(3, H, W)` float32, RGB in [0, 1].
        boxes: `(M, 4)` float32, `(x1, y1, x2, y2)`, pixel edges; 0 is the left (top) border of the image.
        labels: `(M,)` int64, class indices 1..K in the detector's order.

    >>> boxes, labels = torch.tensor([[0.0, 0.0, 50.0, 40.0]]), torch.tensor([1])
    >>> Scene(7, "000000000007.jpg", torch.rand(3, 480, 640), boxes, labels).size
    (640, 480)
    """

    id: int | str
    name: str
    image: Tensor
    boxes: Tensor
    labels: Tensor

    @property
    def size(self) -> tuple[int, int]:
        """`(width, height)` in pixels."""
        return self.image.shape[-1], self.image.shape[-2]


class Scenes(ABC):
    """Base of sets of scenes, in ascending order of their ids; only `__getitem__` decodes images.

    Attributes:
        classes: names of the detector's classes 1..K.
        ids: ids of the scenes, ascending.
        fingerprint: sha256 of everything that the scenes depend on, for the keys of caches and for manifests.

    >>> from semfov.data import EmbeddedScenes
    >>> scenes: Scenes = EmbeddedScenes(("person", "cat"), count=2)
    >>> len(scenes), scenes.classes, scenes.annotation(0).size
    (2, ('person', 'cat'), (640, 499))
    """

    classes: tuple[str, ...]
    ids: list[int] | list[str]
    fingerprint: str

    def __len__(self) -> int:
        return len(self.ids)

    @abstractmethod
    def __getitem__(self, index: int) -> Scene:
        """Decode a scene."""

    @abstractmethod
    def digest(self, index: int) -> str:
        """Compute a sha256 of everything that the pixels of a scene depend on, the key of a scene in caches.

        Args:
            index: position of the scene in the set.

        Returns:
            64 hexadecimal digits.
        """

    @abstractmethod
    def annotation(self, index: int) -> Annotation:
        """Return the objects of a scene, without decoding its image.

        Args:
            index: position of the scene in the set.

        Returns:
            The objects.
        """

    def targets(self, index: int) -> list[int]:
        """List the classes of a scene that may be searched for: those that cover at most a fifth of it.

        Args:
            index: position of the scene in the set.

        Returns:
            Class indices 1..K, ascending.
        """
        return legal_targets(self.annotation(index))


def box_coverage(boxes: Tensor, size: tuple[int, int], coverage: Coverage = "sum") -> float:
    """Compute the fraction of the image that boxes cover.

    - `sum`: Σ_i area(b_i) / (W·H). Overlaps count several times, so it may exceed 1.
    - `union`: area(∪_i b_i) / (W·H), exact. (The boxes' edges cut the plane into rectangles, each of which is covered
      or not.)

    Args:
        boxes: `(M, 4)`, `(x1, y1, x2, y2)`, inside the image.
        size: `(width, height)` of the image.
        coverage: `sum` or `union`.

    Returns:
        The fraction.

    >>> boxes = torch.tensor([[0.0, 0.0, 2.0, 2.0], [1.0, 1.0, 3.0, 3.0]])
    >>> box_coverage(boxes, (4, 4)), box_coverage(boxes, (4, 4), "union")
    (0.5, 0.4375)
    """
    check_shape(boxes, "boxes", None, 4)
    check(coverage in ("sum", "union"), "coverage", "'sum' or 'union'", repr(coverage))
    if boxes.shape[0] == 0:
        return 0.0
    x1, y1, x2, y2 = boxes.double().unbind(-1)
    areas = (x2 - x1) * (y2 - y1)
    covered = areas.sum() if coverage == "sum" else _union_area(x1, y1, x2, y2)
    width, height = size
    return float(covered) / (width * height)


def _union_area(x1: Tensor, y1: Tensor, x2: Tensor, y2: Tensor) -> Tensor:
    """Compute the area that boxes cover together, by the rectangles between all their edges.

    Args:
        x1: left edges, `(N,)`.
        y1: upper edges, `(N,)`.
        x2: right edges, `(N,)`.
        y2: lower edges, `(N,)`.

    Returns:
        `()`.
    """
    xs = torch.cat([x1, x2]).unique()
    ys = torch.cat([y1, y2]).unique()
    # Which of the columns and of the rows between these edges each box covers.
    starts_before_column = x1[:, None] <= xs[:-1]
    ends_after_column = xs[1:] <= x2[:, None]
    starts_before_row = y1[:, None] <= ys[:-1]
    ends_after_row = ys[1:] <= y2[:, None]
    columns = (starts_before_column & ends_after_column).double()
    rows = (starts_before_row & ends_after_row).double()
    boxes_over = rows.T @ columns  # how many boxes cover each rectangle
    is_covered = (boxes_over > 0).double()
    return ys.diff() @ is_covered @ xs.diff()


def boxes_meet(box: Sequence[float], other: Sequence[float]) -> bool:
    """Tell whether two boxes `(x1, y1, x2, y2)` have an area in common."""
    x1, y1, x2, y2 = box
    left, top, right, bottom = other
    return x1 < right and left < x2 and y1 < bottom and top < y2


def legal_targets(annotation: Annotation, max_area: float | None = 0.2, coverage: Coverage = "sum") -> list[int]:
    """List the classes that are present and whose boxes cover at most a given fraction of the image.

    Args:
        annotation: the objects of a scene.
        max_area: largest fraction of the image that the boxes of a class may cover; None allows any.
        coverage: how the fraction is measured, `sum` or `union` (see `box_coverage`).

    Returns:
        Class indices 1..K, ascending.

    >>> boxes = torch.tensor([[0.0, 0.0, 5.0, 5.0], [0.0, 0.0, 10.0, 5.0]])
    >>> scene = Annotation(boxes, torch.tensor([3, 1]), torch.zeros(2, dtype=torch.bool), (10, 10))
    >>> legal_targets(scene, max_area=0.3)
    [3]
    """
    present: list[int] = annotation.labels.unique().tolist()
    if max_area is None:
        return present
    targets = []
    for label in present:
        boxes = annotation.boxes[annotation.labels == label]
        if box_coverage(boxes, annotation.size, coverage) <= max_area:
            targets.append(label)
    return targets


class ComposedScenes(Scenes):
    """Base of sets whose scenes are composed by a seed: a scene depends only on the seed and on its number."""

    ids: list[int]

    def __init__(self, classes: tuple[str, ...], count: int, seed: int) -> None:
        check(count >= 1, "count", "at least 1", count)
        check(seed >= 0, "seed", "at least 0", seed)
        self.classes = classes
        self._seed = seed
        self.ids = list(range(count))

    def _generator(self, index: int, *part: int) -> "np.random.Generator":
        """Make the random numbers of a scene, or of a part of it."""
        return np.random.Generator(np.random.PCG64([self._seed, self.ids[index], *part]))

    def _scene(self, index: int, kind: str, image: Tensor) -> Scene:
        """Join a composed image and its objects to a scene, named after its kind."""
        annotation = self.annotation(index)
        number = self.ids[index]
        return Scene(number, f"{kind} {number}, seed {self._seed}", image, annotation.boxes, annotation.labels)


class ChosenScenes(Scenes):
    """Scenes that are chosen from one or more sets of the same classes.

    Args:
        chosen: the set of each scene, and its position there.
        ids: ids of the scenes here.
        fingerprint: of the choice.
    """

    def __init__(self, chosen: Sequence[tuple[Scenes, int]], ids: list[int] | list[str], fingerprint: str) -> None:
        self._chosen = chosen
        self.classes = chosen[0][0].classes
        self.ids = ids
        self.fingerprint = fingerprint

    def __getitem__(self, index: int) -> Scene:
        """Decode a scene."""
        scenes, position = self._chosen[index]
        return scenes[position]

    def annotation(self, index: int) -> Annotation:
        """Return the objects of a scene, without decoding its image."""
        scenes, position = self._chosen[index]
        return scenes.annotation(position)

    def targets(self, index: int) -> list[int]:
        """List the classes of a scene that may be searched for."""
        scenes, position = self._chosen[index]
        return scenes.targets(position)

    def digest(self, index: int) -> str:
        """Compute a sha256 of everything that the pixels of a scene depend on."""
        scenes, position = self._chosen[index]
        return scenes.digest(position)
