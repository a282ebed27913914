"""The poses of a head and the fixations of its eye, numbered as the actions of an episode."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.errors import check
from semfov.head.scenes import World, check_fields
from semfov.head.speeds import Speeds

_POINTS = 10  # number of cells in a row and in a column of a view, as the shipped models were fitted on


@dataclass(frozen=True)
class ShownCells:
    """The V cells of the scene that a view shows.

    Attributes:
        cells: `(V,)`, their numbers.
        points: `(V, 2)`, the pixels of the view at which it shows them.
        distances: `(cells, V)`, from the cells of the view, as fractions of its longer side.
    """

    cells: Tensor
    points: Tensor
    distances: Tensor


class Views:
    """The possible poses of a head and fixations of its eye, as one grid: `action = pose * 100 + cell`.

        pose 0   ┌────────┐  a strip of views, one below the other, of 10 × 10 cells each;
                 ├────────┤  an action is a cell of the strip
        pose 1   │   ×    │
                 ├────────┤

    The poses of the widest field of view are a lattice, which covers the scene. Those of narrower fields are closer
    looks at places (`aim`). Those that were offered and not taken give their numbers to others.

    Attributes:
        world: the scene.
        fields: fields of view in degrees, narrowest first.
        fovea: σ, radius of the fovea in longer sides of a view.
        lattice: number of poses of the lattice, which are the first ones.
        poses: `(P, 3)`.
        tiling: rows of numbers of poses that tile the scene.
        view_grid: cells of one view.
        cells: number of cells of a view.
        grid: cells of the strip.
        gaze: `(A, D)`, point of the scene that an action fixates.
        gaze_cell: `(A,)`, cell of the scene there.
        shown: for each pose, the cells of the scene that it shows.
    """

    def __init__(self, world: World, fields: Sequence[float] | None = None, *, fovea: float = 100 / 640) -> None:
        fields = world.fields if fields is None else check_fields(fields)
        check(fovea > 0, "fovea", "a positive fraction of the longer side", fovea)
        self.world = world
        self.fields = fields
        self.fovea = fovea
        rows = world.poses(fields[-1])
        self.poses = torch.stack([pose for row in rows for pose in row])
        self.lattice = len(self.poses)
        # Poses are half a view apart, so that every second pose of every second row tiles the scene.
        numbers = torch.arange(self.lattice).split([len(row) for row in rows])
        self.tiling = [numbers_of_row[::2].tolist() for numbers_of_row in numbers[::2]]
        width, height = world.size
        self.view_grid = Grid(_POINTS, _POINTS, (width, height))
        self.cells = _POINTS**2
        self.grid = self._strip()
        centres = self.view_grid.centres
        self.gaze = torch.cat([world.to_scene(centres, pose) for pose in self.poses])
        self.gaze_cell = world.scene.cell_of(world.pixels_of(self.gaze))
        # For each field of view, angles between the cells of a view, `(cells, cells)`.
        shifts = [world.shift(centres[:, None], centres[None], field) for field in fields]
        self._shifts = torch.stack(shifts)
        self._field_numbers = [len(fields) - 1] * self.lattice
        self.shown = [self._shown(pose, *world.to_view(world.centres, pose)) for pose in self.poses]

    def _strip(self) -> Grid:
        """Make the grid of the cells of all views."""
        width, height = self.world.size
        return Grid(_POINTS, _POINTS * len(self.poses), (width, height * len(self.poses)))

    def aim(self, point: Tensor, field: float, free: list[int] | None = None) -> int:
        """Aim a narrower field of view at a point of the scene; a pose that is new is added, or takes a free number.

        Args:
            point: `(D,)`.
            field: one of `fields`, narrower than the widest.
            free: numbers of poses that are not needed any more; the one that is taken is removed from the list.

        Returns:
            The action that fixates the point, as nearly as the limits of the head allow.
        """
        pose = self.world.aim(point, field)
        same_poses = (self.poses == pose).all(-1).nonzero()
        if len(same_poses):
            number = int(same_poses[0, 0])
            if free and number in free:
                free.remove(number)
        else:
            number = self.replace(free.pop(), pose) if free else self.add(pose)
        pixel, _ = self.world.to_view(point[None], pose)
        return number * self.cells + int(self.view_grid.cell_of(pixel))

    def add(self, pose: Tensor) -> int:
        """Add a pose of a narrower field of view.

        Args:
            pose: `(3,)`.

        Returns:
            Its number.
        """
        number = len(self.poses)
        # Room for what the view of the new pose shows, which `replace` writes.
        self.poses = F.pad(self.poses, (0, 0, 0, 1))
        self.gaze = F.pad(self.gaze, (0, 0, 0, self.cells))
        self.gaze_cell = F.pad(self.gaze_cell, (0, self.cells))
        self._field_numbers.append(0)
        self.shown.append(self.shown[0])
        self.grid = self._strip()
        return self.replace(number, pose)

    def replace(self, number: int, pose: Tensor) -> int:
        """Replace a pose that was never used by another pose, with the same number.

        Args:
            number: of the pose that is replaced.
            pose: `(3,)`.

        Returns:
            The number.
        """
        world = self.world
        actions = slice(number * self.cells, (number + 1) * self.cells)
        gaze = world.to_scene(self.view_grid.centres, pose)
        # Others may hold the tensors as they were.
        self.poses = self.poses.clone()
        self.gaze = self.gaze.clone()
        self.gaze_cell = self.gaze_cell.clone()
        self.poses[number] = pose
        self.gaze[actions] = gaze
        self.gaze_cell[actions] = world.scene.cell_of(world.pixels_of(gaze))
        self._field_numbers[number] = self.fields.index(self.field_of(pose))
        points, inside = world.to_view(world.centres, pose)
        # A narrow view may lie between the centres of cells. It shows the cell in its middle all the same.
        middle = int(self.gaze_cell[number * self.cells + self._middle_cell])
        if not bool(inside[middle]):
            inside[middle] = True
            points[middle] = self.view_grid.extent / 2 - 0.5
        self.shown[number] = self._shown(pose, points, inside)
        return number

    def _shown(self, pose: Tensor, points: Tensor, inside: Tensor) -> ShownCells:
        """Describe the cells of the scene that a pose `(3,)` shows.

        Args:
            pose: the pose.
            points: `(S, 2)`, the pixels of its view at which the middles of all cells lie.
            inside: `(S,)` boolean, which of them the view shows.
        """
        shown_points = points[inside]
        return ShownCells(inside.nonzero()[:, 0], shown_points, self._distances(pose, shown_points))

    def field_of(self, pose: Tensor) -> float:
        """Find the field of view of a pose, in full precision."""
        return min(self.fields, key=lambda field: abs(field - float(pose[2])))

    def __len__(self) -> int:
        """Count the poses."""
        return len(self.poses)

    @cached_property
    def ahead(self) -> int:
        """Action that fixates the middle of the view nearest to straight ahead."""
        numbers = [number for row in self.tiling for number in row]
        straight_ahead = torch.tensor([0.0, 0.0, self.fields[-1]]).expand(len(numbers), 3)
        turns = self.world.turn(self.poses[numbers], straight_ahead)
        nearest = numbers[int(turns.argmin())]
        return nearest * self.cells + self._middle_cell

    @property
    def _middle_cell(self) -> int:
        """Number of the cell right below and beside the middle of a view, whose cells are even in number."""
        return self.cells // 2 + _POINTS // 2

    @cached_property
    def reachable(self) -> Tensor:
        """Cells of the scene that the views that tile it show, `(S,)` boolean."""
        reachable = torch.zeros(len(self.world.scene), dtype=torch.bool)
        for row in self.tiling:
            for pose in row:
                reachable[self.shown[pose].cells] = True
        return reachable

    def spread(self, values: Tensor, pose: int) -> Tensor:
        """Interpolate values of a view's cells at the scene's cells that it shows.

        Args:
            values: `(C, cells)`.
            pose: number of the pose.

        Returns:
            `(C, V)`.
        """
        image = values.unflatten(-1, (_POINTS, _POINTS))[None]  # (1, C, rows, columns)
        shares = (self.shown[pose].points + 0.5) / self.view_grid.extent
        place = (2 * shares - 1)[None, None].to(values)  # (1, 1, V, 2), from -1 to 1, as `grid_sample` takes them
        return F.grid_sample(image, place, padding_mode="border", align_corners=False)[0, :, 0]

    def _distances(self, pose: Tensor, points: Tensor) -> Tensor:
        """Distance `(cells, V)` from each cell of a view to those seen; d in a view narrower by r is r (σ + d) - σ."""
        ratio = float(pose[2]) / self.fields[-1]  # r
        pixels = torch.cdist(self.view_grid.centres, points)
        distance = pixels / self.view_grid.extent.amax()
        return ratio * (self.fovea + distance) - self.fovea

    def acuity(self, distance: Tensor) -> Tensor:
        """Compute the relative acuity of the fovea, 1 / (1 + d / σ).

        It values cells that were never seen; those that were, `semfov.gaze.acquisition.closer_look.acuity` values.

        Args:
            distance: `(...)`, d; infinite for cells that were never seen.

        Returns:
            `(...)`, from 0 to 1; above 1 in a narrower field of view.
        """
        return 1 / (1 + distance / self.fovea)

    def turns(self, action: int) -> Tensor:
        """Compute by which angles the head turns from the pose of an action to all poses, `(P,)` in degrees."""
        pose = self.poses[action // self.cells]
        return self.world.turn(pose.expand_as(self.poses), self.poses)

    def durations(self, action: int, speeds: Speeds) -> Tensor:
        """Compute the time from one action to each other one, the look there included.

        Args:
            action: the present action.
            speeds: of eye and head.

        Returns:
            `(A,)` in seconds.
        """
        number, cell = divmod(action, self.cells)
        head = self.turns(action)
        fields = self.poses[:, 2]
        octaves = (fields / fields[number]).log2()
        # The angle of the saccade is measured in the field of view of the new pose.
        shifts_from_cell = self._shifts[:, cell]  # (fields, cells)
        eye = shifts_from_cell[torch.tensor(self._field_numbers)]  # (poses, cells)
        return speeds.duration(eye, head[:, None], octaves[:, None]).flatten()
