"""Data of free viewing: people's fixations, and a detector's feature maps of the pictures."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.fixations import Fixations, by_picture
from semfov.data.large import picture_size
from semfov.data.pictures import Pictures
from semfov.detection import Detections, Detector, FeatureMaps, Placement
from semfov.errors import check
from semfov.gaze.saliency.fixation_density import FixationDensity, blurred, cells_of
from semfov.human.fixations.reading import check_usual_frame, frame_of, read_fixations
from semfov.io.code import modules_digest
from semfov.io.files import sha256
from semfov.io.ranges import Count, Range
from semfov.io.schema import Field, Schema
from semfov.runs.looks import LOOK_SOURCES
from semfov.runs.progress import track
from semfov.runs.scene_run import digest_of, store_folder
from semfov.runs.settings import Settings
from semfov.runs.store import SceneStore

LONGEST = 20  # number of fixations of a scanpath that are used, the first ones
_SECONDS = 3.0  # time for which people view a picture, where none is given

_BLUR = 2.5  # standard deviation in cells by which the centre bias is blurred
_UNIFORM = 0.02  # share of a uniform density in the centre bias, which keeps its logarithm finite
_LAYERS = ("backbone8", "backbone16", "backbone32", "head8", "head16", "head32")


@dataclass(frozen=True)
class ViewingData(Settings):
    """Pictures, and the fixations of people in them.

    Args:
        fixations: a file of fixations for each data set, in any format that `semfov check` reads.
        pictures: folder of the pictures of each data set.
        sizes: frame of each file that has none, as `640x480` (none: 800x600 of OSIE, if its pictures have this size).
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
        files = len(self.fixations)
        for name, thing in {"pictures": "folder", "sizes": "frame", "seconds": "time"}.items():
            count = len(getattr(self, name))
            may_lack = not files or (not count and name != "pictures")
            expected = f"a {thing} for each of {files} files of fixations"
            check(may_lack or count == files, f"{self.within}{name}", expected, count)

    @property
    def fingerprint(self) -> list[str]:
        """sha256 of the pictures and of the fixations in them, for each data set."""
        digests = []
        for number, root in enumerate(self.pictures):
            pictures = Pictures(root, self.people(number), ())
            digests.append(digest_of([pictures.fingerprint, sha256(self.fixations[number])]))
        return digests

    def people(self, number: int) -> dict[str, list[Fixations]]:
        """Read the scanpaths of a data set by picture, without scanpaths of a single fixation."""
        options = {"size": frame_of(self.sizes[number])} if number < len(self.sizes) else {}
        scanpaths = read_fixations(self.fixations[number], **options)
        pictures = by_picture(scanpath for scanpath in scanpaths if len(scanpath) > 1)
        return dict(islice(pictures.items(), self.limit))

    def seconds_of(self, number: int) -> float:
        """Return the time for which people viewed a picture of a data set."""
        return self.seconds[number] if number < len(self.seconds) else _SECONDS


@dataclass(frozen=True)
class Viewed:
    """P pictures of one size, with the scanpaths of all people in them.

    Attributes:
        features: their feature maps `(P, C, h, w)`, in half precision.
        people: the scanpaths in each picture.
        seconds: time for which people viewed a picture.
        source: number of the data set.
    """

    features: FeatureMaps
    people: tuple[tuple[Fixations, ...], ...]
    seconds: float = _SECONDS
    source: int = 0

    @property
    def size(self) -> tuple[int, int]:
        """`(height, width)` of the pictures."""
        return self.features.placement.size[1], self.features.placement.size[0]

    def __len__(self) -> int:
        return len(self.people)

    @cached_property
    def paths(self) -> list[list[Tensor]]:
        """The first fixations of each person in each picture, `(n, 2)`, in pixels of the picture."""
        return [[*map(_first_points, scanpaths)] for scanpaths in self.people]

    def some(self, pictures: Sequence[int]) -> FeatureMaps:
        """Select the feature maps of some pictures, in single precision."""
        numbers = torch.as_tensor(pictures)
        chosen = {name: maps[numbers].float() for name, maps in self.features.maps.items()}
        return replace(self.features, maps=chosen)

    @cached_property
    def counts(self) -> Tensor:
        """Numbers of fixations, without the first of each path, in the cells of each picture, `(P, rows, columns)`."""
        rows, columns = cells_of(self.size)
        return torch.stack([counted(paths, self.size, (rows, columns)).sum(0) for paths in self.paths])


def _first_points(scanpath: Fixations) -> Tensor:
    """Take the first fixations of a person, at most `LONGEST`, `(n, 2)`."""
    return torch.from_numpy(scanpath.points[:LONGEST]).float()


def counted(paths: Sequence[Tensor], size: tuple[int, int], cells: tuple[int, int]) -> Tensor:
    """Count the fixations of each path but its first in cells.

    Args:
        paths: fixations `(n, 2)` of each path, in pixels.
        size: `(height, width)` of the picture.
        cells: numbers of rows and columns.

    Returns:
        The counts, `(paths, rows, columns)`.
    """
    counts = torch.zeros(len(paths), cells[0] * cells[1])
    for row, path in zip(counts, paths, strict=True):
        numbers = _numbers_of_cells(path[1:], size, cells)
        row.index_add_(0, numbers, torch.ones(len(numbers)))
    return counts.unflatten(1, cells)


def _numbers_of_cells(points: Tensor, size: tuple[int, int], cells: tuple[int, int]) -> Tensor:
    """Find the cells that hold points, by number; those outside the picture belong to the nearest cell.

    Args:
        points: `(n, 2)`, x and y in pixels.
        size: `(height, width)` of the picture.
        cells: numbers of rows and columns.

    Returns:
        `(n,)`.
    """
    height, width = size
    rows, columns = cells
    x, y = (points + 0.5).unbind(-1)  # pixels begin at 0
    column = (x * (columns / width)).floor().clamp(0, columns - 1)
    row = (y * (rows / height)).floor().clamp(0, rows - 1)
    return (row * columns + column).long()


class MapSource(NamedTuple):
    """Protocol of sources of the feature maps of pictures.

    Attributes:
        layers: names of the maps.
        maps: computes them of a picture `(1, 3, H, W)`.
        what: the settings that they depend on.
    """

    layers: tuple[str, ...]
    maps: Callable[[Tensor], FeatureMaps]
    what: Mapping[str, object]


def features_of(detector: Detector, layers: Sequence[str] = ()) -> MapSource:
    """Read feature maps of a detector.

    Args:
        detector: the detector.
        layers: names of the maps (none: those of the shipped model, or else of the detector's backbone and head).

    Returns:
        The source of the maps.
    """
    shipped = None if layers else FixationDensity.if_shipped(detector.name)
    if shipped is not None:
        layers = tuple(shipped.layers)
    if not layers:
        available = detector.features(torch.zeros(1, 3, 64, 64)).maps
        layers = tuple(name for name in _LAYERS if name in available) or tuple(available)
    what = {"detector": detector.settings(), "layers": list(layers)}
    return MapSource(tuple(layers), lambda image: detector.features(image, [*layers]), what)


def look(data: ViewingData, source: MapSource) -> list[Viewed]:
    """Compute the feature maps of all pictures, or read them from the cache.

    Args:
        data: pictures and fixations.
        source: gives the maps.

    Returns:
        The pictures, those of one data set and size together.
    """
    store = _MapStore(data.cache, source)
    groups: list[Viewed] = []
    for number, root in enumerate(data.pictures):
        people = data.people(number)
        scenes = Pictures(root, people, ())
        if number >= len(data.sizes):
            sizes = (picture_size(Path(root) / name) for name in scenes.ids)
            check_usual_frame(data.fixations[number], f"{data.within}sizes", sizes, "{width}x{height}")
        groups += _grouped(_looks(store, scenes, people), data.seconds_of(number), number)
    return groups


_ViewedPicture = tuple[FeatureMaps, Sequence[Fixations]]  # the maps of a picture, and the fixations in it


def _looks(store: "_MapStore", scenes: Pictures, people: Mapping[str, Sequence[Fixations]]) -> Iterator[_ViewedPicture]:
    """Look at the pictures of a data set, one after the other."""
    for index, name in enumerate(track(scenes.ids, "looking", "picture")):
        yield store.maps(scenes, index), people[str(name)]


class _MapStore:
    """Maps of pictures in half precision, each computed once and kept on disk."""

    def __init__(self, cache: Path | None, source: MapSource) -> None:
        self.source = source
        # Dimensions are numbered, as a dash in the name of a layer would be a minus in theirs.
        fields = {
            name: Field((f"channels {n}", f"rows {n}", f"columns {n}"), torch.float16, finite=False)
            for n, name in enumerate(source.layers)
        }
        schema = Schema(fields | {"placed": Field((8,), torch.float64)})
        code = modules_digest(*LOOK_SOURCES, "semfov.gaze.saliency", "semfov.detection", __name__)
        self.store = SceneStore(store_folder(cache) / "viewing", source.what, code, schema)

    def maps(self, scenes: Pictures, index: int) -> FeatureMaps:
        """Read the maps of a picture, `(1, C, h, w)`, or compute and store them."""
        digest = scenes.digest(index)
        tensors = self.store.read(digest)
        if tensors is None:
            tensors = _pack(self.source.maps(scenes[index].image[None]))
            self.store.write(digest, tensors)
        return _unpack(tensors, self.source.layers)


def _pack(features: FeatureMaps) -> dict[str, Tensor]:
    """Convert the maps of one picture to tensors for a file."""
    placement = features.placement
    numbers = [*placement.size, *placement.scale, *placement.offset, *features.canvas]
    maps = {name: batch[0].half() for name, batch in features.maps.items()}
    return maps | {"placed": torch.tensor(numbers, dtype=torch.float64)}


def _unpack(tensors: Mapping[str, Tensor], layers: Sequence[str]) -> FeatureMaps:
    """Convert the tensors of `_pack` back to maps."""
    width, height, x_scale, y_scale, left, top, canvas_width, canvas_height = tensors["placed"].tolist()
    placement = Placement((int(width), int(height)), (x_scale, y_scale), (left, top))
    maps = {name: tensors[name][None] for name in layers}
    return FeatureMaps(maps, (int(canvas_width), int(canvas_height)), placement, Detections.empty(0, 0))


def _grouped(looks: Iterable[_ViewedPicture], seconds: float = _SECONDS, source: int = 0) -> list[Viewed]:
    """Collect the pictures of one data set with the scanpaths in them, by the size of the pictures."""
    by_size: dict[object, list[tuple[FeatureMaps, tuple[Fixations, ...]]]] = defaultdict(list)
    with torch.inference_mode():
        for features, people in looks:
            # Fixations may be in pixels of another frame than the picture's.
            scanpaths = tuple(scanpath.resized(features.placement.size) for scanpath in people)
            by_size[features.placement, features.canvas].append((features, scanpaths))
    groups = []
    for pictures in by_size.values():
        features_of_pictures, people_of_pictures = zip(*pictures, strict=True)
        groups.append(Viewed(_joined(features_of_pictures), people_of_pictures, seconds, source))
    return groups


def _joined(features: Sequence[FeatureMaps]) -> FeatureMaps:
    """Join the maps of several pictures of one size to a batch, in half precision."""
    first = features[0]
    maps = {}
    for name in first.maps:
        maps[name] = torch.cat([picture.maps[name].half() for picture in features])
    return replace(first, maps=maps, detections=Detections.empty(0, 0))


class Events(NamedTuple):
    """E fixations to be predicted: all fixations of scanpaths but the first ones.

    Attributes:
        before: `(E, N, 2)`, the fixations before each, the last one last; NaN where there were fewer.
        cell: `(E,)`, number of the cell.
        person: `(E,)`, number of the path.
    """

    before: Tensor
    cell: Tensor
    person: Tensor

    @classmethod
    def of(cls, paths: Sequence[Tensor], size: tuple[int, int], cells: tuple[int, int]) -> "Events":
        """Make the events of a picture of `(height, width)` with cells `(rows, columns)`."""
        before = [torch.zeros(0, LONGEST - 1, 2)]
        points = [torch.zeros(0, 2)]
        person = [torch.zeros(0, dtype=torch.long)]
        for number, path in enumerate(paths):
            predicted = path[1:]
            # The fixations before each one are a window of the path, padded at its beginning.
            padded = F.pad(path, (0, 0, LONGEST - 1, 0), value=math.nan)
            before.append(padded.unfold(0, LONGEST - 1, 1)[1 : len(path)].mT)
            points.append(predicted)
            person.append(torch.full((len(predicted),), number))
        return cls(torch.cat(before), _numbers_of_cells(torch.cat(points), size, cells), torch.cat(person))

    def some(self, index: Tensor) -> "Events":
        """Select events by number."""
        return Events(self.before[index], self.cell[index], self.person[index])


def log_centre(groups: Sequence[Viewed], pictures: Sequence[Sequence[int]]) -> Tensor:
    """Compute the log density of all fixations, blurred and mixed with 2 % of a uniform density.

    Args:
        groups: pictures of one size each, with everybody's scanpaths.
        pictures: numbers of the pictures of each group.

    Returns:
        The log density, `(39, 52)`.
    """
    total = torch.zeros(39, 52)
    for group, numbers in zip(groups, pictures, strict=True):
        if len(numbers):
            counts = group.counts[torch.as_tensor(numbers)].sum(0)
            # Pictures of all sizes have their fixations on the same cells.
            resized = F.interpolate(counts[None, None], total.shape, mode="bilinear")[0, 0]
            smooth = blurred(resized, torch.tensor(_BLUR))
            total += smooth / smooth.sum()
    return ((1 - _UNIFORM) * total / total.sum() + _UNIFORM / total.numel()).log()
