"""The record of an episode of eye and head: where both looked, what was seen and what was believed."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.classes import amount
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
from semfov.paths.conversion import COLUMNS, Values
from semfov.paths.files import POSITIVE, Format, SharedFields, check_decided_cell
from semfov.paths.look import (
    LookView,
    RecordedLook,
    cell_columns,
    finite_or_none,
    pixels_in,
    read_region,
    shorter_way,
)
from semfov.paths.merging import FixationBoxes, distances_to, merge_fixations
from semfov.paths.stimulus import LONGEST
from semfov.paths.words import Words
from semfov.sensor.sphere import Boxes, Regions, panorama_directions

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

# Of n looks over the cells of a scene.
_FORMAT = Format(
    "head path",
    {
        "actions": Field(("n",), dtype=torch.int64, low=0),
        "maps": Field(("n", "cells"), mixed=True, low=0, high=1 + 1e-3),
        "values": Field(("n",), mixed=True, finite=False),
    },
    {
        "world": Object(_WORLD, None, ("kind", "picture", "size", "cell")),
        "fields": Array(POSITIVE, least=1, ascending=True),
        "fovea": POSITIVE,
        "seconds": Array(Number(low=0), "n"),
        "aimed": Array(Array(Number(), 3)),
        "duration": Maybe(Number(low=0)),
    },
)
"""Format of the files of paths of eye and head."""

_BORDER = 2.0  # pixels; a box that is as near to the border of its view counts as cut


class HeadWords(Words):
    """Words for an episode of eye and head."""

    record: "HeadPath"

    def describe(self) -> str:
        """Describe the outcome in one line."""
        record = self.record
        outcome = self.objects
        if record.decision is not None and record.target_name is not None:
            verdict = self.verdict(record.target_name, ":")
            outcome = f"{verdict} (there with probability {record.decision.probability:.2f})"
        looks = amount(len(record), "look")
        turns = f"{amount(record.turns, 'turn')} of the head"
        seconds = record.seconds[-1] if record.looks else 0.0
        return f"{outcome} in {seconds:.1f} s of eye and head: {looks}, {turns}"

    def why_it_ended(self) -> str:
        """Explain in one sentence why the episode ended; if by the scene's time limit, with this limit."""
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


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class HeadLook(RecordedLook):
    """One look of an eye in a head that turns.

    Attributes:
        action: number of the pose and cell (`Views`).
        in_view: its detections, a batch of one, with boxes in pixels of its view.
    """

    action: int
    in_view: Detections


def head_look(
    views: Views,
    action: int,
    in_view: Detections,
    map_after: Tensor,
    number: int,
    seconds: float,
    value: float,
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
    # Actions count the cells of a view, pose by pose.
    pose = views.poses[action // views.cells]  # (3,)
    pan, tilt, field = pose.tolist()
    x, y = world.pixels_of(views.gaze[[action]])[0].tolist()
    whole_view = torch.tensor([[0.0, 0.0, *map(float, world.size)]])
    x1, y1, x2, y2 = world.boxes(whole_view, pose)[0].tolist()
    boxes_in_picture = world.boxes(in_view.boxes[0], pose)[None].to(in_view.boxes)
    cells = cell_columns(world.scene, int(views.gaze_cell[action]), map_after)
    return HeadLook(
        index=number,
        fixation=(x, y),
        region=(x1, y1, x2, y2),
        detections=replace(in_view, boxes=boxes_in_picture),
        seconds=seconds,
        value=finite_or_none(value),
        more={"action": action, "pan": pan, "tilt": tilt, "field": field, **cells},
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
    columns = zip(actions, in_views, maps, range(len(actions)), seconds, values, strict=True)
    return tuple(head_look(views, *look) for look in columns)


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class HeadPath(Record):
    """The record of an episode: where eye and head looked, what was seen and what was believed.

    In addition to the attributes of `semfov.paths.Record` it has those of its looks.

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
        # An eye that moves within a view leaves the head where it is.
        return sum(pose != pose_before for pose_before, pose in pairwise(poses))

    @cached_property
    def candidates(self) -> Objects:
        """Objects merged from the detections of all looks, of all scores from 0.05 on, with boxes in picture pixels.

        A box is the smallest one around the object's region of the scene. If it crosses the seam of a panorama, it
        begins inside the picture and ends beyond the right border. Of several boxes of one object, the one from the
        nearest fixation is kept, if possible one that no border of the view cuts.
        """
        fixations = []
        for look in self.looks:
            distances = self._distances_to_gaze(look)
            fixations.append(FixationBoxes(look.detections, distances, look.index, self._cut_by_border(look)))
        return merge_fixations(fixations, self.closer, around=self.around)

    def _distances_to_gaze(self, look: HeadLook) -> Tensor:
        """Compute the distance in degrees from the gaze to the boxes of a look, `(L,)`."""
        field = float(self.pose(look.index)[2])
        width = self.views.world.size[0]
        # Pixels of a narrow view are fewer degrees, so that distances in pixels of different views do not compare.
        return distances_to(look.in_view.boxes[0], self._gaze_in_view(look)) * field / width

    def _cut_by_border(self, look: HeadLook) -> Tensor:
        """Tell which boxes of a look end at the border of its view, `(L,)`, so that they may show a part alone."""
        boxes = look.in_view.boxes[0]  # (L, 4)
        width, height = self.views.world.size
        upper_left = boxes.new_tensor([_BORDER, _BORDER])
        lower_right = boxes.new_tensor([width - _BORDER, height - _BORDER])
        begins_before = (boxes[:, :2] <= upper_left).any(-1)
        ends_after = (boxes[:, 2:] >= lower_right).any(-1)
        return begins_before | ends_after

    def _gaze_in_view(self, look: HeadLook) -> Tensor:
        """Find the point `(2,)` in pixels of the view that the eye fixates in a look."""
        return self.views.view_grid.centres[look.action % self.views.cells]

    @property
    def size(self) -> tuple[int, int]:
        """`(width, height)` of the picture of the scene in pixels."""
        width, height = (int(side) for side in self.views.world.scene.extent)
        return width, height

    @property
    def around(self) -> float | None:
        """Width in pixels of a panorama, after which it repeats; None for other scenes."""
        return float(self.size[0]) if self.views.world.closed else None

    def object_rows(self) -> list[Values]:
        """List the objects, with `pan` to the right and `tilt` up of the middle of each box, in degrees."""
        rows = super().object_rows()
        world = self.views.world
        # Without objects the tensor has no second dimension by itself.
        middles = torch.tensor([[row["x"], row["y"]] for row in rows], dtype=torch.float64).view(-1, 2)  # (M, 2)
        points = middles - 0.5  # pixel centres at integers
        in_scene = panorama_directions(points, self.size) if isinstance(world, Sphere) else points
        for row, (pan, tilt) in zip(rows, world.angles_of(in_scene).tolist(), strict=True):
            row["pan"] = pixels(pan)
            row["tilt"] = pixels(tilt)
        return rows

    def pose(self, look: int) -> Tensor:
        """Pose of the head in a look.

        Args:
            look: index of the look, from 0 (`look.index`); negative ones count from the end.

        Returns:
            `(3,)`, pan to the right, tilt up, and field of view, in degrees.
        """
        return self.views.poses[self.looks[self._place(look, "look")].action // self.views.cells]

    def gaze(self, look: int) -> Tensor:
        """Point of the scene that the eye fixated in a look.

        Args:
            look: index of the look, from 0 (`look.index`); negative ones count from the end.

        Returns:
            `(D,)`, a unit direction in a panorama, or pixels of a flat scene.
        """
        return self.views.gaze[self.looks[self._place(look, "look")].action]

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
        detections = self.looks[self._place(look, "look")].in_view
        confidence = detections.confidence[0]  # (L,), as labels and mask
        labels = detections.labels[0]
        chosen = detections.mask[0] & (confidence >= score)
        if self.target is not None:
            chosen &= labels == self.target
        regions = self.views.world.places(detections.boxes[0, chosen], self.pose(look))
        return regions, labels[chosen], confidence[chosen]

    def outline(self, look: RecordedLook) -> Tensor:
        """Border of the view of a look, `(P, 2)`; it continues beyond the picture if it crosses a panorama's seam."""
        world = self.views.world
        view = torch.tensor([[0.0, 0.0, *map(float, world.size)]])
        places = world.places(view, self.pose(look.index))
        if isinstance(places, Regions):
            x, y = (world.pixels_of(places.outlines()[0]) + 0.5).unbind(-1)
            return torch.stack([x if self.around is None else _unwrapped(x, self.around), y], -1)
        # A flat scene is seen straight on, so that the view is a rectangle.
        x1, y1, x2, y2 = places.boxes[0].tolist()
        return torch.tensor([[x1, y1], [x2, y1], [x2, y2], [x1, y2], [x1, y1]])

    def belief_map(self, index: int) -> tuple[Grid, Tensor]:
        """Return the cells of the scene, and the probability of the target, or of any object, in each after a look."""
        return self.views.world.scene, self.maps[self._place(index)]

    def look_views(self, source: LargePicture) -> Iterator[LookView]:
        """Render the views of the head from a picture of the scene in any size."""
        world = self.views.world
        width, height = self.size
        image = read_region(source, (0, 0, width, height), self.size, 2 * LONGEST)
        # Poses in a panorama are angles, which do not depend on the size of the picture.
        even_columns = image[..., : image.shape[-1] // 2 * 2]
        panorama = Panorama(even_columns, world.size, reach=90) if world.closed else None
        for look in self.looks:
            if panorama is None:
                view = self._window_of(look, image)
            else:
                view, _ = panorama.view(self.pose(look.index))
            x, y = self._gaze_in_view(look).tolist()
            yield LookView(view, world.size, look.in_view.boxes[0], (x, y))

    def _window_of(self, look: HeadLook, image: Tensor) -> Tensor:
        """Cut the view of a look out of a flat picture `(3, H, W)` in any size, at the size of a view."""
        height, width = image.shape[-2:]
        # Regions are in pixels of the picture that was looked at.
        left, top, right, bottom = pixels_in((width, height), look.region, self.size)
        window = image[None, :, top:bottom, left:right]
        return resize(window, self.views.world.size)[0].clamp(0, 1)

    def _contents(self) -> tuple[dict[str, Tensor | None], Values]:
        tensors: dict[str, Tensor | None] = {
            "actions": torch.tensor(self.actions),
            "maps": self.maps,
            "values": torch.tensor(self.values, dtype=torch.float64),
        }
        record = {
            "world": _settings(self.views.world),
            "fields": list(self.views.fields),
            "fovea": self.views.fovea,
            "duration": self.duration,
            "seconds": list(self.seconds),
            # The poses of the lattice follow from the scene; those of closer looks, which come after them, do not.
            "aimed": self.views.poses[self.views.lattice :].tolist(),
        }
        return tensors, record

    @classmethod
    def _fields(cls, tensors: dict[str, Tensor], record: Values, shared: SharedFields) -> Values:
        views = _views_of_file(record)
        cells = len(views.world.scene)
        actions = tensors["actions"]
        # Poses and cells follow from the settings of the scene, which the actions have to suit.
        highest = int(actions.max())
        check(highest < len(views.gaze), "actions", f"numbers below {len(views.gaze)}", highest)
        maps = tensors["maps"]
        check(maps.shape[-1] == cells, "maps", f"values of {cells} cells", maps.shape[-1])
        check_decided_cell(shared["decision"], cells)
        values = tensors["values"].tolist()
        looks = head_looks(views, actions.tolist(), shared["detections"], maps, record["seconds"], values)
        return {"views": views, "looks": looks, "maps": maps, "duration": record.get("duration")}


def _unwrapped(x: Tensor, around: float) -> Tensor:
    """Join the columns `(P,)` of a closed line, each the shorter way round from the one before, across the seam."""
    steps = shorter_way(x.diff(), around)  # (P - 1,)
    return torch.cat([x[:1], x[:1] + steps.cumsum(0)])


def _views_of_file(record: Values) -> Views:
    """Make the views of a path from the JSON values of its file, with the poses of its closer looks."""
    views = Views(_world_of_file(record["world"]), record["fields"], fovea=record["fovea"])
    for pose in record["aimed"]:
        views.add(torch.tensor(pose))
    return views


def _world_of_file(settings: Values) -> World:
    """Make the geometry of a scene, without its picture, from the values that `_settings` described it by."""
    scene, names = _WORLDS[settings["kind"]]
    arguments: Values = {}
    for name in names:
        check(name in settings, f"world.{name}", "a value", "nothing")
        value = settings[name]
        arguments[name] = tuple(value) if isinstance(value, list) else value
    return scene(arguments.pop("picture"), **arguments)


def _settings(world: World) -> Values:
    """Describe the geometry of a scene by JSON values."""
    # What a camera shows changes, and its class is a driver's own; its geometry is that of a sphere.
    geometry = type(world) if world.still else Sphere
    for kind, (scene, names) in _WORLDS.items():
        if geometry is scene:
            return {"kind": kind, **{name: getattr(world, name) for name in names}}
    expected = "a scene that files can describe, Panorama, Flat or that of a camera"
    raise InputError(f"views: expected {expected}, got {type(world).__name__}")
