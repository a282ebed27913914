"""An experiment over scenes, one at a time: what it is made of, and finishing it wherever it was stopped."""

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
    """An experiment that is made of its settings alone, in any process, and whose scenes are finished one by one.

    Attributes:
        config: settings.
        scenes: in their order.
        settings_key: sha256 of all settings, models and scenes that the outcomes depend on.
        code: sha256 of all code that they depend on.
        key: of both; parts of another run are never mixed in.
    """

    config: Any
    scenes: Scenes

    def make_key(self) -> None:
        """Set the keys from what the run is made of; asked for again where a subclass makes more of it."""
        self.settings_key, self.code = self._key(), self._code()
        self.key = f"{self.settings_key[:16]}-{self.code[:16]}"

    @abstractmethod
    def _key(self) -> str: ...

    def _code(self) -> str:
        """Of the whole package and the libraries below it."""
        return digest_of([package_digest(), versions()])

    @property
    def parts(self) -> Parts:
        """Outcomes of finished scenes."""
        return Parts(self.config.out / "parts", self.key, self.digest)

    def digest(self, index: int) -> str:
        """sha256 of what the pixels of a scene depend on."""
        return self.scenes.digest(index)

    @abstractmethod
    def outcomes(self, index: int) -> tuple[list[Record], dict[str, float]]:
        """Records of a scene, and the seconds that they took."""


class Run(SceneRun):
    """Everything that a run is made of, built from its settings in each process.

    Attributes:
        task: what episodes are for.
        policies: settings of the policies under comparison, by what tables call them.
    """

    task: ClassVar[Task]
    config: RunConfig

    def __init__(self, config: RunConfig) -> None:
        self.config = config
        labels = [label(choice, self.task) for choice in config.policies]
        for name in labels:
            check(labels.count(name) == 1, "policies", "each of them once", f"{name!r} {labels.count(name)} times")
        self.policies = {name: resolve(choice, self.task) for name, choice in zip(labels, config.policies, strict=True)}
        self.check_sources()
        self.eye = make_eye(config.detector, config.sensor)
        self.scenes: Scenes = self.open_scenes()
        if not len(self.scenes):
            raise DataError("data: no scene passes the selection; lower data.min_instances or raise data.limit")
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
        """Raise an error where what the run looks at, or its detector, is not there, before any of it is loaded."""
        check_sources(self.config.data, self.config.detector)

    def open_scenes(self) -> Scenes:
        """The scenes of the run; a subclass may have others."""
        return make_scenes(self.config.data, self.eye.detector.classes)

    def _code(self) -> str:
        """Of the whole package and the libraries below it, and of policies that the user registered."""
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
        """Records of all episodes of a scene under all policies, and the seconds that they took."""

    def candidate(self, name: str, index: int) -> Candidate:
        """The policy that tables call `name`, in a scene."""
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
        """What is seen from every cell of a scene, from the store or computed (and kept)."""
        digest = self.digest(index)
        seen = self.store.load(digest) if self.config.store else None
        if seen is None:
            seen = see_all(self.eye, self.scenes[index].image, self.grid(index))
            if self.config.store:
                self.store.save(digest, seen)
        return seen

    def attention(self, index: int) -> Tensor:
        """Attention to all classes in the cells of a scene, seen from every cell; computed whenever it is asked for."""
        assert self.models.templates is not None
        return attend_all(self.eye, self.models.templates, self.scenes[index].image, self.grid(index))

    def saliency(self, name: SaliencyModel, index: int) -> Tensor:
        """Saliency of the cells of a scene (`saliency_table`), from the store or computed (and kept)."""
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
    """Run all scenes that have no part yet, this rank its share of them, and wait for the other ranks."""
    parts = run.parts
    todo = [index for index in mine(range(len(run.scenes))) if parts.load(index) is None]
    older = parts.by_other_code()
    if todo and older:
        _log.warning(
            "%s: %d scenes were finished with these settings by other code (this package or a library has changed "
            "since); they are not used, and computed anew",
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
    """sha256 of JSON values."""
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


_process: dict[str, SceneRun] = {}


def prepare_process(make: Callable[[Any], SceneRun], config: Any) -> None:
    """Build the run once in this process."""
    prepare_worker()
    _process["run"] = make(config)


def finish_scene(index: int) -> int:
    """Run all episodes of a scene and keep their outcomes as a part; returns the scene."""
    run = _process["run"]
    records, seconds = run.outcomes(index)
    run.parts.save(index, records, seconds)
    return index
