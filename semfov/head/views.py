"""All that eye and head can look at: the views from the poses of the head, as one grid of cells."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.errors import check
from semfov.head.speeds import Speeds
from semfov.head.world import World

SIDE = 10
"""Cells in a row and in a column of a view: those that the shipped evidence was learned on."""


@dataclass(frozen=True)
class Seen:
    """Cells of the scene that a view shows.

    Attributes:
        cells: `(V,)`, their numbers.
        points: `(V, 2)`, their centres in pixels of the view.
    """

    cells: Tensor
    points: Tensor


class Views:
    """The poses of a head, and the fixations of the eye in the view from each.

    The views are thought of as a strip, one below the other. So an action, a pose and a cell of its view, is one cell
    of a grid, `action = pose * 100 + cell`, and the loop that moves an eye over a picture moves eye and head.

    Args:
        world: the scene.
        fields: of view in degrees, narrowest first; several of them let the head zoom.
        fovea: width σ of the fovea in longer sides of a view.

    Attributes:
        poses: `(P, 3)`.
        tiling: for each field of view, rows of the numbers of poses whose views tile the scene.
        grid: the strip.
        view_grid: the cells of one view.
        gaze: `(A, D)`, point of the scene that each action looks at.
        gaze_cell: `(A,)`, the scene's cell that holds it.
        seen: for each pose, what it shows of the scene.
    """

    def __init__(self, world: World, fields: Sequence[float] = (60.0,), *, fovea: float = 100 / 640) -> None:
        check(len(fields) > 0 and list(fields) == sorted(fields), "fields", "fields of view, narrowest first", fields)
        check(fovea > 0, "fovea", "a positive share of the longer side", fovea)
        self.world, self.fields, self.fovea = world, tuple(fields), fovea
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
        self.view_grid = Grid(SIDE, SIDE, (wide, high))
        self.grid = Grid(SIDE, SIDE * len(poses), (wide, high * len(poses)))
        self.gaze = torch.cat([world.to_scene(self.view_grid.centres, pose) for pose in self.poses])
        self.gaze_cell = world.cell_of(self.gaze)
        self.seen = [self._seen(pose) for pose in self.poses]

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.poses)

    def _seen(self, pose: Tensor) -> Seen:
        points, inside = self.world.to_view(self.world.centres, pose)
        return Seen(inside.nonzero()[:, 0], points[inside])

    @property
    def cells(self) -> int:
        """Cells of a view."""
        return len(self.view_grid)

    @cached_property
    def reachable(self) -> Tensor:
        """Cells of the scene that some view shows, `(S,)` boolean."""
        reachable = torch.zeros(len(self.world.scene), dtype=torch.bool)
        reachable[torch.cat([seen.cells for seen in self.seen])] = True
        return reachable

    def places(self, pose: int) -> Tensor:
        """Where the cells that a pose shows lie in its view, for `grid_sample`, `(V, 2)`."""
        return 2 * (self.seen[pose].points + 0.5) / self.view_grid.extent - 1

    def spread(self, values: Tensor, pose: int) -> Tensor:
        """Values `(C, cells)` of a view's cells at the scene's cells that it shows, `(C, V)`; bilinear."""
        image = values.unflatten(-1, (SIDE, SIDE))[None]
        place = self.places(pose)[None, None].to(values)
        return F.grid_sample(image, place, padding_mode="border", align_corners=False)[0, :, 0]

    @cached_property
    def distances(self) -> list[Tensor]:
        r"""For each pose, distance `(cells, V)` from each cell of its view to the scene's cells that it shows.

        In longer sides of the narrowest view. With σ the width of the fovea, a fovea's acuity at a distance d falls as
        :math:`1 / (1 + d / σ)`, and that of a wider view is less everywhere by the ratio r of the fields. So what is
        seen at d in a wider view is seen as well as at :math:`r (σ + d) - σ` in the narrowest.
        """
        centres, side = self.view_grid.centres, self.view_grid.extent.amax()
        result = []
        for pose, seen in zip(self.poses, self.seen, strict=True):
            ratio = float(pose[2]) / self.fields[0]
            result.append(ratio * (self.fovea + torch.cdist(centres, seen.points) / side) - self.fovea)
        return result

    def acuity(self, distance: Tensor) -> Tensor:
        """1 / (1 + d / σ) of distances d; 0 of what was never seen, at infinity."""
        return 1 / (1 + distance / self.fovea)

    def action_of(self, point: Tensor) -> tuple[int, Tensor]:
        """Pose and pixel `(2,)` of its view, of a point `(2,)` of the strip."""
        high = self.world.size[1]
        pose = int((float(point[1]) + 0.5) // high)
        return pose, point - point.new_tensor([0, pose * high])

    @cached_property
    def _shifts(self) -> list[Tensor]:
        """For each field of view, angles between the cells of a view, `(cells, cells)`."""
        centres = self.view_grid.centres
        return [self.world.shift(centres[:, None], centres[None], field) for field in self.fields]

    def prices(self, action: int, speeds: Speeds) -> Tensor:
        """Seconds from one action to each, `(A,)`, the look there included."""
        pose, cell = divmod(action, self.cells)
        here = self.poses[pose]
        head = self.world.turn(here.expand_as(self.poses), self.poses)
        octaves = (self.poses[:, 2] / here[2]).log2()
        # The eye turns in the head, by what its field of view is where it goes.
        which = torch.tensor([self.fields.index(float(field)) for field in self.poses[:, 2]])
        eye = torch.stack([shifts[cell] for shifts in self._shifts])[which]
        return speeds.price(eye, head[:, None], octaves[:, None]).flatten()
