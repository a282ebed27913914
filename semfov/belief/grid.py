"""The grid of cells over an image: centres, cells that a box covers, and distances to the fixation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from semfov.data.inputs import as_positions
from semfov.errors import check, check_finite, check_shape, check_whole, lookup
from semfov.sensor.constants import constant

Footprint = Literal["overlap", "centre", "box_centre", "soft"]


class _Layout(NamedTuple):
    """Places of the cells, with the dtype and device of what they are compared with.

    The first five are about the lines of cells: first the X columns, then the Y rows.

    Attributes:
        axis: 0 for columns and 1 for rows, `(X+Y,)`.
        start: where each line begins along its axis, `(X+Y,)`, in the coordinates of boxes.
        end: where it ends.
        middle: its middle.
        half: half its width.
        centres: centres of the cells as points, `(X·Y, 2)`.
        cell: width and height of a cell, `(2,)`.
        longest: longer side of the image, `()`.
    """

    axis: Tensor
    start: Tensor
    end: Tensor
    middle: Tensor
    half: Tensor
    centres: Tensor
    cell: Tensor
    longest: Tensor

    def to(self, dtype: torch.dtype, device: torch.device) -> "_Layout":
        """Convert the numbers, and move them with the indices to a device."""
        _, *numbers = self
        return _Layout(self.axis.to(device), *(values.to(device, dtype) for values in numbers))


class _Sides(NamedTuple):
    """Sides of boxes beside lines of cells, along the axis of each line: first the X columns, then the Y rows.

    A box and a cell relate along both axes, so both are computed at once, `(..., L, X+Y)`.

    Attributes:
        lower: lower side of each box.
        upper: its upper side.
        start: where each line begins.
        end: where it ends.
        middle: its middle.
        half: half its width.
    """

    lower: Tensor
    upper: Tensor
    start: Tensor
    end: Tensor
    middle: Tensor
    half: Tensor

    def overlap(self) -> Tensor:
        """Tell which lines share a positive length with which boxes."""
        return (self.start < self.upper) & (self.end > self.lower) & (self.upper > self.lower)

    def holds_middle(self) -> Tensor:
        """Tell which boxes hold the middle of which lines."""
        return (self.middle >= self.lower) & (self.middle < self.upper)

    def log_weight(self) -> Tensor:
        """Compute the part of one axis in ln w, `-x² / (2 (a² + u²) / 3)`, of the rule `soft`."""
        centre = (self.lower + self.upper) / 2
        half_box = (self.upper - self.lower) / 2
        offset = (self.middle - centre) / torch.hypot(half_box, self.half)
        return -1.5 * offset.square()


@dataclass(frozen=True)
class Grid:
    """`columns` × `rows` equal cells over an image, numbered row by row: `cell = row * columns + column`.

    For points, pixel centres are at integers. For boxes, coordinates count from the left and top edge of the image, as
    in COCO. A point `p` is therefore at `p + 0.5` in the coordinates of boxes.

    Args:
        columns: X, number of cells in a row.
        rows: Y, number of cells in a column.
        size: `(width, height)` of one image in pixels, or a tensor `(B, 2)` with one row for each image of a batch.

    Raises:
        InputError: a number of cells is not whole, one is not positive or not finite, or the shape of `size` is wrong.

    >>> grid = Grid(4, 2, (640, 480))
    >>> grid.centres[5]
    tensor([239.5000, 359.5000])
    """

    columns: int
    rows: int
    size: tuple[float, float] | Tensor

    def __post_init__(self) -> None:
        numbers = (self.columns, self.rows)
        are_whole = all(isinstance(number, Integral) and number >= 1 for number in numbers)
        check(are_whole, "columns, rows", "whole numbers from 1", numbers)
        size = torch.as_tensor(self.size)
        check_shape(size, "size", 2)
        is_area = (size > 0) & (size < float("inf"))
        check(bool(is_area.all()), "size", "a positive width and height", self.size)

    def __len__(self) -> int:
        """Count the cells, X·Y."""
        return self.columns * self.rows

    @property
    def extent(self) -> Tensor:
        """`(width, height)` as a floating-point tensor, `(2,)` or `(B, 2)`."""
        size = torch.as_tensor(self.size)
        return as_positions(size) if size.is_floating_point() else size.to(torch.get_default_dtype())

    @property
    def centres(self) -> Tensor:
        """Centre of every cell as a point, `(X·Y, 2)` or `(B, X·Y, 2)`."""
        return self._layout().centres.clone()

    @property
    def edges(self) -> Tensor:
        """Box `(x1, y1, x2, y2)` of every cell, `(X·Y, 4)` or `(B, X·Y, 4)`."""
        layout = self._layout()
        middle = layout.centres + 0.5
        half = layout.cell[..., None, :] / 2
        return torch.cat([middle - half, middle + half], -1)

    def _layout(self, like: Tensor | None = None) -> _Layout:
        """Lay out the cells, once for a size in numbers.

        Args:
            like: a tensor, whose dtype and device the layout takes; None takes those of the size.

        Returns:
            The layout.
        """
        if isinstance(self.size, Tensor):
            layout = _layout(self.columns, self.rows, self.extent)
            return layout if like is None else layout.to(like.dtype, like.device)
        default = torch.get_default_dtype()
        dtype = default if like is None else like.dtype
        device = torch.device("cpu") if like is None else like.device
        return _layout_of_size(self.columns, self.rows, *self.size, default, dtype, device)

    def cell_of(self, points: Tensor) -> Tensor:
        """Find the cell that holds each point; for a point outside the image, the nearest cell.

        Args:
            points: `(..., 2)`, as `(x, y)` in pixels; `(B, ..., 2)` for a batch of sizes.

        Returns:
            `(...)` int64, cell numbers.

        Raises:
            InputError: a coordinate is not finite, or the shape is wrong.

        >>> Grid(4, 2, (640, 480)).cell_of(torch.tensor([[0.0, 0.0], [200.0, 300.0]]))
        tensor([0, 5])
        """
        check_shape(points, "points", 2)
        check_finite(points, "points")
        points = as_positions(points)
        cell = self._layout(points).cell
        if cell.ndim > 1:
            cell = cell.reshape(cell.shape[0], *[1] * (points.ndim - cell.ndim), 2)
        place = ((points + 0.5) / cell.to(points)).floor()
        column = place[..., 0].clamp(0, self.columns - 1).long()
        row = place[..., 1].clamp(0, self.rows - 1).long()
        return row * self.columns + column

    def footprint(self, boxes: Tensor, rule: Footprint = "overlap") -> Tensor:
        r"""Find the cells that each box covers.

        - `overlap`: cells that share a positive area with the box. Luzio, Bernardino and Moreno (2024, section IV-A)
          update the cells that a detection overlaps; the other rules are not theirs.
        - `centre`: cells whose centre lies in the box; if there are none, the cell that holds the centre of the box.
        - `box_centre`: only the cell that holds the centre of the box.
        - `soft`: cells that share a positive area with the box, with weights that fall off towards its borders,
          because objects rarely fill the corners of their boxes. For a box of half sizes (a, b), a cell of half sizes
          (u, v) and the offset (x, y) between their centres,

          .. math:: w = \exp\left(-\frac{x^2}{2 (a^2 + u^2)/3} - \frac{y^2}{2 (b^2 + v^2)/3}\right),

          a normal window with the variance of a uniform box blurred by the cell.

        Args:
            boxes: `(..., L, 4)`, as `(x1, y1, x2, y2)` in pixels; `(B, L, 4)` for a batch of sizes. A box without area
                covers no cell.
            rule: `overlap`, `centre`, `box_centre` or `soft`.

        Returns:
            `(..., L, X·Y)`, boolean; weights in [0, 1] for `soft`.

        Raises:
            InputError: a coordinate is not finite, the shape is wrong, or the rule is unknown.

        >>> Grid(2, 1, (10, 10)).footprint(torch.tensor([[1.0, 1.0, 5.0, 5.0], [4.0, 0.0, 6.0, 2.0]]))
        tensor([[ True, False],
                [ True,  True]])
        """
        check_shape(boxes, "boxes", None, 4)
        check_finite(boxes, "boxes")
        lookup(rule, get_args(Footprint), "footprint rule")
        boxes = as_positions(boxes)
        sides = self._sides(boxes)
        if rule == "overlap":
            return self._in_cells(sides.overlap(), torch.logical_and)
        if rule == "soft":
            shared = self._in_cells(sides.overlap(), torch.logical_and)
            return self._in_cells(sides.log_weight(), torch.add).exp() * shared
        central_cell = self.cell_of(box_centres(boxes))
        covered = central_cell[..., None] == torch.arange(len(self), device=boxes.device)
        if rule == "centre":
            inside = self._in_cells(sides.holds_middle(), torch.logical_and)
            covered = inside | (covered & ~inside.any(-1, keepdim=True))
        # A box without area has a centre, too, which lies in a cell.
        has_area = self._in_cells(sides.upper > sides.lower, torch.logical_and)
        return covered & has_area

    def _sides(self, boxes: Tensor) -> "_Sides":
        """Put the sides of boxes `(..., L, 4)` beside the lines of cells."""
        layout = self._layout(boxes)
        lines = (layout.start, layout.end, layout.middle, layout.half)
        start, end, middle, half = (line if line.ndim == 1 else line[:, None] for line in lines)
        lower = boxes.index_select(-1, layout.axis)
        upper = boxes.index_select(-1, layout.axis + 2)
        return _Sides(lower, upper, start, end, middle, half)

    def _in_cells(self, lines: Tensor, join: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Join the values of the columns and rows `(..., X+Y)` in every cell, `(..., X·Y)`."""
        columns, rows = lines.split([self.columns, self.rows], -1)
        return join(columns[..., None, :], rows[..., :, None]).flatten(-2)  # row by row

    def box_distance(self, boxes: Tensor, fixation: Tensor) -> Tensor:
        """Measure the distance from the centre of each box to the fixation.

        This is d = ‖(u, v)‖ of Luzio, Bernardino and Moreno (2024, section III-D), here in units of the image's longer
        side, so that one observation model serves every resolution.

        Args:
            boxes: `(..., L, 4)`, as `(x1, y1, x2, y2)` in pixels.
            fixation: `(..., 2)`, as `(x, y)` in pixels.

        Returns:
            `(..., L)`, in units of the image's longer side.

        Raises:
            InputError: a coordinate is not finite, or a shape is wrong.

        >>> Grid(2, 1, (10, 10)).box_distance(torch.tensor([[4.0, 4.0, 6.0, 6.0]]), torch.tensor([4.5, 9.5]))
        tensor([0.5000])
        """
        check_shape(boxes, "boxes", None, 4)
        check_shape(fixation, "fixation", 2)
        check_finite(boxes, "boxes")
        check_finite(fixation, "fixation")
        boxes = as_positions(boxes)
        fixation = as_positions(fixation)
        offset = torch.linalg.vector_norm(box_centres(boxes) - fixation[..., None, :], dim=-1)
        return offset / self._layout(offset).longest[..., None]

    def distance(self, fixation: Tensor) -> Tensor:
        """Measure the distance from each fixation to the centre of every cell.

        Args:
            fixation: `(..., 2)`, as `(x, y)` in pixels; `(B, 2)` for a batch of sizes.

        Returns:
            `(..., X·Y)`, in units of the image's longer side.

        Raises:
            InputError: the shape is wrong.

        >>> Grid(2, 1, (10, 10)).distance(torch.tensor([2.0, 4.5]))
        tensor([0.0000, 0.5000])
        """
        check_shape(fixation, "fixation", 2)
        fixation = as_positions(fixation)
        layout = self._layout(fixation)
        offset = layout.centres - fixation[..., None, :]
        return torch.linalg.vector_norm(offset, dim=-1) / layout.longest[..., None]

    @property
    def cell_distance(self) -> Tensor:
        """Distance between the centres of each pair of cells, in longer sides: `(X·Y, X·Y)` or `(B, X·Y, X·Y)`.

        Luzio, Bernardino and Moreno (2024, equation 16) predict scores at this distance d' = ‖x − f'‖.
        """
        if self.extent.ndim == 1:
            return self.distance(self.centres)
        offset = self.centres[..., :, None, :] - self.centres[..., None, :, :]  # (B, X·Y, X·Y, 2)
        longer_side = self.extent.amax(-1)[..., None, None]
        return torch.linalg.vector_norm(offset, dim=-1) / longer_side


def box_centres(boxes: Tensor) -> Tensor:
    """Compute the centres of boxes `(..., 4)` as points `(..., 2)`, half a pixel before the coordinates of boxes."""
    return (boxes[..., :2] + boxes[..., 2:]) / 2 - 0.5


def _layout(columns: int, rows: int, extent: Tensor) -> _Layout:
    """Lay out the cells over images.

    Args:
        columns: X, cells in a row.
        rows: Y, cells in a column.
        extent: `(width, height)` of the images, `(2,)` or `(B, 2)`.

    Returns:
        The layout; its tensors have a leading B for a batch of sizes, all but the axis.
    """
    device = extent.device
    # All columns, and then all rows, `(X+Y,)`: axis 0 or 1, and number along it.
    axis = torch.cat([torch.full((columns,), 0, device=device), torch.full((rows,), 1, device=device)])
    place = torch.cat([torch.arange(columns, device=device), torch.arange(rows, device=device)])
    cell = extent / extent.new_tensor((columns, rows))  # (..., 2)
    step = cell.index_select(-1, axis)  # (..., X+Y)
    middle = (place + 0.5) * step - 0.5
    x = middle[..., None, :columns]
    y = middle[..., columns:, None]
    centres = torch.stack(torch.broadcast_tensors(x, y), -1).flatten(-3, -2)
    return _Layout(
        axis=axis,
        start=place * step,
        end=(place + 1) * step,
        middle=middle + 0.5,
        half=step / 2,
        centres=centres,
        cell=cell,
        longest=extent.amax(-1),
    )


@constant
def _layout_of_size(
    columns: int,
    rows: int,
    width: float,
    height: float,
    exact: torch.dtype,
    dtype: torch.dtype,
    device: torch.device,
) -> _Layout:
    """Lay out the cells over an image of one size, with numbers of the dtype `exact`, then converted to `dtype`."""
    # Half precision cannot hold every number of pixels above 2048.
    extent = torch.tensor([width, height], dtype=torch.promote_types(exact, torch.float32))
    return _layout(columns, rows, extent).to(dtype, device)


def check_cells(grid: tuple[int, int]) -> None:
    """Raise `InputError` unless this is `(columns, rows)`, whole numbers from 1 to 200."""
    check(isinstance(grid, Sequence) and len(grid) == 2, "grid", "(columns, rows)", grid)
    for side in grid:
        check_whole(side, "grid", 1, 200)
