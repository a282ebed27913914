"""Experiments with an eye in a head that turns: search and exploration over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import chain, pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from eval.comparison.records import own_settings
from eval.head.scan import Scan
from semfov.belief.belief import Belief
from semfov.belief.observers import SemanticMap, SemanticSearch
from semfov.data.mosaics import Mosaics
from semfov.data.scene import Scenes
from semfov.detection.detections import Detections
from semfov.episode.stopwatch import Stopwatch
from semfov.errors import DataError, check
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.head.belief import SceneObserver
from semfov.head.closer import CloserLookOffers
from semfov.head.episode import Detect, HeadStep, live, look_around
from semfov.head.gain import FORESIGHT, UNSEEN, UNSEEN_CHANCE, ExploreGain, LookGain, PerSecond, SearchGain
from semfov.head.panoramas import Panoramas
from semfov.head.scenes import Flat, Panorama, World
from semfov.head.speeds import Speeds
from semfov.head.views import Views
from semfov.io.ranges import Count, Positive, Range, Seed, Share, Weight, Whole
from semfov.metrics.episodes import right_cells
from semfov.runs.config import DataConfig, SensorConfig, WorkConfig
from semfov.runs.looks import LOOK_SOURCES, tight
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import SceneRun, store_folder
from semfov.runs.setup import make_eye, make_map, make_scenes, make_searching
from semfov.runs.store import DetectionStore, RememberedLooks
from semfov.sensor.sphere import Boxes

OURS = "semfov"
"""Name of the method that the others are compared with."""

_MOSAIC = 240.0
"""Width in degrees of a mosaic of 4 × 4 photographs."""

_LOOKS = (*LOOK_SOURCES, "semfov.head.views", "semfov.head.panoramas", "semfov.data.mosaics", "semfov.head.episode")
"""Modules that turn a scene into looks; all modules that they import count, too."""

Degrees = Annotated[float, Range(1, 170)]


@dataclass(frozen=True)
class HeadConfig(WorkConfig):
    """An eye in a head that turns, in scenes larger than its field of view: search and exploration.

    Args:
        data: the photographs from which scenes are composed (without a root: the embedded scenes).
        detector: the detector, which is applied to each foveated view.
        scene: `panorama`, photographs on a sphere around the viewer, or `mosaic`, photographs side by side in front.
        scenes: number of panoramas or mosaics to compose.
        targets: number of classes to search for in each scene, drawn at random; 0 leaves out the searches.
        explore: whether to run explorations, too.
        fields: fields of view in degrees; with several, the head can zoom.
        width: width of a scene in pixels: of a panorama's 360 degrees, or of a mosaic, which is 240 degrees wide.
        passes: largest number of looks in an episode.
        seconds: longest duration of an episode, in simulated seconds.
        speeds: speeds of eye and head.
        dwell: number of looks from each pose of a head that scans the scene in a fixed order.
        foresight: in searches, weight of what a look reveals away from the gaze, relative to a find at the gaze.
        prior: probability that a cell that was never seen holds the target.
        unseen: in explorations, assumed probability that the first fixation of a cell names it right.
        seed: random seed of scenes, targets, starts and tie-breaking.
        out: folder for tables, records and figures.
        cache: folder for the stored looks, shared between runs (None: the user's cache).
        store: keep looks on disk; false computes them anew in each run (the result is the same).
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    scene: Literal["panorama", "mosaic"] = "panorama"
    scenes: Count = 20
    targets: Whole = 3
    explore: bool = True
    fields: tuple[Degrees, ...] = (60.0,)
    width: Annotated[int, Range(64, 65_536)] = 2560
    passes: Annotated[int, Range(1, 10_000)] = 60
    seconds: Positive = 20.0
    speeds: Speeds = field(default_factory=Speeds)
    dwell: Count = 2
    foresight: Weight = FORESIGHT
    prior: Share = UNSEEN_CHANCE
    unseen: Weight = UNSEEN
    seed: Seed = 0
    out: Path = Path("runs/head")
    store: bool = True


class HeadRun(SceneRun):
    """Scenes, eye and models of a run; every process builds its own from the settings."""

    config: HeadConfig

    def __init__(self, config: HeadConfig) -> None:
        self.config = config
        check(0 < config.prior < 1, "prior", "a probability above 0 and below 1", config.prior)
        self.eye = make_eye(config.detector, SensorConfig())
        self.fovea = SensorConfig().fovea
        self.searching = make_searching(None, self.eye)
        self.observation = make_map(None, self.eye)
        photographs = make_scenes(config.data, self.eye.detector.classes)
        if not len(photographs):
            raise DataError("data: the settings select no photograph; lower data.min_instances or raise data.limit")
        self.scenes = _composed(photographs, config)
        looks = {"eye": self.eye.settings(), "fields": config.fields}
        components = len(self.eye.detector.classes) + 1
        self.store = DetectionStore(store_folder(config.cache) / "head", looks, _LOOKS, components)

    def depends_on(self) -> dict[str, Any]:
        """List the eye, its models and the settings."""
        models = [self.searching, self.observation]
        return {"eye": self.eye.settings(), "models": models, "settings": own_settings(self.config)}

    def world(self, index: int) -> World:
        """Return the scene as a world in which the head looks around."""
        image = self.scenes[index].image
        speeds = self.config.speeds
        if self.config.scene == "panorama":
            return Panorama(image, speeds=speeds)
        return Flat(image, speeds=speeds, degree=image.shape[-1] / _MOSAIC)

    def places(self, index: int) -> Boxes:
        """Return the places of the scene's objects."""
        scenes = self.scenes
        return scenes.regions(index) if isinstance(scenes, Panoramas) else Boxes(scenes.annotation(index).boxes)

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Run the searches and the exploration of a scene with every way of moving eye and head; returns records."""
        watch = Stopwatch()
        config = self.config
        views = Views(self.world(index), config.fields, fovea=self.fovea)
        store = self.store if config.store else None

        def open_scene() -> Detect:
            detect = live(self.eye, views)
            return lambda action: tight(detect(action))

        looks = RememberedLooks(open_scene, store, lambda: self.scenes.digest(index))
        closely = open_scene()
        lattice = views.lattice * views.cells

        def detect(action: int) -> Detections:
            """Detect, or remember; closer looks have other numbers in each run."""
            return looks(action) if action < lattice else closely(action)

        watch.lap("scene")
        try:
            with torch.inference_mode():
                records = self._searches(index, views, detect)
                watch.lap("search")
                if config.explore:
                    records += self._explorations(index, views, detect)
                watch.lap("exploration")
        finally:
            looks.save()  # even when the run is stopped
        return records, watch.seconds

    def ways(self, gain: LookGain, start: int) -> dict[str, Callable[[int], AcquisitionFunction]]:
        """Every way of moving eye and head, by its name in the tables: its acquisition function after an action."""
        views = gain.views
        config = self.config
        pose = start // views.cells
        order = _tiling_order(views, pose)
        shuffled = np.random.Generator(np.random.PCG64([config.seed, start])).permutation(order[1:]).tolist()
        return {
            OURS: lambda action: PerSecond(gain, config.speeds, action),
            "semfov, half a view apart": lambda action: PerSecond(gain, config.speeds, action, range(len(views))),
            "semfov, blind to time": lambda action: PerSecond(gain, None, action),
            "head in raster order": lambda action: Scan(gain, order, config.dwell, action),
            "head in random order": lambda action: Scan(gain, [pose, *shuffled], config.dwell, action),
            "random head and eye": lambda action: _Anywhere(views),
            "eye alone": lambda action: Scan(gain, [pose], 1, action),
        }

    def start(self, index: int, views: Views, what: int) -> int:
        """First action of the episodes for a target (0: an exploration): the centre of a random view of the tiling."""
        generator = np.random.Generator(np.random.PCG64([self.config.seed, index, what]))
        poses = [*chain(*views.tiling)]
        return int(generator.choice(poses)) * views.cells + views.cells // 2 + 5

    def targets(self, index: int) -> list[int]:
        """Return the classes to search for in a scene."""
        generator = np.random.Generator(np.random.PCG64([self.config.seed, index]))
        legal = self.scenes.targets(index)
        return sorted(generator.permutation(legal)[: self.config.targets].tolist())

    def _searches(self, index: int, views: Views, detect: Detect) -> list[ResultRecord]:
        """Search a scene for its targets with every way of moving eye and head."""
        places = self.places(index)
        labels = self.scenes.annotation(index).labels
        gain = SearchGain(views, self.config.foresight)
        belief = SemanticSearch(self.searching, footprint="overlap")
        observer = SceneObserver(belief, views, unseen_chance=self.config.prior)
        records: list[ResultRecord] = []
        for target in self.targets(index):
            target_places = places[labels == target]
            start = self.start(index, views, target)
            if bool(_rests_on(views, start, target_places).any()):
                continue  # no search starts on its target
            for name, acquire in self.ways(gain, start).items():
                steps: list[HeadStep] = []
                found = False
                for step in self._steps(index, name, acquire, gain, observer, detect, start, target):
                    steps.append(step)
                    found = bool(_rests_on(views, step.action, target_places).any())
                    if found:
                        break
                records.append(
                    {
                        "task": "search",
                        "way": name,
                        "scene": self.scenes.ids[index],
                        "target": self.scenes.classes[target - 1],
                        "found": found,
                        "passes": len(steps),
                        "seconds": steps[-1].seconds,
                        "turns": turns(steps, views),
                        "actions": [step.action for step in steps],
                    }
                )
        return records

    def _explorations(self, index: int, views: Views, detect: Detect) -> list[ResultRecord]:
        """Explore a scene with every way of moving eye and head."""
        labels = self.scenes.annotation(index).labels
        answers = _scene_answers(views, self.places(index), labels, len(self.scenes.classes))
        weight = views.world.area * answers.any(-1)  # only cells with an answer count
        gain = ExploreGain(views, self.config.unseen)
        observer = SceneObserver(SemanticMap(self.observation), views)
        start = self.start(index, views, 0)
        records: list[ResultRecord] = []
        for name, acquire in self.ways(gain, start).items():
            seconds: list[float] = []
            success: list[float] = []
            objects: list[float] = []
            actions: list[int] = []
            for step in self._steps(index, name, acquire, gain, observer, detect, start, None):
                # A cell that was never seen gets no answer, even if the prior favours a class.
                is_unseen = step.belief.owner[..., None] < 0
                probabilities = step.belief.class_probabilities().masked_fill(is_unseen, 0.0)
                success.append(_share_right(probabilities, answers, weight))
                objects.append(_share_right(probabilities[..., 1:], answers[:, 1:], weight))
                seconds.append(step.seconds)
                actions.append(step.action)
            records.append(
                {
                    "task": "exploration",
                    "way": name,
                    "scene": self.scenes.ids[index],
                    "seconds": seconds,
                    "success": success,
                    "objects": objects,
                    "actions": actions,
                }
            )
        return records

    def _steps(
        self,
        index: int,
        way: str,
        acquire: Callable[[int], AcquisitionFunction],
        gain: LookGain,
        observer: SceneObserver,
        detect: Detect,
        start: int,
        target: int | None,
    ) -> Iterator[HeadStep]:
        """Look around a scene in one of the `ways`; our own one offers closer looks where the head zooms."""
        config = self.config
        views = gain.views
        zooms = len(views.fields) > 1
        return look_around(
            views,
            detect,
            observer,
            acquire,
            start,
            target=target,
            closer=CloserLookOffers(gain, config.speeds, target) if way == OURS and zooms else None,
            passes=config.passes,
            duration=config.seconds,
            seed=[config.seed, index, target or 0],
        )


def _composed(photographs: Scenes, config: HeadConfig) -> Scenes:
    """Compose scenes of photographs: panoramas, or mosaics of 4 × 4 photographs of 4:3."""
    if config.scene == "panorama":
        return Panoramas(photographs, width=config.width, count=config.scenes, seed=config.seed)
    tile = (config.width // 4, config.width * 3 // 16)
    return Mosaics(photographs, 4, 4, tile=tile, count=config.scenes, seed=config.seed)


def _share_right(probabilities: Tensor, answers: Tensor, weight: Tensor) -> float:
    """Compute the share of the cells whose most probable class is right.

    Args:
        probabilities: `(1, S, C)`.
        answers: `(S, C)` boolean, the right classes of each cell.
        weight: `(S,)`, how much each cell counts.
    """
    is_right = right_cells(probabilities, answers)[0]
    return float((is_right * weight).sum() / weight.sum())


def turns(steps: list[HeadStep], views: Views) -> int:
    """Count the times that the head moved."""
    poses = [step.action // views.cells for step in steps]
    return sum(one != other for one, other in pairwise(poses))


def _tiling_order(views: Views, pose: int) -> list[int]:
    """List the poses that tile the scene in the order of a scan from `pose` on: row by row, alternating direction."""
    snake: list[int] = []
    for number, row in enumerate(views.tiling):
        snake += row if number % 2 == 0 else row[::-1]
    first = snake.index(pose)
    return snake[first:] + snake[:first]


def _scene_answers(views: Views, places: Boxes, labels: Tensor, classes: int) -> Tensor:
    """Which classes are right for each cell of the scene, those of the objects that overlap it.

    A cell and an object overlap if the object contains the cell's centre, or the cell contains one of the points
    sampled over the object. Cells that no view shows have no answer.

    Shapes: labels `(M,)` → `(S, K+1)`.
    """
    world = views.world
    samples = places.samples()
    cells = world.scene.cell_of(world.pixels_of(samples.flatten(0, 1))).view(samples.shape[:2])
    overlap = torch.zeros(len(places), len(world.scene), dtype=torch.bool).scatter(-1, cells, True)
    overlap |= places.contain(world.centres)
    overlap &= views.reachable
    return overlap.T.float() @ F.one_hot(labels, classes + 1).float() > 0


class _Anywhere(AcquisitionFunction):
    """Baseline: a pose of the head and a fixation of the eye, drawn at random."""

    def __init__(self, views: Views) -> None:
        super().__init__()
        self.views = views

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Return the same value for all actions, `(1, A)`."""
        return torch.zeros(1, len(self.views.grid))


def _rests_on(views: Views, action: int, places: Boxes) -> Tensor:
    """Which objects overlap the cell that an action fixates.

    A cell and an object overlap if one contains a point of the other. 9 × 9 points spread over each are tested.

    Shapes: → `(M,)`.
    """
    pose, cell = divmod(action, views.cells)
    edges = views.view_grid.edges[cell]
    share = torch.linspace(0, 1, 9)
    y, x = torch.meshgrid(share, share, indexing="ij")
    shares = torch.stack([x, y], -1).flatten(0, 1)  # (81, 2), of the sides of the cell
    inside = edges[:2] + shares * (edges[2:] - edges[:2]) - 0.5
    held = places.contain(views.world.to_scene(inside, views.poses[pose])).any(-1)
    if bool(held.all()):
        return held
    samples = places.samples()
    points, _ = views.world.to_view(samples.flatten(0, 1), views.poses[pose])
    within = ((points + 0.5 >= edges[:2]) & (points + 0.5 <= edges[2:])).all(-1)
    return held | within.view(samples.shape[:2]).any(-1)
