"""An experiment over scenes, one at a time: what it is made of, and finishing it wherever it was stopped."""

from __future__ import annotations

import hashlib
import json
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from eval.cached import checksum
from eval.config import RunConfig
from eval.parallel import available_cores, mine, run_tasks, wait_for_all
from eval.protocol import Searcher
from eval.saliency import SaliencyStore, saliency_table
from eval.setup import (
    LEARNED,
    TARGET_EVIDENCE,
    Kind,
    in_context,
    make_context,
    make_eye,
    make_learned_gaze,
    make_observation,
    make_scenes,
    make_searcher,
    make_target_evidence,
    needs_context,
    needs_model,
    needs_target,
    prepare_worker,
    saliency_of,
    saliency_policies,
    split_policy,
)
from eval.store import DetectionStore, see_all
from semfov import Detections, Grid, search_policy
from semfov.belief import TargetObserver
from semfov.data.scene import Scenes
from semfov.errors import DataError
from semfov.files import write_text


class Run(ABC):
    """Everything that a run is made of, built from its settings in each process.

    Attributes:
        kind: of the experiment.
        key: sha256 of everything that the outcomes depend on; parts of another run are never mixed in.
    """

    kind: Kind

    def __init__(self, config: RunConfig) -> None:
        self.config = config
        self.eye = make_eye(config.detector, config.sensor)
        self.scenes: Scenes = make_scenes(config.data, self.eye.detector.classes)
        if not len(self.scenes):
            raise DataError("data: no scene passes the selection; lower data.min_instances or raise data.limit")
        needed = needs_model(config.policies, self.kind)
        self.model = make_observation(config.belief.model, self.eye) if needed else None
        self.target = make_target_evidence(config, self.eye) if needs_target(config.policies, self.kind) else None
        self.context = make_context(config, self.eye) if needs_context(config.policies, config.belief) else None
        self.gaze = make_learned_gaze(config, self.eye) if LEARNED in config.policies else None
        belief, settings, cache = config.belief, self.eye.settings(), cache_folder(config)
        size = belief.columns, belief.rows
        self.store = DetectionStore(cache / "looks", settings, *size)
        self.saliency_stores = {
            name: SaliencyStore(cache / "saliency", name, config.saliency, settings["sensor"], size)
            for name in saliency_policies(config.policies, self.kind)
        }
        self.key = self._key()

    def _key(self) -> str:
        config = self.config
        models = {
            name: None if model is None else checksum(model.state_dict())
            for name, model in (("model", self.model), ("target_model", self.target))
        }
        if self.gaze is not None:
            models["gaze_model"] = checksum(self.gaze.state_dict())
        belief = {**asdict(config.belief), **models}
        if self.context is None:
            del belief["context"], belief["context_model"]
        else:
            belief["context_model"] = self.context.digest()
        protocol = {name: value for name, value in asdict(config.protocol).items() if name != "batch"}
        saliency = {name: [store.key, config.saliency.weight] for name, store in self.saliency_stores.items()}
        what = [self.kind, self.store.key, self.scenes.fingerprint, belief, protocol, list(config.policies), saliency]
        return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()

    @abstractmethod
    def outcomes(self, index: int) -> tuple[list[dict[str, object]], dict[str, float]]:
        """Records of all episodes of a scene under all policies, and the seconds that they took."""

    def searcher(self, name: str, index: int) -> Searcher:
        """How the policy of this name searches or explores a scene, with this run's models."""
        searcher = self._by_belief(name)
        observer = in_context(name, self.kind, searcher.observer, self.config.belief, self.context)
        salient = saliency_of(name, self.kind)
        if salient is None:
            return replace(searcher, observer=observer)
        alone = split_policy(name, self.kind)[0] == salient
        weight = None if alone else self.config.saliency.weight
        return replace(searcher, observer=observer, saliency=self.saliency(salient, index), weight=weight)

    def _by_belief(self, name: str) -> Searcher:
        base, _ = split_policy(name, self.kind)
        if self.target is not None and base == TARGET_EVIDENCE:
            return Searcher(TargetObserver(self.target), search_policy("non-predictive"))
        components = len(self.scenes.classes) + 1
        if self.gaze is not None and base == LEARNED:
            return Searcher(self.gaze.observer(components), self.gaze.policy)
        fovea = self.config.sensor.fovea
        return make_searcher(name, self.kind, self.config.belief, components, self.model, fovea)

    def grid(self, index: int) -> Grid:
        """The grid over a scene."""
        return Grid(self.config.belief.columns, self.config.belief.rows, self.scenes.annotation(index).size)

    def detections(self, index: int) -> Detections:
        """What is seen from every cell of a scene, from the store or computed (and kept)."""
        digest = self.scenes.digest(index)
        seen = self.store.load(digest) if self.config.store else None
        if seen is None:
            seen = see_all(self.eye, self.scenes[index].image, self.grid(index))
            if self.config.store:
                self.store.save(digest, seen)
        return seen

    def saliency(self, name: str, index: int) -> Tensor:
        """Saliency of the cells of a scene (`saliency_table`), from the store or computed (and kept)."""
        digest, store = self.scenes.digest(index), self.saliency_stores[name]
        saliency = store.load(digest) if self.config.store else None
        if saliency is None:
            image = self.scenes[index].image
            sensor, reference = self.eye.sensor, self.config.sensor.reference
            saliency = saliency_table(name, self.config.saliency, sensor, reference, image, self.grid(index))
            if self.config.store:
                store.save(digest, saliency)
        return saliency


class Stopwatch:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Count the time since the last lap to a stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now


def cache_folder(config: RunConfig) -> Path:
    """Folder of the stores."""
    if config.cache is not None:
        return config.cache
    from semfov.detection.weights import cache_folder as user_cache

    return user_cache()


class Parts:
    """Outcomes of finished scenes, one file each, so that a killed run goes on where it was."""

    def __init__(self, folder: Path, key: str) -> None:
        self.folder = folder / key[:16]
        self.key = key

    @classmethod
    def of(cls, run: Run) -> Parts:
        """The parts of a run."""
        return cls(run.config.out / "parts", run.key)

    def path(self, index: int) -> Path:
        """File of a scene."""
        return self.folder / f"{index:06d}.json"

    def load(self, index: int) -> dict[str, Any] | None:
        """Outcomes of a scene, or None if they are not there whole."""
        try:
            part = json.loads(self.path(index).read_text(encoding="utf-8"))
            whole = part["key"] == self.key and part["sha256"] == _digest(index, part["records"])
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return part if whole else None

    def save(self, index: int, records: list[dict[str, object]], seconds: dict[str, float]) -> None:
        """Keep the outcomes of a scene."""
        part = {"key": self.key, "sha256": _digest(index, records), "records": records, "seconds": seconds}
        write_text(self.path(index), json.dumps(part))


def _digest(index: int, records: Sequence[object]) -> str:
    return hashlib.sha256(json.dumps([index, records]).encode()).hexdigest()


def finish(run: Run, title: str) -> Parts:
    """Run all scenes that have no part yet, this rank its share of them, and wait for the other ranks."""
    parts = Parts.of(run)
    todo = [index for index in mine(range(len(run.scenes))) if parts.load(index) is None]
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
    wait_for_all()
    return parts


_process: dict[str, Run] = {}


def prepare_process(make: type[Run], config: RunConfig) -> None:
    """Build the run once in this process."""
    prepare_worker()
    _process["run"] = make(config)


def finish_scene(index: int) -> int:
    """Run all episodes of a scene and keep their outcomes as a part; returns the scene."""
    run = _process["run"]
    records, seconds = run.outcomes(index)
    Parts.of(run).save(index, records, seconds)
    return index
