"""Scenes: an image with the boxes of its objects, and what every set of scenes offers."""

from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from semfov.errors import check, check_shape

Coverage = Literal["sum", "union"]


@dataclass(frozen=True)
class Annotation:
    """The objects of a scene, without its pixels.

    Attributes:
        boxes: `(M, 4)` float32, `(x1, y1, x2, y2)`: pixel edges, 0 is the left (top) border of the image.
        labels: `(M,)` int64, 1..K, indices into the detector's classes.
        crowd: `(M,)` bool, true where a box frames a group of objects (COCO's `iscrowd`).
        size: `(width, height)` of the image in pixels.
    """

    boxes: Tensor
    labels: Tensor
    crowd: Tensor
    size: tuple[int, int]


@dataclass(frozen=True)
class Scene:
    """An image and its objects.

    Attributes:
        id: unique in its set, and sortable.
        name: what people call it: a file name, or the title of an embedded scene.
        image: `(3, H, W)` float32, RGB in [0, 1].
        boxes: `(M, 4)` float32, `(x1, y1, x2, y2)`: pixel edges, 0 is the left (top) border of the image.
        labels: `(M,)` int64, 1..K, indices into the detector's classes.
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


class Scenes(Protocol):
    """A set of scenes in ascending order of their ids; only `__getitem__` decodes images."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes 1..K, the detector's own."""

    @property
    def ids(self) -> list[int] | list[str]:
        """Ids of the scenes, ascending."""

    @property
    def fingerprint(self) -> str:
        """sha256 of what the scenes depend on, for the keys of caches and for manifests."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Scene: ...

    def digest(self, index: int) -> str:
        """sha256 of what the pixels of a scene depend on, without decoding them; the key of a scene in caches."""

    def annotation(self, index: int) -> Annotation:
        """The objects of a scene, without decoding its image."""

    def targets(self, index: int) -> list[int]:
        """Classes of a scene that may be searched for, ascending."""


def box_coverage(boxes: Tensor, size: tuple[int, int], coverage: Coverage = "sum") -> float:
    """Share of the image that boxes cover.

    - `sum`: Σ_i area(b_i) / (W·H), what overlaps counted again, so it may exceed 1
    - `union`: area(∪_i b_i) / (W·H), exact (the boxes' edges cut the plane into rectangles, each covered or not)

    Args:
        boxes: `(M, 4)`, `(x1, y1, x2, y2)`, inside the image.
        size: `(width, height)` of the image.

    >>> boxes = torch.tensor([[0.0, 0.0, 2.0, 2.0], [1.0, 1.0, 3.0, 3.0]])
    >>> box_coverage(boxes, (4, 4)), box_coverage(boxes, (4, 4), "union")
    (0.5, 0.4375)
    """
    check_shape(boxes, "boxes", None, 4)
    check(coverage in ("sum", "union"), "coverage", "'sum' or 'union'", repr(coverage))
    if boxes.shape[0] == 0:
        return 0.0
    x1, y1, x2, y2 = boxes.double().unbind(-1)
    if coverage == "sum":
        area = ((x2 - x1) * (y2 - y1)).sum()
    else:
        xs, ys = torch.cat([x1, x2]).unique(), torch.cat([y1, y2]).unique()
        columns = (x1[:, None] <= xs[:-1]) & (xs[1:] <= x2[:, None])
        rows = (y1[:, None] <= ys[:-1]) & (ys[1:] <= y2[:, None])
        covered = (rows.double().T @ columns.double() > 0).double()
        area = ys.diff() @ covered @ xs.diff()
    return float(area) / (size[0] * size[1])


def legal_targets(annotation: Annotation, max_area: float | None = 0.2, coverage: Coverage = "sum") -> list[int]:
    """Classes that are present and whose boxes cover at most `max_area` of the image (None: any share), ascending.

    >>> boxes = torch.tensor([[0.0, 0.0, 5.0, 5.0], [0.0, 0.0, 10.0, 5.0]])
    >>> scene = Annotation(boxes, torch.tensor([3, 1]), torch.zeros(2, dtype=torch.bool), (10, 10))
    >>> legal_targets(scene, max_area=0.3)
    [3]
    """
    present: list[int] = annotation.labels.unique().tolist()
    if max_area is None:
        return present
    boxes, labels, size = annotation.boxes, annotation.labels, annotation.size
    return [label for label in present if box_coverage(boxes[labels == label], size, coverage) <= max_area]
