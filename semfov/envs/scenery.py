"""The world of an environment: scenes, the eye that looks at them, and the belief that it keeps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from semfov.belief.observers import LearnedMap, Observer, Target
from semfov.data.classes import class_index
from semfov.data.mosaics import Mosaics
from semfov.data.scene import Scenes
from semfov.episode import StoredLooks
from semfov.errors import DataError, check, check_whole
from semfov.experiments.config import (
    BeliefConfig,
    DataConfig,
    DetectorConfig,
    ExploreConfig,
    PolicyConfig,
    ProtocolConfig,
    RunConfig,
    SearchConfig,
    SensorConfig,
)
from semfov.experiments.exploration_protocol import Exploration, explorations_of, explore_noise
from semfov.experiments.runs import ExploreRun, SearchRun
from semfov.experiments.search_protocol import Episode, episodes_of, tie_noise
from semfov.metrics.exploration import answers_of
from semfov.sensor.named import SensorName

Source = Scenes | str | Path | None
"""Scenes of any kind, or the folder of photographs; None for the embedded scenes."""

_VIEWS = 16  # pictures that are kept open for glimpses


class Scenery:
    """Scenes, an eye and a belief, which any number of environments share: `open_scenery` makes one.

    Episodes are those of the protocols (`semfov.experiments`), and so are looks: what is seen from every cell of a
    scene is computed when an episode first enters it, and kept on disk.

    Args:
        run: the experiment that the episodes are of, with one policy, whose belief the environments keep.
        targets: classes that are searched for; None for all that a scene allows.

    Attributes:
        run: as given.
        policy: what tables call the policy.
        scenes: indices of the scenes that may have something to look for.
    """

    def __init__(self, run: SearchRun | ExploreRun, targets: Sequence[str | int] | None = None) -> None:
        check(len(run.policies) == 1, "policy", "one", f"{len(run.policies)}")
        self.run = run
        self.policy = next(iter(run.policies))
        context = run.config.belief.context, run.policies[self.policy].context
        check(not {"place", "cooccurrence", "both"} & set(context), "context", "none: it is of one scene", context)
        names = self.classes[1:]
        self._wanted = None if targets is None else {class_index(target, names, "targets") for target in targets}
        self.scenes = [scene for scene in range(len(run.scenes)) if self._asked(scene)]
        # Kept for as long as there are environments: what they go by, whoever asks.
        self._listed = cache(self._list)
        self.grid = cache(run.grid)
        self.answers = cache(self._answers)
        self.open = cache(self._open)
        self.together = cache(self._together)
        self.view = lru_cache(_VIEWS)(lambda scene: run.eye.open(self.image(scene)[None]))
        if not any(self.episodes(scene) for scene in self.scenes):
            raise DataError("scenes: expected some with anything to look for, got none; give others, or other targets")

    def _asked(self, scene: int) -> list[int]:
        """Classes that a scene is searched for, or that are on it."""
        if isinstance(self.run, SearchRun):
            allowed = self.run.scenes.targets(scene)
            return [target for target in allowed if self._wanted is None or target in self._wanted]
        found: list[int] = self.run.scenes.annotation(scene).labels.tolist()
        return found

    def episodes(self, scene: int) -> list[Any]:
        """All episodes of a scene: its searches or explorations, as the protocol draws their starts."""
        return self._listed(scene)

    def _list(self, scene: int) -> list[Any]:
        run, protocol, belief = self.run, self.run.config.protocol, self.run.config.belief
        if isinstance(run, SearchRun):
            return list(episodes_of(run.scenes, scene, belief.columns, belief.rows, protocol, self._asked(scene)))
        if not self.answers(scene).any():
            return []
        return list(explorations_of(run.scenes, scene, belief.columns * belief.rows, protocol))

    def draw(self, random: np.random.Generator) -> Any:
        """An episode at random: all scenes are equally likely, and in each all its targets."""
        while True:
            episodes = self.episodes(self.scenes[random.integers(len(self.scenes))])
            if episodes:
                return episodes[random.integers(len(episodes))]

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, background first."""
        return ("background", *self.run.scenes.classes)

    @property
    def observer(self) -> Observer:
        """Turns looks into belief."""
        return self.run.strategies[self.policy].observer

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the cells."""
        return self.run.config.belief.rows, self.run.config.belief.columns

    @property
    def shifts(self) -> int:
        """Most gaze shifts of an episode."""
        return self.run.config.protocol.shifts

    @property
    def pixels(self) -> int:
        """That a look shows the detector."""
        wide, high = self.run.eye.detector.input_size
        return wide * high

    def _together(self) -> Observer:
        """The observer that computes all episodes of a batch at once: faster, and rounded by the batch."""
        if not isinstance(self.observer, Target | LearnedMap):
            return self.observer
        return type(self.observer)(self.observer.model, together=True)  # type: ignore[arg-type]

    def _open(self, scene: int) -> StoredLooks:
        """What is seen from every cell of a scene."""
        asked = sorted({episode.cue for episode in self.episodes(scene) if isinstance(episode, Episode)})
        targets = torch.tensor(asked) if asked else None
        return StoredLooks(self.run.detections(scene), self.grid(scene), targets)

    def _answers(self, scene: int) -> Tensor:
        """Which classes are right for each cell of a scene, `(X·Y, K+1)`."""
        return answers_of(self.run.scenes.annotation(scene), self.grid(scene), len(self.classes))

    def noise(self, episode: Episode | Exploration) -> Tensor:
        """Random numbers that break an episode's ties, `(shifts+1, X·Y)`: those of `eval.search` and `eval.explore`."""
        cells, protocol = self.shape[0] * self.shape[1], self.run.config.protocol
        if isinstance(episode, Episode):
            return tie_noise(self.run.scenes, episode, cells, protocol)
        return explore_noise(self.run.scenes, episode, cells, protocol)

    def image(self, scene: int) -> Tensor:
        """Pixels of a scene, `(3, H, W)`."""
        return self.run.scenes[scene].image


class _Search(SearchRun):
    """Visual search in scenes that are given."""

    def __init__(self, config: SearchConfig, scenes: Callable[[Any], Scenes]) -> None:
        self._choose = scenes
        super().__init__(config)

    def open_scenes(self) -> Scenes:
        """The given ones."""
        return self._choose(super().open_scenes)


class _Explore(ExploreRun):
    """Exploration of scenes that are given."""

    def __init__(self, config: ExploreConfig, scenes: Callable[[Any], Scenes]) -> None:
        self._choose = scenes
        super().__init__(config)

    def open_scenes(self) -> Scenes:
        """The given ones."""
        return self._choose(super().open_scenes)


def open_scenery(
    task: str,
    scenes: Source = None,
    annotations: str | Path | None = None,
    *,
    count: int | None = None,
    mosaics: int = 0,
    tiles: tuple[int, int] = (2, 2),
    targets: Sequence[str | int] | None = None,
    detector: str = "yolov3-tiny",
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
    """Open scenes for environments.

    Args:
        task: `search` or `exploration`.
        scenes: embedded scenes (None), the folder of a set in COCO's format, or any `Scenes` with the detector's
            classes.
        annotations: COCO-format instances file of the folder.
        count: use only the first so many scenes (None: all of a folder, 8 embedded ones).
        mosaics: number of mosaics to compose of the scenes; 0 takes the scenes as they are.
        tiles: photographs in a row and in a column of a mosaic.
        targets: classes to search for, by name or index; None: all that a scene allows.
        detector: by name, or an ONNX model.
        weights: file with its weights.
        sensor: the fovea, by name (`semfov.sensor.SENSORS`).
        policy: preset or settings of `eval.search` or `eval.explore`; it says which belief is kept, and it is the
            hand-made agent of the environment (`PolicyAgent`).
        grid: columns and rows of the cells.
        shifts: most gaze shifts of an episode (None: 30 of a search, 20 of an exploration).
        starts: of each scene and target that episodes are drawn from.
        seed: of embedded scenes, mosaics and starts.
        cache: folder for what is seen (None: the user's cache).
        store: keep what is seen on disk.
        config: all settings of the experiment in place of these; its scenes may be given as `scenes` too.

    Raises:
        InputError: an argument does not fit.
        DataError: photographs, annotations or weights are missing or damaged.
    """
    search = task == "search"
    check(task in ("search", "exploration"), "task", "'search' or 'exploration'", repr(task))
    check_whole(mosaics, "mosaics", 0, 1_000_000)
    if config is None:
        folder = Path(scenes) if isinstance(scenes, str | Path) else None
        settings: dict[str, Any] = {
            "data": DataConfig(
                folder, None if annotations is None else Path(annotations), count, min_instances=0, scene_seed=seed
            ),
            "detector": DetectorConfig(detector, None if weights is None else Path(weights)),
            "sensor": SensorConfig(sensor),
            "belief": BeliefConfig(columns=grid[0], rows=grid[1]),
            "protocol": ProtocolConfig(starts, shifts or (30 if search else 20), seed=seed),
            "policies": (policy,),
            "cache": None if cache is None else Path(cache),
            "store": store,
        }
        config = SearchConfig(**settings) if search else ExploreConfig(**settings)
    expected = SearchConfig if search else ExploreConfig
    check(isinstance(config, expected), "config", expected.__name__, type(config).__name__)
    config = replace(config, policies=config.policies[:1])
    size = config.data.scene_seed

    def choose(named: Callable[[], Scenes]) -> Scenes:
        chosen = named() if scenes is None or isinstance(scenes, str | Path) else scenes
        if mosaics:
            chosen = Mosaics(chosen, *tiles, count=mosaics, seed=size)
        return chosen

    run = _Search(config, choose) if isinstance(config, SearchConfig) else _Explore(config, choose)
    names = run.eye.detector.classes
    check(run.scenes.classes == names, "scenes", "classes of the detector", f"{len(run.scenes.classes)} others")
    return Scenery(run, targets)
