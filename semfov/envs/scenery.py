"""The parts that environments share: scenes, the eye that looks at them, and the belief about them."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from semfov.belief.grid import check_cells
from semfov.belief.observers import LearnedMap, Observer, Target
from semfov.data import Annotation, Scenes, class_index
from semfov.data.large import open_large
from semfov.data.mosaics import Mosaics
from semfov.data.pictures import Pictures
from semfov.data.sources import PHOTOGRAPHS
from semfov.detection.objects import LEAST
from semfov.episode import StoredLooks
from semfov.errors import DataError, InputError, check, check_whole
from semfov.fit.policy_looking import PolicyLooking
from semfov.fit.protocols import Trial, episodes_of, explorations_of
from semfov.fit.window_looking import WindowLooking, WindowLookingConfig, found_in
from semfov.gaze.acquisition.base import Task
from semfov.metrics.episodes import answers_of
from semfov.runs.config import (
    BeliefConfig,
    DataConfig,
    DetectorConfig,
    PolicyConfig,
    ProtocolConfig,
    RunConfig,
    SensorConfig,
)
from semfov.sensor.named import SensorName
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook
from semfov.zoom.objects import merge

_Source = Scenes | str | Path | None  # scenes of any kind, or a folder of photographs; None for the embedded scenes

_Targets = Sequence[str | int] | None

_VIEWS = 16  # number of pictures that are kept open for glimpses


class _Surroundings:
    """What environments of all kinds share: scenes, and an eye that looks at them, `shifts` times after the first."""

    def __init__(self, looking: Any, shifts: int, targets: _Targets, opened: partial[Any]) -> None:
        self.pictures, self.eye, self.shifts, self.opened = looking.scenes, looking.eye, shifts, opened
        classes, names = self.pictures.classes, self.eye.detector.classes
        check(classes == names, "scenes", "the classes of the detector", f"{len(classes)} others")
        self.classes, self.pixels = ("background", *names), math.prod(self.eye.detector.input_size)
        self._chosen = None if targets is None else sorted({class_index(each, names, "targets") for each in targets})

    def __reduce__(self) -> tuple[Any, ...]:
        """Tell pickle that a copy opens the same scenes again."""
        return self.opened, ()

    def image(self, scene: int) -> Tensor:
        """Pixels of a scene, `(3, H, W)`."""
        return self.pictures[scene].image

    def targets(self, scene: int) -> list[int]:
        """Classes that a scene may be searched for."""
        return [each for each in self.pictures.targets(scene) if self._chosen is None or each in self._chosen]


class Scenery(_Surroundings):
    """Scenes, an eye and a belief that environments share; the looks at a scene that is entered are kept on disk."""

    def __init__(self, looking: PolicyLooking, targets: _Targets, opened: partial[Any]) -> None:
        super().__init__(looking, looking.config.protocol.shifts, targets, opened)
        self._looking = looking
        self.policy = next(iter(looking.policies))
        belief, self.protocol = looking.config.belief, looking.config.protocol
        self.shape, self.annotation = (belief.rows, belief.columns), self.pictures.annotation
        self.observer: Observer = looking.strategies[self.policy].observer
        searching = looking.task == "search"
        labels = self.targets if searching else lambda scene: self.annotation(scene).labels.tolist()
        self.scenes = [scene for scene in range(len(self.pictures)) if labels(scene)]
        # Results are kept for as long as an environment uses this scenery.
        self.episodes = cache(self._list)
        self.grid = cache(looking.grid)
        self.answers = cache(lambda scene: answers_of(self.annotation(scene), self.grid(scene), len(self.classes)))
        self.open = cache(self._open)
        # The observer that computes a batch at once: faster, but its rounding depends on the batch.
        self.together = self.observer
        if isinstance(self.observer, Target | LearnedMap):
            self.together = type(self.observer)(self.observer.model, together=True)  # type: ignore[arg-type]
        self.view = lru_cache(_VIEWS)(lambda scene: self.eye.open(self.image(scene)[None]))
        if not any(self.episodes(scene) for scene in self.scenes):
            raise DataError(
                "scenes: expected at least one with objects to look for, got none; change scenes or targets"
            )

    def _list(self, scene: int) -> list[Any]:
        """All episodes of a scene: its searches or explorations, with the starts that the protocol draws."""
        rows, columns = self.shape
        if self._looking.task == "search":
            return list(episodes_of(self.pictures, scene, columns, rows, self.protocol, self.targets(scene)))
        if not self.answers(scene).any():
            return []
        return list(explorations_of(self.pictures, scene, columns * rows, self.protocol))

    def draw(self, random: np.random.Generator) -> Any:
        """Draw an episode: all scenes are equally likely, and so are all episodes of a scene."""
        while True:
            episodes = self.episodes(self.scenes[random.integers(len(self.scenes))])
            if episodes:
                return episodes[random.integers(len(episodes))]

    def _open(self, scene: int) -> StoredLooks:
        cues = sorted({episode.cue for episode in self.episodes(scene) if isinstance(episode, Trial)})
        targets = torch.tensor(cues) if cues else None
        return StoredLooks(self._looking.detections(scene), self.grid(scene), targets)


class _SceneLooking(PolicyLooking):
    """Looks at the scenes of an environment, or at mosaics of them, with so many `tiles` in a row and a column."""

    def __init__(self, config: RunConfig, task: Task, scenes: _Source, mosaics: int, tiles: tuple[int, int]) -> None:
        self.task, self._chosen, self._mosaics, self._tiles = task, scenes, mosaics, tiles
        super().__init__(config)

    def open_scenes(self) -> Scenes:
        given, seed = self._chosen, self.config.data.scene_seed
        scenes = super().open_scenes() if given is None or isinstance(given, str | Path) else given
        return Mosaics(scenes, *self._tiles, count=self._mosaics, seed=seed) if self._mosaics else scenes


def open_scenery(
    task: Task,
    scenes: _Source = None,
    annotations: str | Path | None = None,
    *,
    count: int | None = None,
    mosaics: int = 0,
    tiles: tuple[int, int] = (2, 2),
    targets: Sequence[str | int] | None = None,
    detector: str = "yolox-nano",
    weights: str | Path | None = None,
    sensor: SensorName = "gradual",
    policy: str | PolicyConfig = "recommended",
    grid: tuple[int, int] = (10, 10),
    shifts: int | None = None,
    starts: int = 100,
    seed: int = 0,
    cache: str | Path | None = None,
    store: bool = True,
    config: RunConfig | None = None,
) -> Scenery:
    """Open scenes for environments of search or exploration.

    Args:
        task: `search` or `exploration`.
        scenes: embedded scenes (None), the folder of a data set in COCO's format, or any `Scenes` with the detector's
            classes.
        annotations: COCO-format instances file of the folder.
        count: use only the first scenes, this many (None: all of a folder, 8 embedded ones).
        mosaics: number of mosaics to compose of the scenes; 0 takes the scenes as they are.
        tiles: number of photographs in a row and in a column of a mosaic.
        targets: classes to search for, by name or index; None takes all that a scene allows.
        detector: name of a detector, or path of an ONNX model.
        weights: file with the detector's weights.
        sensor: name of the foveal sensor (`semfov.sensor.SENSORS`).
        policy: preset or settings of `eval.search` or `eval.explore`. It determines the belief that the environment
            keeps.
        grid: number of columns and rows of the cells.
        shifts: largest number of gaze shifts of an episode (None: 30 in a search, 20 in an exploration).
        starts: number of starts for each scene and target, from which episodes are drawn.
        seed: of embedded scenes, mosaics and starts.
        cache: folder for stored looks (None: the user's cache).
        store: whether looks are kept on disk.
        config: all settings of an evaluation, instead of these arguments; its scenes may be given as `scenes` too.

    Returns:
        The scenery, to be shared by environments.

    Raises:
        InputError: an argument is out of range, or the scenes have other classes than the detector.
        DataError: photographs, annotations or weights are missing or damaged.

    Example::

        scenery = open_scenery("search", "photographs/", "instances.json", targets=["cat", "cup"])
        envs = [GazeSearch(scenery, belief=True) for _ in range(4)]
    """
    arguments = {**locals()}
    check(task in ("search", "exploration"), "task", "'search' or 'exploration'", repr(task))
    check_whole(mosaics, "mosaics", 0, 1_000_000)
    kind = scenes is None or isinstance(scenes, str | Path) or hasattr(scenes, "__len__")
    check(kind, "scenes", "a folder or `Scenes` (count= says how many)", scenes)
    check_cells(grid)
    if config is None:
        folder = Path(scenes) if isinstance(scenes, str | Path) else None
        notes = None if annotations is None else Path(annotations)
        config = RunConfig(
            data=DataConfig(folder, notes, count, min_instances=0, scene_seed=seed),
            detector=DetectorConfig(detector, None if weights is None else Path(weights)),
            sensor=SensorConfig(sensor),
            belief=BeliefConfig(columns=grid[0], rows=grid[1]),
            protocol=ProtocolConfig(starts, shifts or (30 if task == "search" else 20), seed=seed),
            policies=(policy,),
            cache=None if cache is None else Path(cache),
            store=store,
        )
    check(isinstance(config, RunConfig), "config", "settings of an evaluation", type(config).__name__)
    looking = _SceneLooking(replace(config, policies=config.policies[:1]), task, scenes, mosaics, tiles)
    return Scenery(looking, targets, partial(open_scenery, **arguments))


class ZoomScenery(_Surroundings):
    """Large pictures and an eye that zooms, which environments can share; `open_zoom_scenery` makes one."""

    def __init__(self, looking: WindowLooking, passes: int, targets: _Targets, opened: partial[Any]) -> None:
        super().__init__(looking, passes - 1, targets, opened)
        self.evidence, self.annotated = looking.evidence, not isinstance(self.pictures, Pictures)
        # Looks are kept for as long as an environment uses this scenery.
        self.looks_at = cache(looking.looks_at)
        self.episodes = cache(self._list)

    @cached_property
    def windows(self) -> int:
        """Largest number of windows of any of the pictures."""
        pictures, eye = self.pictures, self.eye
        if isinstance(pictures, Pictures):
            sizes = [open_large(pictures.root / str(name)).size for name in pictures.ids]
        else:
            sizes = [pictures.annotation(index).size for index in range(len(pictures))]
        return max(len(Lattice.over(size, eye.detector.input_size, finest=eye.finest)) for size in set(sizes))

    def targets(self, scene: int) -> list[int]:
        if self.annotated:
            return super().targets(scene)
        if self._chosen is None:
            raise InputError("targets: expected classes to search for in pictures without annotations, got none")
        return self._chosen

    def _list(self, scene: int) -> list[int]:
        """Targets of all searches of a picture: those that the look at the whole picture does not show already."""
        source = self.looks_at(scene)
        first = source.see([Window.overview(source.lattice)])[0]
        return [target for target in self.targets(scene) if not self.found([first], scene, target)]

    def draw(self, random: np.random.Generator, task: str, scene: int | None = None) -> tuple[int, int]:
        for _ in range(1000):
            picture = int(random.integers(len(self.pictures))) if scene is None else scene
            if task != "search":
                if not self.annotated or len(self.pictures.annotation(picture).boxes):
                    return picture, 0
            elif targets := self.episodes(picture):
                return picture, targets[random.integers(len(targets))]
        raise DataError(
            "scenes: expected pictures with objects to look for, found none; give other pictures or targets"
        )

    def found(self, looks: Sequence[WindowLook], scene: int, target: int) -> bool:
        """Whether looks have found an object of the target class: by its box, or without annotations by the score."""
        if not self.annotated:
            return any(float(look.show[target - 1]) >= LEAST for look in looks)
        every = self.pictures.annotation(scene)
        there = every.labels == target
        objects = Annotation(every.boxes[there], every.labels[there], every.crowd[there], every.size)
        return bool(found_in(looks, objects, target).any())

    def share(self, looks: Sequence[WindowLook], scene: int) -> float:
        if not self.annotated:
            return float(len(merge(looks, None, score=LEAST)))
        return float(found_in(looks, self.pictures.annotation(scene)).float().mean())


class _PictureLooking(WindowLooking):
    """Given large pictures, or those of a folder without annotations."""

    def __init__(self, config: WindowLookingConfig, scenes: _Source) -> None:
        self._chosen = scenes
        super().__init__(config)

    def open_scenes(self, classes: tuple[str, ...]) -> Scenes:
        if self._chosen is not None and not isinstance(self._chosen, str | Path):
            return self._chosen
        if self._chosen is None or self.config.data.annotations is not None:
            return super().open_scenes(classes)
        root = Path(self._chosen)
        if not root.is_dir():
            raise DataError(f"scenes: no such folder: {root}; check the path")
        names = [path.name for path in root.iterdir() if path.suffix.lower() in PHOTOGRAPHS]
        if not names:
            raise DataError(f"scenes: expected pictures ({', '.join(PHOTOGRAPHS)}) in {root}, found none")
        return Pictures(root, names, classes)


def open_zoom_scenery(
    scenes: _Source = None,
    annotations: str | Path | None = None,
    *,
    count: int | None = None,
    mosaics: int | None = None,
    tiles: tuple[int, int] = (4, 4),
    targets: Sequence[str | int] | None = None,
    detector: str = "yolox-nano",
    weights: str | Path | None = None,
    passes: int = 24,
    seed: int = 0,
    cache: str | Path | None = None,
    store: bool = True,
) -> ZoomScenery:
    """Open large pictures for environments.

    Args:
        scenes: embedded scenes (None), a folder of large pictures, or any `Scenes` with the detector's classes.
        annotations: COCO-format instances file of the folder. Without one the objects in the pictures are unknown, and
            those that the detector shows with a score of 0.3 count.
        count: use only the first scenes, this many (None: all of a folder, 8 embedded ones).
        mosaics: number of mosaics to compose of the scenes; 0 takes the scenes as they are (None: 8 of embedded scenes,
            otherwise 0).
        tiles: number of photographs in a row and in a column of a mosaic.
        targets: classes to search for, by name or index; None takes all that a picture allows.
        detector: name of a detector for which evidence by magnification is shipped.
        weights: file with the detector's weights.
        passes: largest number of looks of an episode, the first one at the whole picture included.
        seed: of embedded scenes and mosaics.
        cache: folder for stored looks (None: the user's cache).
        store: whether looks are kept on disk.

    Returns:
        The scenery, to be shared by environments.

    Raises:
        InputError: an argument is out of range, or the scenes have other classes than the detector.
        DataError: pictures, annotations or weights are missing or damaged.

    Example::

        scenery = open_zoom_scenery("aerial/", targets=["person"], detector="yolox-nano")
        env = ZoomEnv("search", scenery, belief=True)
    """
    arguments = {**locals()}
    check_whole(passes, "passes", 2, 100_000)
    data = DataConfig(limit=count, min_instances=0, max_target_area=None, scene_seed=seed)
    if annotations is not None:
        folder = Path(scenes) if isinstance(scenes, str | Path) else None
        data = replace(data, root=folder, annotations=Path(annotations), max_target_area=0.2)
    config = WindowLookingConfig(
        data=data,
        detector=DetectorConfig(detector, None if weights is None else Path(weights)),
        mosaics=(8 if scenes is None else 0) if mosaics is None else mosaics,
        columns=tiles[0],
        rows=tiles[1],
        seed=seed,
        cache=None if cache is None else Path(cache),
        store=store,
    )
    return ZoomScenery(_PictureLooking(config, scenes), passes, targets, partial(open_zoom_scenery, **arguments))
