"""The record of an episode of eye and head: where both looked, what was seen and what was believed."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.windowed import LargePicture
from semfov.detection.detections import Detections
from semfov.detection.objects import Objects
from semfov.detection.placement import resize
from semfov.errors import InputError, check
from semfov.head.scenes import Flat, Panorama, Sphere, World
from semfov.head.views import Views
from semfov.io.schema import Array, Field, Maybe, Number, Object, Text
from semfov.io.tables import pixels
from semfov.kinds import HEAD
from semfov.paths.base import Record
from semfov.paths.conversion import COLUMNS
from semfov.paths.files import POSITIVE, Format
from semfov.paths.look import LookView, RecordedLook, cell_columns, read_region, whole_pixels
from semfov.paths.merging import distances_to, merge_fixations
from semfov.paths.stimulus import LONGEST
from semfov.paths.words import Words
from semfov.sensor.sphere import Boxes, panorama_directions

_WORLDS: dict[str, tuple[type[Sphere] | type[Flat], tuple[str, ...]]] = {
    "panorama": (Panorama, ("picture", "size", "cell", "reach")),
    "flat": (Flat, ("picture", "size", "cell", "degree")),
    "camera": (Sphere, ("picture", "size", "cell", "pan", "tilt")),
}
_WORLD = {
    "kind": Text(tuple(_WORLDS)),
    "picture": Array(Number(low=1, whole=True), 2),
    "size": Array(Number(low=1, whole=True), 2),
    "cell": POSITIVE,
    "reach": Number(0, 90),
    "degree": POSITIVE,
    "pan": Array(Number(), 2),
    "tilt": Array(Number(-90, 90), 2),
}

_FORMAT = Format(
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
        "aimed": Maybe(Array(Array(Number(), 3))),
        "duration": Maybe(Number(low=0)),
    },
)
"""Format of the files of paths of eye and head."""


class HeadWords(Words):
    """Words for an episode of eye and head."""

    record: "HeadPath"

    def describe(self) -> str:
        """Describe the outcome in one line."""
        record = self.record
        outcome = self.objects
        if record.decision is not None and record.target_name is not None:
            certainty = f"there with probability {record.decision.probability:.2f}"
            outcome = f"{self.verdict(record.target_name, ':')} ({certainty})"
        looks = f"{len(record)} look{'s' if len(record) != 1 else ''}"
        turns = f"{record.turns} turn{'s' if record.turns != 1 else ''} of the head"
        seconds = record.seconds[-1] if record.looks else 0.0
        return f"{outcome} in {seconds:.1f} s of eye and head: {looks}, {turns}"

    def why_it_ended(self) -> str:
        """Explain in one sentence why it ended, with the time limit of the scene where that ended it."""
        sentence = super().why_it_ended()
        if self.record.ending != "duration" or self.record.duration is None:
            return sentence
        return f"{sentence.removesuffix('.')}, {self.record.duration:g} s (duration)."

    @property
    def value(self) -> str:
        """The unit of the values of looks."""
        return "the expected gain per second"

    @property
    def sensor(self) -> str:
        """The views of the head."""
        width, height = self.record.views.world.size
        fields = ", ".join(f"{field:g}" for field in self.record.views.fields)
        return f"views of {width} × {height} px with fields of view of {fields} degrees"


@dataclass(frozen=True, kw_only=True, repr=False)
class HeadLook(RecordedLook):
    """One look of an eye in a head that turns.

    Attributes:
        action: number of the pose and cell (`Views`).
        in_view: its detections, a batch of one, with boxes in pixels of its view.
    """

    action: int
    in_view: Detections


def head_look(
    views: Views, action: int, in_view: Detections, map_after: Tensor, number: int, seconds: float, value: float
) -> HeadLook:
    """Make the complete look of a head; its region is the smallest box around what it shows.

    Args:
        views: the views and fixations that were possible.
        action: number of the pose and cell.
        in_view: its detections, with boxes in pixels of the view.
        map_after: `(S,)`, probability of the target, or of any object, in each cell of the scene after the look.
        number: number of the look.
        seconds: time at its end, on the clock of eye and head.
        value: expected gain per second for which it was chosen; infinite for the first.
    """
    world = views.world
    pose = views.poses[action // views.cells]
    pan, tilt, degrees = pose.tolist()
    x, y = world.pixels_of(views.gaze[[action]])[0].tolist()
    frame = torch.tensor([[0.0, 0.0, *map(float, world.size)]])
    x1, y1, x2, y2 = world.boxes(frame, pose)[0].tolist()
    boxes = world.boxes(in_view.boxes[0], pose)[None].to(in_view.boxes)
    cells = cell_columns(world.scene, int(views.gaze_cell[action]), map_after)
    return HeadLook(
        index=number,
        fixation=(x, y),
        region=(x1, y1, x2, y2),
        detections=replace(in_view, boxes=boxes),
        seconds=seconds,
        value=value if math.isfinite(value) else None,
        more={"action": action, "pan": pan, "tilt": tilt, "field": degrees, **cells},
        action=action,
        in_view=in_view,
    )


def head_looks(
    views: Views,
    actions: Sequence[int],
    in_views: Sequence[Detections],
    maps: Tensor,
    seconds: Sequence[float],
    values: Sequence[float] = (),
) -> tuple[HeadLook, ...]:
    """Make the looks of a head from their columns (`head_look`); values that are not known are infinite."""
    values = values or [math.inf] * len(actions)
    columns = zip(actions, in_views, maps, seconds, values, strict=True)
    return tuple(
        head_look(views, action, in_view, map_after, number, time, value)
        for number, (action, in_view, map_after, time, value) in enumerate(columns)
    )


@dataclass(frozen=True, kw_only=True, repr=False)
class HeadPath(Record):
    """The record of an episode: where eye and head looked, what was seen and what was believed.

    Beside the attributes of `semfov.paths.Record` it has those of its looks.

    Attributes:
        views: the views and fixations that were possible. Those of a path from a file have the geometry of the scene,
            without its picture.
        looks: the looks; their times are on the clock of eye and head (`semfov.head.Speeds`), and their values are the
            expected gains per second for which they were chosen.
        maps: `(N, S)`, after each look, the probability that a cell of the scene holds the target, or any object in an
            exploration.
        duration: time limit of the scene in seconds, on the clock of `seconds`; None for none.
        found: whether the last look found the target; the `cell` of the decision is then one of the scene.

    Example::

        path = agent.search(Panorama("street.jpg"), "bicycle")
        print(path.turns, path.seconds[-1])  # turns of the head, and the time taken
        regions, labels, scores = path.places(-1)  # objects of the last look
    """

    views: Views
    looks: tuple[HeadLook, ...]
    maps: Tensor
    duration: float | None = None

    kind = HEAD
    _words = HeadWords
    _format = _FORMAT
    _columns = (*COLUMNS, "pan", "tilt")

    @property
    def actions(self) -> tuple[int, ...]:
        """Number of the pose and cell of each look (`Views`)."""
        return tuple(look.action for look in self.looks)

    @property
    def detections(self) -> tuple[Detections, ...]:
        """Detections of each look, a batch of one, with boxes in pixels of its view."""
        return tuple(look.in_view for look in self.looks)

    @property
    def values(self) -> tuple[float, ...]:
        """Expected gain per second for which each look was chosen; infinite for the first, and if it is not known."""
        return tuple(math.inf if look.value is None else look.value for look in self.looks)

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
        for look in self.looks:
            boxes = look.in_view.boxes[0]
            field = float(self.pose(look.index)[2])
            point = self.views.view_grid.centres[look.action % self.views.cells]
            distances.append(distances_to(boxes, point) * field / width)
            border = boxes.new_tensor([2.0, 2.0, width - 2.0, height - 2.0])  # a box this near to it counts as cut
            cut.append((boxes[:, :2] <= border[:2]).any(-1) | (boxes[:, 2:] >= border[2:]).any(-1))
        return merge_fixations([look.detections for look in self], distances, self.closer, cut=cut, around=self.around)

    @property
    def size(self) -> tuple[int, int]:
        """`(width, height)` of the picture of the scene in pixels."""
        width, height = (int(side) for side in self.views.world.scene.extent)
        return width, height

    @property
    def around(self) -> float | None:
        """Width in pixels of a panorama, after which it repeats; None for other scenes."""
        return float(self.size[0]) if self.views.world.closed else None

    def object_rows(self) -> list[dict[str, Any]]:
        """List the objects, with `pan` to the right and `tilt` up of the middle of each box, in degrees."""
        rows = super().object_rows()
        world = self.views.world
        points = torch.tensor([[row["x"], row["y"]] for row in rows], dtype=torch.float64).view(-1, 2) - 0.5
        places = panorama_directions(points, self.size) if isinstance(world, Sphere) else points
        angles = world.angles_of(places).tolist()
        return [row | {"pan": pixels(pan), "tilt": pixels(tilt)} for row, (pan, tilt) in zip(rows, angles, strict=True)]

    def pose(self, look: int) -> Tensor:
        """Pose of the head in a look.

        Args:
            look: index of the look, from 0 (`look.index`); negative ones count from the end.

        Returns:
            `(3,)`, pan to the right, tilt up, and field of view, in degrees.
        """
        return self.views.poses[self.looks[look].action // self.views.cells]

    def gaze(self, look: int) -> Tensor:
        """Point of the scene that the eye fixated in a look.

        Args:
            look: index of the look, from 0 (`look.index`); negative ones count from the end.

        Returns:
            `(D,)`, a unit direction in a panorama, or pixels of a flat scene.
        """
        return self.views.gaze[self.looks[look].action]

    def direction(self, look: int) -> tuple[float, float]:
        """Direction in which the eye looked, as a head would turn to it.

        Args:
            look: index of the look, from 0 (`look.index`); negative ones count from the end.

        Returns:
            Pan to the right and tilt up, in degrees.
        """
        pan, tilt = self.views.world.angles_of(self.gaze(look)[None])[0].tolist()
        return pan, tilt

    def places(self, look: int, score: float = 0.1) -> tuple[Boxes, Tensor, Tensor]:
        """Objects detected in a look, in coordinates of the scene.

        Args:
            look: index of the look, from 0 (`look.index`); negative ones count from the end.
            score: least score of an object. For a search, only objects of the target class are returned.

        Returns:
            The regions that the objects cover, their classes `(M,)` and their scores `(M,)`.
        """
        detections = self.looks[look].in_view
        best, label = detections.confidence[0], detections.labels[0]
        chosen = detections.mask[0] & (best >= score)
        if self.target is not None:
            chosen &= label == self.target
        return self.views.world.places(detections.boxes[0, chosen], self.pose(look)), label[chosen], best[chosen]

    def outline(self, look: RecordedLook) -> Tensor:
        """Border of the view of a look, `(P, 2)`; it goes on beyond the picture where it crosses its seam."""
        world = self.views.world
        view = torch.tensor([[0.0, 0.0, *map(float, world.size)]])
        places: Any = world.places(view, self.pose(look.index))
        if not hasattr(places, "outlines"):
            x1, y1, x2, y2 = places.boxes[0].tolist()
            return torch.tensor([[x1, y1], [x2, y1], [x2, y2], [x1, y2], [x1, y1]])
        x, y = (world.pixels_of(places.outlines()[0]) + 0.5).unbind(-1)
        if self.around is not None:
            step = (x.diff() + self.around / 2) % self.around - self.around / 2
            x = torch.cat([x[:1], x[:1] + step.cumsum(0)])
        return torch.stack([x, y], -1)

    def belief_map(self, number: int) -> tuple[Grid, Tensor]:
        """Probability of the target, or of any object, in each cell of the scene after a look."""
        return self.views.world.scene, self.maps[self._place(number)]

    def look_views(self, source: LargePicture) -> Iterator[LookView]:
        """Render the views of the head from a picture of the scene in any size."""
        world, (width, height) = self.views.world, self.size
        image = read_region(source, (0, 0, width, height), self.size, 2 * LONGEST)
        # Poses in a panorama are angles, which do not depend on the size of the picture.
        scene = Panorama(image[..., : image.shape[-1] // 2 * 2], world.size, reach=90) if world.closed else None
        across, down = image.shape[-1] / width, image.shape[-2] / height
        for look in self.looks:
            if scene is not None:
                pixels = scene.view(self.pose(look.index))[0]
            else:
                x1, y1, x2, y2 = (side * by for side, by in zip(look.region, (across, down) * 2, strict=True))
                left, top, right, bottom = whole_pixels((x1, y1, x2, y2), (image.shape[-1], image.shape[-2]))
                pixels = resize(image[None, :, top:bottom, left:right], world.size)[0].clamp(0, 1)
            x, y = self.views.view_grid.centres[look.action % self.views.cells].tolist()
            yield LookView(pixels, world.size, look.in_view.boxes[0], (x, y))

    def _contents(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        views = self.views
        record: dict[str, Any] = {"fields": list(views.fields), "fovea": views.fovea, "duration": self.duration}
        record["seconds"] = list(self.seconds)
        record["aimed"] = views.poses[views.lattice :].tolist()
        tensors = {"actions": torch.tensor(self.actions), "maps": self.maps}
        tensors["values"] = torch.tensor(self.values, dtype=torch.float64)
        return tensors, {"world": _settings(views.world), **record}

    @classmethod
    def _fields(cls, tensors: dict[str, Tensor], record: dict[str, Any], shared: dict[str, Any]) -> dict[str, Any]:
        settings = record["world"]
        scene, names = _WORLDS[settings["kind"]]
        for name in names:
            check(name in settings, f"world.{name}", "a value", "nothing")
        given = {name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()}
        options: dict[str, Any] = {name: given[name] for name in names[2:]}
        world = scene(given["picture"], given["size"], **options)
        views = Views(world, record["fields"], fovea=record["fovea"])
        aimed = record.get("aimed")
        is_known = aimed is not None or len(views.fields) == 1
        check(is_known, "aimed", "the poses of closer looks", "none, as earlier versions wrote it")
        for pose in aimed or ():
            views.add(torch.tensor(pose))
        actions, cells = tensors["actions"], len(views.world.scene)
        check(int(actions.max()) < len(views.gaze), "actions", f"numbers below {len(views.gaze)}", int(actions.max()))
        maps, decision = tensors["maps"], shared["decision"]
        check(maps.shape[-1] == cells, "maps", f"values of {cells} cells", maps.shape[-1])
        cell = None if decision is None else decision.cell
        check(cell is None or cell < cells, "decision.cell", f"a cell number below {cells}", cell)
        values = tensors["values"].tolist() if "values" in tensors else []
        looks = head_looks(views, actions.tolist(), shared["detections"], maps, record["seconds"], values)
        return {"views": views, "looks": looks, "maps": maps, "duration": record.get("duration")}


def _settings(world: World) -> dict[str, Any]:
    """Describe the geometry of a scene by JSON values."""
    what = type(world) if world.still else Sphere  # that of a camera
    for kind, (made, names) in _WORLDS.items():
        if what is made:
            return {"kind": kind, **{name: getattr(world, name) for name in names}}
    expected = "a scene that files can describe, Panorama, Flat or that of a camera"
    raise InputError(f"views: expected {expected}, got {type(world).__name__}")
