"""An experiment over scenes, run one scene at a time; a stopped run can be continued."""

from __future__ import annotations

import hashlib
import json
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import Scenes
from semfov.detection.detections import Detections
from semfov.errors import DataError, check, lookup
from semfov.experiments.attention import attend_all
from semfov.experiments.candidates import Candidate, load_models, make_strategy
from semfov.experiments.config import RunConfig, SaliencyModel
from semfov.experiments.looks import see_all
from semfov.experiments.parallel import available_cores, mine, run_tasks, wait_for_others
from semfov.experiments.parts import Parts, Record
from semfov.experiments.presets import IVSN, SALIENCY, label, resolve
from semfov.experiments.saliency_store import SaliencyStore, saliency_table
from semfov.experiments.setup import check_sources, fovea_of, make_eye, make_scenes, prepare_worker
from semfov.experiments.store import DetectionStore, versions
from semfov.gaze.policies import POLICIES, Task
from semfov.io.code import class_digest, package_digest
from semfov.io.storage import checksum

_log = logging.getLogger(__name__)


class SceneRun(ABC):
    """Base of experiments that any process can build from the settings and that are run scene by scene.

    Attributes:
        config: the settings.
        scenes: the scenes in order.
        settings_key: sha256 of all settings, models and scenes that the outcomes depend on.
        code: sha256 of all code that the outcomes depend on.
        key: short key of both; it keeps the outcomes of different runs apart.
    """

    config: Any
    scenes: Scenes

    def make_key(self) -> None:
        """Compute the keys from settings, models and scenes; a subclass that adds models calls this again."""
        self.settings_key, self.code = self._key(), self._code()
        self.key = f"{self.settings_key[:16]}-{self.code[:16]}"

    @abstractmethod
    def _key(self) -> str: ...

    def _code(self) -> str:
        """Digest of the whole package and of the versions of the libraries that it uses."""
        return digest_of([package_digest(), versions()])

    @property
    def parts(self) -> Parts:
        """The outcomes of finished scenes."""
        return Parts(self.config.out / "parts", self.key, self.digest)

    def digest(self, index: int) -> str:
        """sha256 of what the pixels of a scene depend on."""
        return self.scenes.digest(index)

    @abstractmethod
    def outcomes(self, index: int) -> tuple[list[Record], dict[str, float]]:
        """Run the episodes of a scene; returns their records, and the seconds that each stage took."""


class Run(SceneRun):
    """Scenes, eye, models and policies of a run; every process builds its own from the settings.

    Attributes:
        task: the task of the episodes.
        policies: settings of the policies under comparison, by their names in tables.
    """

    task: ClassVar[Task]
    config: RunConfig

    def __init__(self, config: RunConfig) -> None:
        self.config = config
        labels = [label(choice, self.task) for choice in config.policies]
        for name in labels:
            check(labels.count(name) == 1, "policies", "each policy once", f"{name!r} {labels.count(name)} times")
        self.policies = {name: resolve(choice, self.task) for name, choice in zip(labels, config.policies, strict=True)}
        self.check_sources()
        self.eye = make_eye(config.detector, config.sensor)
        self.scenes: Scenes = self.open_scenes()
        if not len(self.scenes):
            raise DataError("data: the settings select no scene; lower data.min_instances or raise data.limit")
        self.models = load_models(config, self.task, self.eye)
        components, fovea = len(self.scenes.classes) + 1, config.sensor.fovea
        self.strategies = {
            name: make_strategy(policy, self.task, config.belief, components, self.models, fovea)
            for name, policy in self.policies.items()
        }
        settings, cache = self.eye.settings(), cache_folder(config.cache)
        size = config.belief.columns, config.belief.rows
        self.store = DetectionStore(cache / "looks", settings, *size, components)
        self.saliency_stores = {
            name: SaliencyStore(cache / "saliency", name, config.saliency, settings["sensor"], size)
            for name in dict.fromkeys(policy.saliency for policy in self.policies.values())
            if name is not None
        }
        self.make_key()
        self._digests: dict[int, str] = {}

    def check_sources(self) -> None:
        """Check that the files of the scenes and of the detector exist, before any of them is loaded."""
        check_sources(self.config.data, self.config.detector)

    def open_scenes(self) -> Scenes:
        """Open the scenes of the run; a subclass may open others."""
        return make_scenes(self.config.data, self.eye.detector.classes)

    def _code(self) -> str:
        """Digest of the whole package, of the versions of its libraries, and of policies that the user registered."""
        chosen = {policy.policy for policy in self.policies.values()} & POLICIES.keys()
        foreign = [name for name in sorted(chosen) if not POLICIES[name].__module__.startswith("semfov.")]
        return digest_of([package_digest(), versions(), [class_digest(POLICIES[name]) for name in foreign]])

    def _key(self) -> str:
        config, models = self.config, self.models
        fitted = {
            name: None if model is None else checksum(model.state_dict())
            for name, model in (
                ("observation", models.observation),
                ("evidence", models.evidence),
                ("gaze", models.gaze),
            )
        }
        contexts = {name: prior.digest() for name, prior in models.context.items()}
        if models.templates is not None:
            fitted["templates"] = checksum(models.templates.state_dict())
        if models.map is not None:
            fitted["map"] = checksum(models.map.state_dict())
        belief = {name: value for name, value in asdict(config.belief).items() if not name.endswith("model")}
        protocol = {name: value for name, value in asdict(config.protocol).items() if name != "batch"}
        saliency = asdict(config.saliency) if self.saliency_stores else None
        policies = {name: {**asdict(policy), "context_model": None} for name, policy in self.policies.items()}
        for name, policy in self.policies.items():
            policies[name]["context_model"] = contexts.get(policy.context_model or config.belief.context_model)
        seen = [self.eye.settings(), self.scenes.fingerprint]
        return digest_of([self.task, seen, belief, fitted, protocol, policies, saliency])

    def digest(self, index: int) -> str:
        """sha256 of what the pixels of a scene depend on."""
        if index not in self._digests:
            self._digests[index] = self.scenes.digest(index)
        return self._digests[index]

    @abstractmethod
    def outcomes(self, index: int) -> tuple[list[Record], dict[str, float]]:
        """Run all episodes of a scene with all policies; returns records, and the seconds that each stage took."""

    def candidate(self, name: str, index: int) -> Candidate:
        """The policy of this name in tables, for a scene."""
        policy = self.policies[lookup(name, self.policies, "policy of this run")]
        if policy.policy == IVSN:
            fovea = self.config.sensor.fovea
            return Candidate(self.strategies[name], attention=self.attention(index), fovea=fovea)
        if policy.saliency is None:
            return Candidate(self.strategies[name])
        weight = None if policy.policy == SALIENCY else self.config.saliency.weight
        return Candidate(self.strategies[name], self.saliency(policy.saliency, index), weight)

    def grid(self, index: int) -> Grid:
        """The grid over a scene."""
        return Grid(self.config.belief.columns, self.config.belief.rows, self.scenes.annotation(index).size)

    def detections(self, index: int) -> Detections:
        """Detections from every cell of a scene, read from the store, or computed and stored."""
        digest = self.digest(index)
        seen = self.store.load(digest) if self.config.store else None
        if seen is None:
            seen = see_all(self.eye, self.scenes[index].image, self.grid(index))
            if self.config.store:
                self.store.save(digest, seen)
        return seen

    def attention(self, index: int) -> Tensor:
        """Attention to every class in the cells of a scene, from every cell; computed at each call, never stored."""
        assert self.models.templates is not None
        return attend_all(self.eye, self.models.templates, self.scenes[index].image, self.grid(index))

    def saliency(self, name: SaliencyModel, index: int) -> Tensor:
        """Saliency of the cells of a scene (`saliency_table`), read from the store, or computed and stored."""
        digest, store = self.digest(index), self.saliency_stores[name]
        saliency = store.load(digest) if self.config.store else None
        if saliency is None:
            image = self.scenes[index].image
            sensor, reference = fovea_of(self.eye), self.config.sensor.reference
            saliency = saliency_table(name, self.config.saliency, sensor, reference, image, self.grid(index))
            if self.config.store:
                store.save(digest, saliency)
        return saliency


def cache_folder(chosen: Path | None) -> Path:
    """Folder of the stores: the chosen one, or the user's cache."""
    if chosen is not None:
        return chosen
    from semfov.detection.weights import cache_folder as user_cache

    return user_cache()


def finish(run: SceneRun, title: str) -> None:
    """Run this rank's share of the scenes that are not finished yet, and wait for the other ranks."""
    parts = run.parts
    todo = [index for index in mine(range(len(run.scenes))) if parts.load(index) is None]
    older = parts.by_other_code()
    if todo and older:
        _log.warning(
            "%s: %d scenes were finished with these settings by another version of the code (semfov or a library has "
            "changed since); they are computed anew",
            run.config.out,
            older,
        )
    done = run_tasks(
        finish_scene,
        todo,
        workers=run.config.workers or available_cores(),
        setup=prepare_process,
        settings=(type(run), run.config),
        title=title,
        unit="scene",
    )
    for _ in done:
        pass
    wait_for_others(range(len(run.scenes)), lambda index: parts.load(index) is not None)


def digest_of(what: object) -> str:
    """The sha256 of a JSON value."""
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


_process: dict[str, SceneRun] = {}


def prepare_process(make: Callable[[Any], SceneRun], config: Any) -> None:
    """Build the run in this process, once."""
    prepare_worker()
    _process["run"] = make(config)


def finish_scene(index: int) -> int:
    """Run all episodes of a scene and store their outcomes; returns the index of the scene."""
    run = _process["run"]
    records, seconds = run.outcomes(index)
    run.parts.save(index, records, seconds)
    return index
