"""The parts that environments share: scenes, the eye that looks at them, and the belief about them."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property, lru_cache, partial
from inspect import signature
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from semfov.belief.grid import check_cells
from semfov.belief.observers import Observer
from semfov.data import Scenes, class_index
from semfov.data.large import open_large
from semfov.data.mosaics import Mosaics
from semfov.data.picture_files import PHOTOGRAPHS
from semfov.data.pictures import Pictures
from semfov.detection.objects import SCORE_THRESHOLD
from semfov.episode import StoredLooks
from semfov.errors import DataError, InputError, check, check_options, check_whole, type_of
from semfov.eye import Eye, View
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
from semfov.runs.policy_looking import PolicyLooking
from semfov.runs.protocols import Exploration, Trial, episodes_of, explorations_of
from semfov.runs.scene_run import digest_of
from semfov.runs.window_looking import WindowLooking, WindowLookingConfig, found_in
from semfov.sensor.named import SensorName
from semfov.zoom.eye import WindowEye
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook
from semfov.zoom.objects import merge

CellEpisode = Trial | Exploration
"""An episode whose actions are cells."""

_Source = Scenes | str | Path | None  # scenes of any kind, or a folder of photographs; None for the embedded scenes

_Targets = Sequence[str | int] | None

_Eye = TypeVar("_Eye", bound=Eye | WindowEye)

_VIEWS = 16  # number of pictures that are kept open for glimpses

_DRAWS = 1000  # number of pictures that are drawn in search of one with objects to look for


class _Surroundings(ABC, Generic[_Eye]):
    """Scenes, and an eye that looks at them: what environments of all kinds share.

    Args:
        pictures: the scenes.
        eye: looks at them; its detector has their classes.
        shifts: largest number of looks of an episode after the first one.
        targets: classes to search for, by name or index; None takes all that a scene allows.
        reopen: opens the same scenes again, in another process.

    Attributes:
        classes: names of the classes, background first.
        pixels: number of pixels that the detector gets in a look.

    Private attribute: `_chosen` has the indices of `targets`, in ascending order.
    """

    def __init__(
        self,
        pictures: Scenes,
        eye: _Eye,
        shifts: int,
        targets: _Targets,
        reopen: Callable[[], object],
    ) -> None:
        names = eye.detector.classes
        check(pictures.classes == names, "scenes", "the classes of the detector", f"{len(pictures.classes)} others")
        self.pictures = pictures
        self.eye = eye
        self.shifts = shifts
        self.reopen = reopen
        self.classes = ("background", *names)
        self.pixels = math.prod(eye.detector.input_size)
        self._chosen = None if targets is None else sorted({class_index(name, names, "targets") for name in targets})

    @cached_property
    def key(self) -> str:
        """sha256 of scenes, settings and models: the same wherever they are opened again.

        Raises:
            InputError: the scenes have no `fingerprint`.
        """
        fingerprint = getattr(self.pictures, "fingerprint", None)
        check(fingerprint is not None, "scenes", "a `fingerprint`, sha256 of what they depend on", "none")
        return digest_of(
            {
                "scenes": fingerprint,
                "shifts": self.shifts,
                "targets": self._chosen,
                **self._depends_on(),
            }
        )

    @abstractmethod
    def _depends_on(self) -> dict[str, object]:
        """List the models and the settings that episodes depend on, beside scenes, targets and shifts."""

    def __reduce__(self) -> tuple[Callable[[], object], tuple[()]]:
        """Tell pickle that a copy opens the same scenes again."""
        return self.reopen, ()

    def image(self, scene: int) -> Tensor:
        """Pixels of a scene, `(3, H, W)`."""
        return self.pictures[scene].image

    def targets(self, scene: int) -> list[int]:
        """Classes that a scene may be searched for."""
        targets = self.pictures.targets(scene)
        if self._chosen is None:
            return targets
        return [target for target in targets if target in self._chosen]


class Scenery(_Surroundings[Eye]):
    """Scenes, an eye and a belief that environments share; looks are stored on disk.

    Args:
        looking: the looks at the scenes, and the policy.
        targets: classes to search for, by name or index; None takes all that a scene allows.
        reopen: opens the same scenes again, in another process.

    Attributes:
        policy: label of the policy, which determines the belief.
        protocol: starts of the episodes, and the largest number of shifts.
        shape: numbers of rows and columns of the cells.
        observer: keeps the belief.
        scenes: numbers of the scenes with objects to look for.
        episodes: lists all episodes of a scene.
        grid: lays the cells over a scene.
        answers: tells the right classes of the cells of a scene, `(X·Y, C)` boolean.
        open: opens the stored looks at a scene.
        view: opens a scene for the eye.

    Raises:
        DataError: no scene has objects to look for.
    """

    def __init__(self, looking: PolicyLooking, targets: _Targets, reopen: Callable[[], object]) -> None:
        self.protocol = looking.config.protocol
        super().__init__(looking.scenes, looking.eye, self.protocol.shifts, targets, reopen)
        self._looking = looking
        self.policy = next(iter(looking.policies))
        self.shape = (looking.config.belief.rows, looking.config.belief.columns)
        self.annotation = self.pictures.annotation
        self.observer: Observer = looking.strategies[self.policy].observer
        # Results are kept for as long as an environment uses this scenery.
        self.episodes = cache(self._list)
        self.grid = cache(looking.grid)
        self.answers = cache(self._answers)
        self.open = cache(self._open)
        self.view = lru_cache(_VIEWS)(self._view)
        self.scenes = [scene for scene in range(len(self.pictures)) if self._has_objects(scene)]
        if not any(self.episodes(scene) for scene in self.scenes):
            raise DataError(
                "scenes: expected at least one with objects to look for, got none; change scenes or targets"
            )

    def _depends_on(self) -> dict[str, object]:
        return self._looking.depends_on()

    def _has_objects(self, scene: int) -> bool:
        """Whether a scene may be searched, or has anything to explore."""
        if self._looking.task == "search":
            return len(self.targets(scene)) > 0
        return len(self.annotation(scene).labels) > 0

    def _list(self, scene: int) -> list[CellEpisode]:
        """List all episodes of a scene: its searches or explorations, with the starts that the protocol draws."""
        rows, columns = self.shape
        if self._looking.task == "search":
            return list(episodes_of(self.pictures, scene, columns, rows, self.protocol, self.targets(scene)))
        if not self.answers(scene).any():
            return []
        return list(explorations_of(self.pictures, scene, columns * rows, self.protocol))

    def _answers(self, scene: int) -> Tensor:
        return answers_of(self.annotation(scene), self.grid(scene), len(self.classes))

    def _open(self, scene: int) -> StoredLooks:
        cues = sorted({episode.cue for episode in self.episodes(scene) if isinstance(episode, Trial)})
        targets = torch.tensor(cues) if cues else None
        return StoredLooks(self._looking.detections(scene), self.grid(scene), targets)

    def _view(self, scene: int) -> View:
        return self.eye.open(self.image(scene)[None])

    def draw(self, random: np.random.Generator) -> CellEpisode:
        """Choose an episode at random: all scenes are equally likely, and all episodes within a scene."""
        # A scene with objects may have no episode, as where a target lies in every cell. One scene at least has some.
        while True:
            episodes = self.episodes(self.scenes[random.integers(len(self.scenes))])
            if episodes:
                return episodes[random.integers(len(episodes))]


class _SceneLooking(PolicyLooking):
    """Looks at the scenes of an environment, or at mosaics of them.

    Private attributes: `_source` is where the scenes are from. `_mosaics` is the number of mosaics, 0 for the scenes as
    they are, and `_tiles` the numbers of scenes in a row and in a column of one.
    """

    def __init__(self, config: RunConfig, task: Task, source: _Source, mosaics: int, tiles: tuple[int, int]) -> None:
        self.task = task
        self._source = source
        self._mosaics = mosaics
        self._tiles = tiles
        super().__init__(config)

    def open_scenes(self) -> Scenes:
        if self._source is None or isinstance(self._source, str | Path):
            return self._composed(super().open_scenes())
        return self._composed(self._source)

    def _composed(self, scenes: Scenes) -> Scenes:
        """Compose mosaics of scenes, where they are wanted."""
        if not self._mosaics:
            return scenes
        return Mosaics(scenes, *self._tiles, count=self._mosaics, seed=self.config.data.scene_seed)


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
    # The first statement, so that the arguments are the only variables.
    reopen = partial(open_scenery, **locals())
    check(task in ("search", "exploration"), "task", "'search' or 'exploration'", repr(task))
    check_whole(mosaics, "mosaics", 0, 1_000_000)
    is_source = scenes is None or isinstance(scenes, str | Path) or hasattr(scenes, "__len__")
    check(is_source, "scenes", "a folder or `Scenes` (count= says how many)", scenes)
    check_cells(grid)
    if config is None:
        usual_shifts = 30 if task == "search" else 20
        config = RunConfig(
            data=DataConfig(_folder_of(scenes), _path(annotations), count, min_instances=0, scene_seed=seed),
            detector=DetectorConfig(detector, _path(weights)),
            sensor=SensorConfig(sensor),
            belief=BeliefConfig(columns=grid[0], rows=grid[1]),
            protocol=ProtocolConfig(starts, shifts or usual_shifts, seed=seed),
            policies=(policy,),
            cache=_path(cache),
            store=store,
        )
    check(isinstance(config, RunConfig), "config", "settings of an evaluation", type(config).__name__)
    # One belief is kept, that of the first policy.
    config = replace(config, policies=config.policies[:1])
    return Scenery(_SceneLooking(config, task, scenes, mosaics, tiles), targets, reopen)


def _folder_of(source: _Source) -> Path | None:
    """Return the folder of scenes that are given by it; None for others."""
    return Path(source) if isinstance(source, str | Path) else None


def _path(name: str | Path | None) -> Path | None:
    """Return the path of a file or folder that may be left out."""
    return None if name is None else Path(name)


class ZoomScenery(_Surroundings[WindowEye]):
    """Large pictures and an eye that zooms, which environments can share; `open_zoom_scenery` makes one.

    Args:
        looking: the looks at the pictures.
        passes: largest number of looks of an episode, the first one included.
        targets: classes to search for, by name or index; None takes all that a picture allows.
        reopen: opens the same pictures again, in another process.

    Attributes:
        evidence: predicts from a look what closer looks will find.
        looks_at: opens the looks at a picture.
        episodes: lists the targets of all searches of a picture.
    """

    annotated: ClassVar[bool] = True
    """Whether the objects in the pictures are known."""

    def __init__(self, looking: WindowLooking, passes: int, targets: _Targets, reopen: Callable[[], object]) -> None:
        super().__init__(looking.scenes, looking.eye, passes - 1, targets, reopen)
        self.evidence = looking.evidence
        # Looks are kept for as long as an environment uses this scenery.
        self.looks_at = cache(looking.looks_at)
        self.episodes = cache(self._list)

    def _depends_on(self) -> dict[str, object]:
        return {"eye": self.eye.settings(), "evidence": self.evidence}

    @cached_property
    def windows(self) -> int:
        """Largest number of windows of any of the pictures."""
        # Most pictures of a folder have one of a few sizes, and a lattice depends on the size alone.
        lattices = [Lattice.over(size, self.eye.detector.input_size, finest=self.eye.finest) for size in self._sizes()]
        return max(map(len, lattices))

    def _sizes(self) -> set[tuple[int, int]]:
        """List the different sizes of the pictures."""
        return {self.pictures.annotation(index).size for index in range(len(self.pictures))}

    def _list(self, scene: int) -> list[int]:
        """List the targets of a picture's searches: those that the look at the whole picture does not show already."""
        source = self.looks_at(scene)
        overview = source.see([Window.overview(source.lattice)])[0]
        return [target for target in self.targets(scene) if not self.found([overview], scene, target)]

    def draw(self, random: np.random.Generator, task: Task, scene: int | None = None) -> tuple[int, int]:
        """Draw an episode.

        Args:
            random: draws the picture and the target.
            task: `search` or `exploration`.
            scene: number of the picture; None draws one with objects to look for.

        Returns:
            The number of the picture, and the target 1..K; 0 in an exploration.

        Raises:
            DataError: no picture that was drawn has objects to look for.
        """
        for _ in range(_DRAWS):
            picture = int(random.integers(len(self.pictures))) if scene is None else scene
            if task == "search":
                targets = self.episodes(picture)
                if targets:
                    return picture, targets[random.integers(len(targets))]
            elif self._may_have_objects(picture):
                return picture, 0
        raise DataError(
            "scenes: expected pictures with objects to look for, found none; give other pictures or targets"
        )

    def _may_have_objects(self, scene: int) -> bool:
        """Tell whether a picture has objects, as far as that is known."""
        return len(self.pictures.annotation(scene).boxes) > 0

    def found(self, looks: Sequence[WindowLook], scene: int, target: int) -> bool:
        """Whether looks have found an object of the target class, by its box."""
        annotation = self.pictures.annotation(scene)
        targets = annotation.take(annotation.labels == target)
        return bool(found_in(looks, targets, target).any())

    def share(self, looks: Sequence[WindowLook], scene: int) -> float:
        """Compute the share of a picture's objects that looks have found."""
        return float(found_in(looks, self.pictures.annotation(scene)).float().mean())


class _UnannotatedScenery(ZoomScenery):
    """Large pictures of a folder without annotations: what they hold is not known, and scores say what is found."""

    annotated = False
    pictures: Pictures

    def targets(self, scene: int) -> list[int]:
        """Classes to search for, which have to be named."""
        if self._chosen is None:
            raise InputError("targets: expected classes to search for in pictures without annotations, got none")
        return self._chosen

    def _sizes(self) -> set[tuple[int, int]]:
        # The size is in the head of the file, so that no picture is decoded.
        return {open_large(self.pictures.root / str(name)).size for name in self.pictures.ids}

    def _may_have_objects(self, scene: int) -> bool:
        return True

    def found(self, looks: Sequence[WindowLook], scene: int, target: int) -> bool:
        """Whether looks show the target class with a score from which on objects are listed."""
        return any(float(look.show[target - 1]) >= SCORE_THRESHOLD for look in looks)

    def share(self, looks: Sequence[WindowLook], scene: int) -> float:
        """Compute the number of objects that looks have found, as their share is not known."""
        return float(len(merge(looks, None, score=SCORE_THRESHOLD)))


class _PictureLooking(WindowLooking):
    """Looks at large pictures, which are given, or in a folder without annotations.

    Private attribute: `_source` is where the pictures are from.
    """

    def __init__(self, config: WindowLookingConfig, source: _Source) -> None:
        self._source = source
        super().__init__(config)

    def open_scenes(self, classes: tuple[str, ...]) -> Scenes:
        source = self._source
        if source is None:
            return super().open_scenes(classes)
        if not isinstance(source, str | Path):
            return source
        if self.config.data.annotations is not None:
            return super().open_scenes(classes)
        return _pictures_in(Path(source), classes)


def _pictures_in(folder: Path, classes: tuple[str, ...]) -> Pictures:
    """Open the pictures in a folder."""
    if not folder.is_dir():
        raise DataError(f"scenes: no such folder: {folder}; check the path")
    names = [path.name for path in folder.iterdir() if path.suffix.lower() in PHOTOGRAPHS]
    if not names:
        raise DataError(f"scenes: expected pictures ({', '.join(PHOTOGRAPHS)}) in {folder}, found none")
    return Pictures(folder, names, classes)


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
    # The first statement, so that the arguments are the only variables.
    reopen = partial(open_zoom_scenery, **locals())
    check_whole(passes, "passes", 2, 100_000)
    data = DataConfig(limit=count, min_instances=0, max_target_area=None, scene_seed=seed)
    if annotations is not None:
        # Objects that fill more than a fifth of a photograph are no targets of a search.
        data = replace(data, root=_folder_of(scenes), annotations=Path(annotations), max_target_area=0.2)
    if mosaics is None:
        # Embedded scenes are too small to look at closely.
        mosaics = 8 if scenes is None else 0
    config = WindowLookingConfig(
        data=data,
        detector=DetectorConfig(detector, _path(weights)),
        mosaics=mosaics,
        columns=tiles[0],
        rows=tiles[1],
        seed=seed,
        cache=_path(cache),
        store=store,
    )
    looking = _PictureLooking(config, scenes)
    kind = _UnannotatedScenery if isinstance(looking.scenes, Pictures) else ZoomScenery
    return kind(looking, passes, targets, reopen)


_Scenery = TypeVar("_Scenery", Scenery, ZoomScenery)


def scenery_or_open(
    scenery: _Scenery | None, opener: Callable[..., _Scenery], options: Mapping[str, object], *task: Task
) -> _Scenery:
    """Take the scenery that several environments share, or open one.

    Args:
        scenery: a scenery that `opener` has opened; None opens one.
        opener: `open_scenery` or `open_zoom_scenery`.
        options: arguments of `opener` by name, none beside a scenery.
        task: first argument of `opener`, if it has one.

    Returns:
        The scenery.

    Raises:
        InputError: both a scenery and options are given, or `opener` has no such option.
    """
    expected = f"no options of `{opener.__name__}` beside it"
    check(scenery is None or not options, "scenery", expected, ", ".join(options))
    if scenery is not None:
        check(hasattr(scenery, "classes"), "scenery", f"what `{opener.__name__}` makes", type_of(scenery))
        return scenery
    known_options = signature(opener).parameters.keys() - {"task"}
    check_options(options, known_options, f"`{opener.__name__}`")
    return opener(*task, **options)
