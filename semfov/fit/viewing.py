"""People who view pictures: their fixations, and the maps of the pictures, each looked at once."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F
from tqdm import tqdm

from semfov.data.fixations import Fixations, by_picture, read_fixations
from semfov.data.fixations.reading import frame_of
from semfov.data.pictures import Pictures
from semfov.detection import Detections, Detector, FeatureMaps, Placement
from semfov.errors import check
from semfov.gaze.saliency.fixation_density import FixationDensity, blurred, cells_of
from semfov.io.code import modules_digest
from semfov.io.files import sha256
from semfov.io.schema import Field, Schema
from semfov.runs.looks import LOOK_SOURCES
from semfov.runs.scene_run import digest_of, store_folder
from semfov.runs.settings import Count, Range, Settings
from semfov.runs.store import SceneStore

LONGEST = 20  # number of fixations of a scanpath that are used, the first ones

_LAYERS = ("backbone8", "backbone16", "backbone32", "head8", "head16", "head32")


@dataclass(frozen=True)
class ViewingData(Settings):
    """Pictures, and the fixations of people in them.

    Args:
        fixations: a file of fixations for each data set, in any format that `semfov check` reads.
        pictures: folder of the pictures of each data set.
        sizes: frame of each file that has none, as `800x600` (none: that of OSIE's files, 800x600).
        seconds: time in seconds for which people viewed a picture, for each data set (none: 3).
        limit: use only the first so many pictures of each data set (none: all).
        cache: folder for the maps of the pictures (None: the user's cache).
    """

    within: ClassVar[str] = ""  # where these settings are a part of others, its name and a point

    fixations: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()
    sizes: tuple[str, ...] = ()
    seconds: tuple[Annotated[float, Range(0.1, 3600)], ...] = ()
    limit: Count | None = None
    cache: Path | None = None

    def __post_init__(self) -> None:
        """Check that every data set has its pictures, and all or none of them a frame and a time."""
        super().__post_init__()
        number = len(self.fixations)
        for name, what in {"pictures": "folder", "sizes": "frame", "seconds": "time"}.items():
            given, expected = len(getattr(self, name)), f"a {what} for each of {number} files of fixations"
            none = not number or (not given and name != "pictures")
            check(none or given == number, f"{self.within}{name}", expected, given)

    @property
    def fingerprint(self) -> list[str]:
        """sha256 of the pictures and of the fixations in them, for each data set."""
        return [
            digest_of([Pictures(root, self.people(number), ()).fingerprint, sha256(self.fixations[number])])
            for number, root in enumerate(self.pictures)
        ]

    def people(self, number: int) -> dict[str, list[Fixations]]:
        """The scanpaths of more than one fixation of a data set, by picture."""
        size = self.sizes[number] if number < len(self.sizes) else None
        everyone = read_fixations(self.fixations[number], **({} if size is None else {"size": frame_of(size)}))
        return dict([*by_picture(each for each in everyone if len(each) > 1).items()][: self.limit])


@dataclass(frozen=True)
class Viewed:
    """Pictures of one size with their feature maps `(P, C, h, w)` in half precision, and everybody's scanpaths."""

    features: FeatureMaps
    people: tuple[tuple[Fixations, ...], ...]
    seconds: float = 3.0
    source: int = 0

    @property
    def size(self) -> tuple[int, int]:
        """`(height, width)` of the pictures."""
        return self.features.placement.size[1], self.features.placement.size[0]

    def __len__(self) -> int:
        return len(self.people)

    @cached_property
    def paths(self) -> list[list[Tensor]]:
        """For each picture the first fixations of each person, `(n, 2)` in pixels of it."""
        return [[torch.from_numpy(each.points[:LONGEST]).float() for each in some] for some in self.people]

    def some(self, pictures: Sequence[int]) -> FeatureMaps:
        """The feature maps of some pictures, in single precision."""
        place = torch.as_tensor(pictures)
        return replace(self.features, maps={name: each[place].float() for name, each in self.features.maps.items()})

    @cached_property
    def counts(self) -> Tensor:
        """Numbers of fixations, without the first of each path, in the cells of each picture, `(P, rows, columns)`."""
        rows, columns = cells_of(self.size)
        return torch.stack([counted(paths, self.size, (rows, columns)).sum(0) for paths in self.paths])


def counted(paths: Sequence[Tensor], size: tuple[int, int], cells: tuple[int, int]) -> Tensor:
    """Numbers of fixations of each path but its first in cells, `(paths, rows, columns)`."""
    counts = torch.zeros(len(paths), cells[0] * cells[1])
    for row, path in zip(counts, paths, strict=True):
        at = _numbers_of_cells(path[1:], size, cells)
        row.index_add_(0, at, torch.ones(len(at)))
    return counts.unflatten(1, cells)


def _numbers_of_cells(points: Tensor, size: tuple[int, int], cells: tuple[int, int]) -> Tensor:
    """Numbers of the cells that hold points; those outside the picture belong to the nearest cell."""
    x = ((points[:, 0] + 0.5) * (cells[1] / size[1])).floor().clamp(0, cells[1] - 1)
    y = ((points[:, 1] + 0.5) * (cells[0] / size[0])).floor().clamp(0, cells[0] - 1)
    return (y * cells[1] + x).long()


class MapSource(NamedTuple):
    """What gives the maps of pictures `(1, 3, H, W)`: their names, and the settings that they depend on."""

    layers: tuple[str, ...]
    maps: Callable[[Tensor], FeatureMaps]
    what: Mapping[str, object]


def features_of(detector: Detector, layers: Sequence[str] = ()) -> MapSource:
    """Feature maps of a detector; without `layers` those of the shipped model, or else of its backbone and head."""
    shipped = None if layers else FixationDensity.if_shipped(detector.name)
    if shipped is not None:
        layers = tuple(shipped.layers)
    if not layers:
        have = detector.features(torch.zeros(1, 3, 64, 64)).maps
        layers = tuple(name for name in _LAYERS if name in have) or tuple(have)
    what = {"detector": detector.settings(), "layers": list(layers)}
    return MapSource(tuple(layers), lambda image: detector.features(image, [*layers]), what)


def look(data: ViewingData, source: MapSource) -> list[Viewed]:
    """Look at all pictures, or read their maps from the cache; those of one data set and size are together."""
    # Dimensions are numbered, as a dash in the name of a layer would be a minus in theirs.
    fields = {
        name: Field((f"channels {n}", f"rows {n}", f"columns {n}"), torch.float16, finite=False)
        for n, name in enumerate(source.layers)
    }
    schema = Schema(fields | {"placed": Field((8,), torch.float64)})
    code = modules_digest(*LOOK_SOURCES, "semfov.gaze.saliency", "semfov.detection", __name__)
    store = SceneStore(store_folder(data.cache) / "viewing", source.what, code, schema)
    groups = []
    for number, root in enumerate(data.pictures):
        people = data.people(number)
        scenes = Pictures(root, people, ())

        def seen(scenes: Pictures = scenes, people: Mapping[str, list[Fixations]] = people) -> Iterable[_Seen]:
            for index, name in enumerate(tqdm(scenes.ids, desc="looking", unit="picture")):
                digest = scenes.digest(index)
                kept = store.read(digest)
                if kept is None:
                    features = source.maps(scenes[index].image[None])
                    place = features.placement
                    placed = [*place.size, *place.scale, *place.offset, *features.canvas]
                    halves = {name: each[0].half() for name, each in features.maps.items()}
                    kept = halves | {"placed": torch.tensor(placed, dtype=torch.float64)}
                    store.write(digest, kept)
                width, height, across, down, left, top, *canvas = kept["placed"].tolist()
                placement = Placement((int(width), int(height)), (across, down), (left, top))
                maps = {name: kept[name][None] for name in source.layers}
                yield (
                    FeatureMaps(maps, (int(canvas[0]), int(canvas[1])), placement, Detections.empty(0, 0)),
                    people[str(name)],
                )

        groups += _grouped(seen(), data.seconds[number] if number < len(data.seconds) else 3.0, number)
    return groups


_Seen = tuple[FeatureMaps, Sequence[Fixations]]  # the maps of a picture, and the fixations in it


def _grouped(seen: Iterable[_Seen], seconds: float = 3.0, source: int = 0) -> list[Viewed]:
    """Pictures of one data set with the scanpaths in them, by the size of the pictures."""
    kept: dict[Any, list[_Seen]] = {}
    with torch.inference_mode():
        for features, people in seen:
            size = features.placement.size
            moved = tuple(each.resized(size) for each in people)
            kept.setdefault((features.placement, features.canvas), []).append((features, moved))
    groups = []
    for several in kept.values():
        first = several[0][0]
        maps = {name: torch.cat([features.maps[name].half() for features, _ in several]) for name in first.maps}
        everyone = tuple(tuple(some) for _, some in several)
        groups.append(Viewed(replace(first, maps=maps, detections=Detections.empty(0, 0)), everyone, seconds, source))
    return groups


class Events(NamedTuple):
    """Fixations to be predicted, all but the first of a path: those before `(E, N, 2)`, cell and person."""

    before: Tensor
    cell: Tensor
    person: Tensor

    @classmethod
    def of(cls, paths: Sequence[Tensor], size: tuple[int, int], cells: tuple[int, int]) -> "Events":
        """The events of a picture of `(height, width)` with cells `(rows, columns)`."""
        before = [torch.zeros(0, LONGEST - 1, 2)]
        for path in paths:
            padded = F.pad(path, (0, 0, LONGEST - 1, 0), value=math.nan)
            before.append(padded.unfold(0, LONGEST - 1, 1)[1 : len(path)].mT)
        cell = _numbers_of_cells(torch.cat([torch.zeros(0, 2), *(path[1:] for path in paths)]), size, cells)
        person = torch.arange(len(paths)).repeat_interleave(torch.tensor([len(path) - 1 for path in paths]).long())
        return cls(torch.cat(before), cell, person)

    def some(self, index: Tensor) -> "Events":
        return Events(*(each[index] for each in self))


def log_centre(groups: Sequence[Viewed], pictures: Sequence[Sequence[int]], *, blur: float = 2.5) -> Tensor:
    """Log density of all fixations of data sets, all alike, blurred and mixed with 2 % uniform, on 39 × 52 cells."""
    total, floor = torch.zeros(39, 52), 0.02
    for group, some in zip(groups, pictures, strict=True):
        if len(some):
            seen = group.counts[torch.as_tensor(some)].sum(0)
            smooth = blurred(F.interpolate(seen[None, None], total.shape, mode="bilinear")[0, 0], torch.tensor(blur))
            total += smooth / smooth.sum()
    return ((1 - floor) * total / total.sum() + floor / total.numel()).log()
