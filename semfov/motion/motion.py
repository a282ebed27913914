"""Maps between two frames of a stream: where points and boxes of one frame lie in the other."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from semfov.errors import check

_LEAST_AREA = 1e-6  # least factor by which a map may change areas: below it the frame is a line

_BEYOND = -1e6  # pixels where there is no frame

_STILL = np.eye(3)
_ROUNDING = 1e-9 + 1e-5 * _STILL  # by so much the matrix of a camera that stands still may differ from it

_OF_NUMPY = (torch.float32, torch.float64)  # which NumPy converts in a third of the time

# A point on the horizon has the weight 0: its place is infinite, which is no reason to warn.
_with_horizon = np.errstate(divide="ignore", invalid="ignore")


@dataclass(frozen=True, eq=False)
class Motion:
    r"""A projective map from the pixels of one frame to those of another, where the scene is flat or far away.

    .. math:: (x', y', w)^\top = M \, (x, y, 1)^\top, \qquad (x, y) \mapsto (x' / w, \; y' / w)

    A similarity (shift, rotation and scale) has the last row (0, 0, 1). Pixel centres are at integers.

    Attributes:
        matrix: M, `(3, 3)` float64.

    Raises:
        InputError: the matrix has another shape, is not finite, or flattens the frame.

    >>> motion = Motion.similarity(shift=(10, 0), scale=2.0)
    >>> motion.points(torch.tensor([[1.0, 2.0]]))
    tensor([[12.,  4.]])
    >>> motion.then(motion.inverse()).is_still
    True
    """

    matrix: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Copy the matrix as float64, and check it."""
        matrix = np.array(self.matrix, dtype=np.float64)
        expected = "a 3 × 3 matrix that maps a frame to a frame (np.vstack adds (0, 0, 1) to a 2 × 3 one)"
        check(matrix.shape == (3, 3), "motion", expected, f"shape {matrix.shape}")
        is_map = bool(np.isfinite(matrix).all()) and matrix[2, 2] != 0
        check(is_map, "motion", expected, matrix.tolist())
        # A matrix times any number is the same map, so areas are those of the matrix with 1 in its corner.
        object.__setattr__(self, "matrix", matrix / matrix[2, 2])
        check(bool(abs(self._determinant) > _LEAST_AREA), "motion", expected, matrix.tolist())

    @cached_property
    def _determinant(self) -> NDArray[np.float64]:
        """Determinant of the matrix, `()`: many places are mapped by one motion."""
        return np.asarray(np.linalg.det(self.matrix))

    @classmethod
    def still(cls) -> Self:
        """Make the motion of a camera that stands still."""
        return cls(_STILL)

    @classmethod
    def similarity(cls, *, shift: tuple[float, float] = (0, 0), turn: float = 0.0, scale: float = 1.0) -> Self:
        """Make a motion of a shift in pixels, a turn in degrees about the origin, and a scale.

        Args:
            shift: `(x, y)`, where the origin of the first frame lies in the second one.
            turn: degrees from the x axis towards the y axis, clockwise on a screen.
            scale: pixels of the second frame for one of the first.

        Returns:
            The motion.

        >>> Motion.similarity(turn=90).points(torch.tensor([[1.0, 0.0]])).round(decimals=6)
        tensor([[0., 1.]])
        """
        cosine = scale * math.cos(math.radians(turn))
        sine = scale * math.sin(math.radians(turn))
        return cls(np.array([[cosine, -sine, shift[0]], [sine, cosine, shift[1]], [0.0, 0.0, 1.0]]))

    @classmethod
    def of(cls, matrix: "Motion | ArrayLike") -> "Motion":
        """Make a motion from a matrix in OpenCV's form; a motion is returned unchanged.

        Args:
            matrix: a motion, or a `(3, 3)` or `(2, 3)` matrix.

        Returns:
            The motion.

        Raises:
            InputError: the matrix has another shape, is not finite, or flattens the frame.
        """
        if isinstance(matrix, Motion):
            return matrix
        values = np.asarray(matrix, dtype=np.float64)
        return cls(np.vstack([values, (0.0, 0.0, 1.0)]) if values.shape == (2, 3) else values)

    @property
    def is_still(self) -> bool:
        """Whether every point stays where it is, up to rounding."""
        return bool((np.abs(self.matrix - _STILL) <= _ROUNDING).all())

    def then(self, later: "Motion") -> "Motion":
        """Compose two motions: this one first, and a later one after it.

        Args:
            later: the map from the second frame to a third.

        Returns:
            The map from the first frame to the third.
        """
        return Motion(later.matrix @ self.matrix)

    def inverse(self) -> "Motion":
        """Invert the motion: the map from the second frame to the first."""
        return Motion.of(np.linalg.inv(self.matrix))

    @_with_horizon
    def points(self, points: Tensor) -> Tensor:
        """Map points.

        Args:
            points: `(..., 2)`, `(x, y)` in pixels of the first frame.

        Returns:
            `(..., 2)` in pixels of the second frame.
        """
        places = _values(points)
        mapped = places @ self.matrix[:, :2].T + self.matrix[:, 2]
        return torch.from_numpy(mapped[..., :2] / mapped[..., 2:]).to(points)

    def is_ahead(self, points: Tensor) -> Tensor:
        """Tell which points lie before the camera; a homography also maps points behind it to pixels.

        Args:
            points: `(..., 2)`, `(x, y)` in pixels of the first frame.

        Returns:
            `(...)` boolean.

        >>> quarter = Motion(np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.1]]))  # to the right
        >>> quarter.is_ahead(torch.tensor([[3.0, 0.0], [-3.0, 0.0]]))
        tensor([ True, False])
        """
        return torch.from_numpy(_are_ahead(self.matrix, self._determinant, self._weights(points)))

    def shows(self, boxes: Tensor) -> Tensor:
        """Tell which boxes have their centres before the camera (`is_ahead`); no motion brings the others back.

        Args:
            boxes: `(..., 4)`, `(x1, y1, x2, y2)` in pixels of the first frame.

        Returns:
            `(...)` boolean.

        >>> Motion.similarity(shift=(9000, 0)).shows(torch.tensor([[0.0, 0.0, 4.0, 2.0]]))
        tensor([True])
        """
        return self.is_ahead((boxes[..., :2] + boxes[..., 2:]) / 2)

    @_with_horizon
    def scale_at(self, points: Tensor) -> Tensor:
        """Compute the local scale: pixels of the second frame for one of the first, as the root of the areas' ratio.

        Args:
            points: `(..., 2)`, `(x, y)` in pixels of the first frame.

        Returns:
            `(...)`, positive.
        """
        return torch.from_numpy(_local_scales(self._determinant, self._weights(points))).to(points)

    def _weights(self, points: Tensor) -> NDArray[np.float64]:
        """Compute the weights w of points `(..., 2)`, `(...)`."""
        return _values(points) @ self.matrix[2, :2] + 1.0

    def boxes(self, boxes: Tensor) -> Tensor:
        """Map boxes (`moved_boxes`), without gradients.

        Args:
            boxes: `(..., 4)`, `(x1, y1, x2, y2)` in pixels of the first frame.

        Returns:
            `(..., 4)` in pixels of the second frame.
        """
        return self.boxes_ahead(boxes)[0]

    def boxes_ahead(self, boxes: Tensor) -> tuple[Tensor, Tensor]:
        """Map boxes (`boxes`), and tell which of them are before the camera (`shows`), in one go.

        Args:
            boxes: `(..., 4)`, `(x1, y1, x2, y2)` in pixels of the first frame.

        Returns:
            `(..., 4)` in pixels of the second frame, and `(...)` boolean.
        """
        moved = _moved_boxes(self.matrix, self._determinant, _values(boxes))
        return torch.from_numpy(moved.boxes).to(boxes), torch.from_numpy(moved.are_ahead)


def _values(tensor: Tensor) -> NDArray[np.float64]:
    """View numbers as an array: maps are so few numbers that PyTorch spends four times as long in calls."""
    values = tensor.detach().cpu()
    return np.asarray((values if values.dtype in _OF_NUMPY else values.double()).numpy(), np.float64)


def _local_scales(determinants: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute roots of the ratios of areas; the determinant of a map's derivative is det(M) / w³."""
    return np.asarray(np.sqrt(np.abs(determinants) / np.abs(weights) ** 3))


def _are_ahead(
    matrices: NDArray[np.float64], determinants: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Tell where the weights of maps have the sign of a place before the camera.

    A homography has no sign, but that of a camera that turns, or moves above a plane, has a positive determinant.
    Affine maps show all places.
    """
    is_affine = (matrices[..., 2, :2] == 0).all(-1)
    return np.asarray(is_affine | (weights * np.sign(determinants) > 0))


def moved_boxes(matrices: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    r"""Map boxes, each by a motion of its own: their centres move, and their sides are scaled; they stay upright.

    The local scale is the root of the ratio of areas at the centre c, the determinant of the map's derivative:

    .. math:: s(c) = \sqrt{|\det M| / |w(c)|^3}

    What is behind the camera becomes an empty box far beyond the frame, whose place is lost: what is kept from frame to
    frame is to be dropped there (`Motion.shows`).

    Args:
        matrices: `(..., 3, 3)`, of motions (`Motion.matrix`).
        boxes: `(..., 4)`, `(x1, y1, x2, y2)` in pixels of the first frames.

    Returns:
        The boxes in pixels of the second frames, and the scales `(...)`, pixels of these for one of the first.

    >>> matrix = torch.from_numpy(Motion.similarity(shift=(10, 0), scale=2.0).matrix)
    >>> moved_boxes(matrix, torch.tensor([0.0, 0.0, 4.0, 2.0]))
    (tensor([10.,  0., 18.,  4.]), tensor(2.))
    """
    maps = _values(matrices)
    moved = _moved_boxes(maps, np.linalg.det(maps), _values(boxes))
    return torch.from_numpy(moved.boxes).to(boxes), torch.from_numpy(moved.scales).to(boxes)


class _MovedBoxes(NamedTuple):
    """Boxes `(..., 4)` in another frame, the scales `(...)` there, and which are before the camera, `(...)`."""

    boxes: NDArray[np.float64]
    scales: NDArray[np.float64]
    are_ahead: NDArray[np.bool_]


@_with_horizon
def _moved_boxes(
    maps: NDArray[np.float64], determinants: NDArray[np.float64], boxes: NDArray[np.float64]
) -> _MovedBoxes:
    """Map boxes `(..., 4)` by matrices with these determinants, as `moved_boxes` does."""
    low = boxes[..., :2]
    high = boxes[..., 2:]
    centres = (low + high) / 2
    mapped = (maps[..., :2] @ centres[..., None])[..., 0] + maps[..., 2]
    weights = mapped[..., 2]
    scales = _local_scales(determinants, weights)
    are_ahead = _are_ahead(maps, determinants, weights)
    is_ahead = are_ahead[..., None]
    moved_centres = np.where(is_ahead, mapped[..., :2] / weights[..., None], _BEYOND)
    half_sizes = np.where(is_ahead, (high - low) / 2 * scales[..., None], 0.0)
    corners = np.concatenate([moved_centres - half_sizes, moved_centres + half_sizes], -1)
    return _MovedBoxes(corners, scales, are_ahead)
