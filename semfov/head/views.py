"""All poses of a head and all fixations of its eye, numbered as the actions of an episode."""

from collections.abc import Sequence
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.errors import check
from semfov.head.scenes import World, check_fields
from semfov.head.speeds import Speeds

_POINTS = 10  # number of cells in a row and in a column of a view, as the shipped evidence was learned on


class Views:
    """The possible poses of a head and fixations of its eye, as one grid: `action = pose * 100 + cell`.

        pose 0   ┌────────┐  a strip of views, one below the other, of 10 × 10 cells each;
                 ├────────┤  an action is a cell of the strip
        pose 1   │   ×    │
                 ├────────┤

    Attributes:
        world: the scene.
        fields: fields of view in degrees.
        fovea: σ, radius of the fovea in longer sides of a view.
        poses: `(P, 3)`.
        tiling: for each field of view, rows of numbers of poses that tile the scene.
        view_grid: cells of one view.
        cells: number of cells of a view.
        grid: cells of the strip.
        gaze: `(A, D)`, point of the scene that an action fixates.
        gaze_cell: `(A,)`, cell of the scene there.
        visible: for each pose, the cells of the scene that it shows, `(V,)`.
        points: for each pose, the pixels of the view at which it shows them, `(V, 2)`.
    """

    def __init__(self, world: World, fields: Sequence[float] | None = None, *, fovea: float = 100 / 640) -> None:
        fields = world.fields if fields is None else check_fields(fields)
        check(fovea > 0, "fovea", "a positive fraction of the longer side", fovea)
        self.world = world
        self.fields = fields
        self.fovea = fovea
        poses: list[Tensor] = []
        self.tiling: list[list[list[int]]] = []
        for field in fields:
            numbers = []
            for row in world.poses(field):
                numbers.append([*range(len(poses), len(poses) + len(row))])
                poses += row
            self.tiling.append([row[::2] for row in numbers[::2]])
        self.poses = torch.stack(poses)
        width, height = world.size
        self.view_grid = Grid(_POINTS, _POINTS, (width, height))
        self.cells = _POINTS**2
        self.grid = Grid(_POINTS, _POINTS * len(poses), (width, height * len(poses)))
        self.gaze = torch.cat([world.to_scene(self.view_grid.centres, pose) for pose in self.poses])
        self.gaze_cell = world.scene.cell_of(world.pixels_of(self.gaze))
        centres = self.view_grid.centres
        # For each field of view, angles between the cells of a view, `(cells, cells)`.
        self._shifts = [world.shift(centres[:, None], centres[None], field) for field in fields]
        self.visible: list[Tensor] = []
        self.points: list[Tensor] = []
        for pose in self.poses:
            points, inside = world.to_view(world.centres, pose)
            self.visible.append(inside.nonzero()[:, 0])
            self.points.append(points[inside])

    def __len__(self) -> int:
        """Count the poses."""
        return len(self.poses)

    @cached_property
    def ahead(self) -> int:
        """Action in the middle of the view nearest to straight ahead, of those that tile the scene."""
        poses = [pose for row in self.tiling[0] for pose in row]
        middle = torch.tensor([0.0, 0.0, self.fields[0]]).expand(len(poses), 3)
        nearest = poses[int(self.world.turn(self.poses[poses], middle).argmin())]
        return nearest * self.cells + self.cells // 2 + _POINTS // 2

    @cached_property
    def reachable(self) -> Tensor:
        """Cells of the scene that at least one view shows, `(S,)` boolean."""
        reachable = torch.zeros(len(self.world.scene), dtype=torch.bool)
        reachable[torch.cat(self.visible)] = True
        return reachable

    def spread(self, values: Tensor, pose: int) -> Tensor:
        """Interpolate values of a view's cells at the scene's cells that it shows.

        Args:
            values: `(C, cells)`.
            pose: number of the pose.

        Returns:
            `(C, V)`.
        """
        image = values.unflatten(-1, (_POINTS, _POINTS))[None]
        place = (2 * (self.points[pose] + 0.5) / self.view_grid.extent - 1)[None, None].to(values)
        return F.grid_sample(image, place, padding_mode="border", align_corners=False)[0, :, 0]

    @cached_property
    def distances(self) -> list[Tensor]:
        """Distance `(cells, V)` from each cell of a view to those seen; d in a view wider by r is r (σ + d) - σ."""
        centres = self.view_grid.centres
        side = self.view_grid.extent.amax()
        distances = []
        for pose, points in zip(self.poses, self.points, strict=True):
            ratio = float(pose[2]) / self.fields[0]
            distances.append(ratio * (self.fovea + torch.cdist(centres, points) / side) - self.fovea)
        return distances

    def acuity(self, distance: Tensor) -> Tensor:
        """Compute the relative acuity of the fovea, 1 / (1 + d / σ).

        Args:
            distance: `(...)`, d; infinite for cells that were never seen.

        Returns:
            `(...)`, from 0 to 1.
        """
        return 1 / (1 + distance / self.fovea)

    def durations(self, action: int, speeds: Speeds) -> Tensor:
        """Compute the time from one action to each other one, the look there included.

        Args:
            action: the present action.
            speeds: of eye and head.

        Returns:
            `(A,)` in seconds.
        """
        number, cell = divmod(action, self.cells)
        pose = self.poses[number]
        head = self.world.turn(pose.expand_as(self.poses), self.poses)
        octaves = (self.poses[:, 2] / pose[2]).log2()
        # The angle of the saccade is measured in the field of view of the new pose.
        field_numbers = torch.tensor([self.fields.index(float(field)) for field in self.poses[:, 2]])
        eye = torch.stack([shifts[cell] for shifts in self._shifts])[field_numbers]
        return speeds.duration(eye, head[:, None], octaves[:, None]).flatten()
