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
    """The possible poses `(P, 3)` of a head and fixations of its eye, as one grid: `action = pose * 100 + cell`.

    The views are a strip, one below the other, of cells `grid`; `tiling` are rows of poses that tile the scene for each
    field of view. An action fixates a point `gaze` `(A, D)` in a cell `gaze_cell` `(A,)` of the scene. From each pose
    the cells `visible` `(V,)` are seen at the pixels `points` `(V, 2)`.
    """

    def __init__(self, world: World, fields: Sequence[float] | None = None, *, fovea: float = 100 / 640) -> None:
        fields = world.fields if fields is None else check_fields(fields)
        check(fovea > 0, "fovea", "a positive fraction of the longer side", fovea)
        self.world, self.fields, self.fovea = world, fields, fovea
        poses: list[Tensor] = []
        self.tiling: list[list[list[int]]] = []
        for field in fields:
            rows, numbers = world.poses(field), []
            for row in rows:
                numbers.append([*range(len(poses), len(poses) + len(row))])
                poses += row
            self.tiling.append([row[::2] for row in numbers[::2]])
        self.poses = torch.stack(poses)
        wide, high = world.size
        self.view_grid, self.cells = Grid(_POINTS, _POINTS, (wide, high)), _POINTS**2
        self.grid = Grid(_POINTS, _POINTS * len(poses), (wide, high * len(poses)))
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
        """Number of poses."""
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
        """Interpolate values `(C, cells)` of a view's cells at the scene's cells that it shows, `(C, V)`."""
        image = values.unflatten(-1, (_POINTS, _POINTS))[None]
        place = (2 * (self.points[pose] + 0.5) / self.view_grid.extent - 1)[None, None].to(values)
        return F.grid_sample(image, place, padding_mode="border", align_corners=False)[0, :, 0]

    @cached_property
    def distances(self) -> list[Tensor]:
        """Distance `(cells, V)` from each cell of a view to those seen; d in a view wider by r is r (σ + d) - σ."""
        centres, side = self.view_grid.centres, self.view_grid.extent.amax()
        result = []
        for pose, points in zip(self.poses, self.points, strict=True):
            ratio = float(pose[2]) / self.fields[0]
            result.append(ratio * (self.fovea + torch.cdist(centres, points) / side) - self.fovea)
        return result

    def acuity(self, distance: Tensor) -> Tensor:
        """Relative acuity of the fovea, 1 / (1 + d / σ), at distances d `(...)`; 0 for cells that were never seen."""
        return 1 / (1 + distance / self.fovea)

    def durations(self, action: int, speeds: Speeds) -> Tensor:
        """Time from one action to each other one, the look there included, `(A,)` in seconds."""
        pose, cell = divmod(action, self.cells)
        here = self.poses[pose]
        head = self.world.turn(here.expand_as(self.poses), self.poses)
        octaves = (self.poses[:, 2] / here[2]).log2()
        # The angle of the saccade is measured in the field of view of the new pose.
        which = torch.tensor([self.fields.index(float(field)) for field in self.poses[:, 2]])
        eye = torch.stack([shifts[cell] for shifts in self._shifts])[which]
        return speeds.duration(eye, head[:, None], octaves[:, None]).flatten()
