"""The record of an episode of eye and head: where both looked, what was seen and what was believed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from semfov.decision import Decision
from semfov.detection.detections import Detections
from semfov.detection.objects import Objects
from semfov.errors import InputError, check
from semfov.head.camera import CameraScene
from semfov.head.scenes import Flat, Panorama
from semfov.head.sphere import Sphere
from semfov.head.views import Views
from semfov.head.world import Places, World
from semfov.io.schema import Array, Field, Number, Object, Text
from semfov.paths.base import GazeRecord
from semfov.paths.files import POSITIVE, Format, pair
from semfov.paths.merging import distances_to, merge_fixations

_BORDER = 2.0
"""A box this near to a border of its view, in pixels of the view, counts as cut by it."""

_WORLDS: dict[str, tuple[type[Sphere] | type[Flat], tuple[str, ...]]] = {
    "panorama": (Panorama, ("picture", "size", "cell", "reach")),
    "flat": (Flat, ("picture", "size", "cell", "degree")),
    "camera": (Sphere, ("picture", "size", "cell", "pan", "tilt")),
}
_WORLD = {
    "kind": Text(tuple(_WORLDS)),
    "picture": pair(Number(low=1, whole=True)),
    "size": pair(Number(low=1, whole=True)),
    "cell": POSITIVE,
    "reach": Number(0, 90),
    "degree": POSITIVE,
    "pan": pair(Number()),
    "tilt": pair(Number(-90, 90)),
}

_FORMAT = Format.of(
    "head path",
    {
        "actions": Field(("n",), dtype=torch.int64, low=0),
        "maps": Field(("n", "cells"), mixed=True, low=0, high=1 + 1e-3),
        "values": Field(("n",), mixed=True, finite=False, optional=True),
    },
    {
        "world": Object(_WORLD, None, ("kind", "picture", "size", "cell")),
        "fields": Array(POSITIVE, least=1, ascending=True),
        "fovea": POSITIVE,
        "seconds": Array(Number(low=0), "n"),
    },
    endings=("decision", "worth", "passes", "seconds", "duration", "cells", "stopped"),
    closer=("fixation", "target", "cell", "place", "presence"),
)
"""Format of the files of paths of eye and head."""


@dataclass(frozen=True, kw_only=True, repr=False)
class HeadPath(GazeRecord):
    """The record of an episode: where eye and head looked, what was seen and what was believed.

    Beside the attributes of `semfov.paths.GazeRecord` it has those of its looks.

    Attributes:
        views: the views and fixations that were possible. Those of a path from a file have the geometry of the scene,
            without its picture.
        actions: number of the pose and cell of each look (`Views`).
        seconds: time at the end of each look.
        detections: detections of each look, a batch of one, with boxes in pixels of its view.
        maps: `(N, S)`, after each look, the probability that a cell of the scene holds the target, or any object in an
            exploration.
        values: expected gain per second for which each look was chosen, infinite for the first; empty if not known.
        found: whether the last look found the target; the `cell` of the decision is then one of the scene, and its
            `box` is in pixels of the last view.

    Example::

        path = agent.search(Panorama("street.jpg"), "bicycle")
        print(path.turns, path.seconds[-1])  # turns of the head, and the time taken
        regions, labels, scores = path.places(-1)  # objects of the last look
    """

    views: Views
    actions: tuple[int, ...]
    seconds: tuple[float, ...]
    maps: Tensor
    values: tuple[float, ...] = ()

    how = "head"
    _format = _FORMAT

    @property
    def turns(self) -> int:
        """Number of times that the head moved."""
        poses = [action // self.views.cells for action in self.actions]
        return sum(one != other for one, other in pairwise(poses))

    @cached_property
    def candidates(self) -> Objects:
        """Objects merged from the detections of all looks, of all scores from 0.05 on, with boxes in picture pixels.

        A box is the smallest one around the region of the scene. One that crosses the seam of a panorama begins inside
        the picture and ends beyond its right border. Of several boxes of one object, one that no border of the view
        cuts is kept, and of these the box of the nearest fixation.
        """
        distances, cut = [], []
        width, height = self.views.world.size
        for number, (action, detections) in enumerate(zip(self.actions, self.detections, strict=True)):
            boxes, field = detections.boxes[0], float(self.pose(number)[2])
            point = self.views.view_grid.centres[action % self.views.cells]
            distances.append(distances_to(boxes, point) * field / width)
            border = boxes.new_tensor([_BORDER, _BORDER, width - _BORDER, height - _BORDER])
            cut.append((boxes[:, :2] <= border[:2]).any(-1) | (boxes[:, 2:] >= border[2:]).any(-1))
        looks = [self._in_picture(number) for number in range(len(self))]
        around = float(self.size[0]) if self.views.world.closed else None
        return merge_fixations(looks, distances, self.closer, cut=cut, around=around)

    def region(self, number: int) -> tuple[float, float, float, float]:
        """Part of the picture that a look showed: the smallest box around it.

        Args:
            number: number of the look, from 0.

        Returns:
            `(x1, y1, x2, y2)` in picture pixels; beyond the right border where it crosses the seam of a panorama.
        """
        width, height = self.views.world.size
        frame = torch.tensor([[0.0, 0.0, width, height]])
        x1, y1, x2, y2 = self.views.world.boxes(frame, self.pose(number))[0].tolist()
        return x1, y1, x2, y2

    def pose(self, look: int) -> Tensor:
        """Pose of the head in a look.

        Args:
            look: number of the look; negative numbers count from the end.

        Returns:
            `(3,)`, pan to the right, tilt up, and field of view, in degrees.
        """
        return self.views.poses[self.actions[look] // self.views.cells]

    def gaze(self, look: int) -> Tensor:
        """Point of the scene that the eye fixated in a look.

        Args:
            look: number of the look; negative numbers count from the end.

        Returns:
            `(D,)`, a unit direction in a panorama, or pixels of a flat scene.
        """
        return self.views.gaze[self.actions[look]]

    def direction(self, look: int) -> tuple[float, float]:
        """Direction in which the eye looked, as a head would turn to it.

        Args:
            look: number of the look; negative numbers count from the end.

        Returns:
            Pan to the right and tilt up, in degrees.
        """
        pan, tilt = self.views.world.angles_of(self.gaze(look)[None])[0].tolist()
        return pan, tilt

    def places(self, look: int, score: float = 0.1) -> tuple[Places, Tensor, Tensor]:
        """Objects detected in a look, in coordinates of the scene.

        Args:
            look: number of the look; negative numbers count from the end.
            score: least score of an object. For a search, only objects of the target class are returned.

        Returns:
            The regions that the objects cover, their classes `(M,)` and their scores `(M,)`.
        """
        detections = self.detections[look]
        best, label = detections.scores[0, :, 1:].max(-1)
        label = label + 1
        chosen = detections.mask[0] & (best >= score)
        if self.target is not None:
            chosen &= label == self.target
        return self.views.world.places(detections.boxes[0, chosen], self.pose(look)), label[chosen], best[chosen]

    def describe(self) -> str:
        """Describe the outcome in one line."""
        looks = f"{len(self)} look{'s' if len(self) != 1 else ''}"
        turns = f"{self.turns} turn{'s' if self.turns != 1 else ''} of the head"
        what = self.objects_in_words()
        if self.decision is not None:
            what = f"{self.target_name}: {self.decision.outcome} ({self.decision.probability:.2f})"
        return f"{what} in {self.seconds[-1]:.1f} s: {looks}, {turns}"

    def rows(self) -> list[dict[str, Any]]:
        """The looks as a table of plain values, one row for each look.

        `x` and `y` are the fixated point in pixels of the scene's picture. `pan` and `tilt` are the direction of the
        head, and `field` is its field of view, in degrees.
        `probability` is the probability of the target, or of any object in an exploration, in the fixated cell of the
        scene, and `highest` the largest one of all cells. `detections` is the number of detections, `seen` the class of
        the most confident one, and `score` its confidence. `seconds` is the time at the end of the look.

        Returns:
            One dictionary for each look.
        """
        rows = []
        for number, (action, (x, y)) in enumerate(zip(self.actions, self._gaze()[0].tolist(), strict=True)):
            cell = int(self.views.gaze_cell[action])
            rows.append(
                {
                    "look": number,
                    "action": action,
                    "x": x,
                    "y": y,
                    **dict(zip(("pan", "tilt", "field"), self.pose(number).tolist(), strict=True)),
                    "cell": cell,
                    "probability": float(self.maps[number, cell]),
                    "highest": float(self.maps[number].max()),
                    "highest_cell": int(self.maps[number].argmax()),
                    **self._detected(self.detections[number]),
                    "seconds": self.seconds[number],
                }
            )
        return rows

    def _in_picture(self, number: int) -> Detections:
        detections = self.detections[number]
        boxes = self.views.world.boxes(detections.boxes[0], self.pose(number))
        return replace(detections, boxes=boxes[None].to(detections.boxes))

    def _duration(self, number: int) -> float | None:
        return self.seconds[number] - (self.seconds[number - 1] if number else 0.0)

    def _value(self, number: int) -> float | None:
        value = self.values[number] if self.values else math.inf
        return value if math.isfinite(value) else None  # the first look has none

    def _decision_in_picture(self) -> Decision | None:
        decision = self.decision
        if decision is None or decision.box is None:
            return decision
        return replace(decision, box=self.views.world.boxes(decision.box[None], self.pose(-1))[0])

    def _gaze(self) -> tuple[Tensor, tuple[int, int]]:
        width, height = (int(side) for side in self.views.world.scene.extent)
        return self.views.world.pixels_of(self.views.gaze[[*self.actions]]), (width, height)

    def _contents(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        views = self.views
        record = {"fields": list(views.fields), "fovea": views.fovea, "seconds": list(self.seconds)}
        tensors = {"actions": torch.tensor(self.actions), "maps": self.maps}
        if self.values:
            tensors["values"] = torch.tensor(self.values, dtype=torch.float64)
        return tensors, {"world": _settings(views.world), **record}

    @classmethod
    def _fields(
        cls, tensors: Mapping[str, Tensor], record: Mapping[str, Any], shared: Mapping[str, Any]
    ) -> dict[str, Any]:
        views = Views(_world(record["world"]), record["fields"], fovea=record["fovea"])
        actions, cells = tensors["actions"], len(views.world.scene)
        check(int(actions.max()) < len(views.gaze), "actions", f"numbers below {len(views.gaze)}", int(actions.max()))
        maps, decision = tensors["maps"], shared["decision"]
        check(maps.shape[-1] == cells, "maps", f"values of {cells} cells", maps.shape[-1])
        cell = None if decision is None else decision.cell
        check(cell is None or cell < cells, "decision.cell", f"a cell number below {cells}", cell)
        values = tuple(tensors["values"].tolist()) if "values" in tensors else ()
        seconds = tuple(record["seconds"])
        return {"views": views, "actions": tuple(actions.tolist()), "maps": maps, "seconds": seconds, "values": values}


def _settings(world: World) -> dict[str, Any]:
    """The geometry of a scene as JSON values."""
    what = Sphere if isinstance(world, CameraScene) else type(world)
    for kind, (made, names) in _WORLDS.items():
        if what is made:
            return {"kind": kind, **{name: getattr(world, name) for name in names}}
    expected = "a scene that files can describe, Panorama, Flat or that of a camera"
    raise InputError(f"views: expected {expected}, got {type(world).__name__}")


def _world(settings: Mapping[str, Any]) -> World:
    """A scene with this geometry, without its picture."""
    made, names = _WORLDS[settings["kind"]]
    for name in names:
        check(name in settings, f"world.{name}", "a value", "nothing")
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()}
    options: dict[str, Any] = {name: values[name] for name in names[2:]}
    return made(values["picture"], values["size"], **options)
