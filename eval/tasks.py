"""The unit of work of a search run: one scene, from photograph to outcomes of all policies."""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import asdict
from pathlib import Path

import torch

from eval.cached import checksum
from eval.config import SearchConfig
from eval.protocol import Outcome, Searcher, episodes_of, run_episodes, tie_noise
from eval.setup import make_eye, make_observation, make_scenes, make_searcher, needs_model, prepare_worker
from eval.store import DetectionStore, see_all
from semfov import Detections, Grid
from semfov.data.scene import Scenes
from semfov.errors import DataError
from semfov.files import write_text


class SearchRun:
    """Everything that a search run is made of, built from its settings in each process.

    Attributes:
        key: sha256 of everything that the outcomes depend on; parts of another run are never mixed in.
    """

    def __init__(self, config: SearchConfig) -> None:
        self.config = config
        self.eye = make_eye(config.detector, config.sensor)
        self.scenes: Scenes = make_scenes(config.data, self.eye.detector.classes)
        if not len(self.scenes):
            raise DataError("data: no scene passes the selection; lower data.min_instances or raise data.limit")
        self.model = make_observation(config, self.eye) if needs_model(config.policies) else None
        belief = config.belief
        self.store = DetectionStore(cache_folder(config), self.eye.settings(), belief.columns, belief.rows)
        self.key = self._key()

    def _key(self) -> str:
        config = self.config
        model = None if self.model is None else checksum(self.model.state_dict())
        belief = {**asdict(config.belief), "model": model}
        protocol = {name: value for name, value in asdict(config.protocol).items() if name != "batch"}
        what = [self.store.key, self.scenes.fingerprint, belief, protocol, list(config.policies)]
        return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()

    def searcher(self, name: str) -> Searcher:
        """How the policy of this name searches, with this run's observation model."""
        return make_searcher(name, self.config.belief, len(self.scenes.classes) + 1, self.model)

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

    def outcomes(self, index: int) -> tuple[list[dict[str, object]], dict[str, float]]:
        """Records of all episodes of a scene under all policies, and the seconds that they took."""
        config, protocol = self.config, self.config.protocol
        belief = config.belief
        episodes = episodes_of(self.scenes, index, belief.columns, belief.rows, protocol)
        seconds: dict[str, float] = {}
        records: list[dict[str, object]] = []
        began = time.perf_counter()
        detections, grid = self.detections(index), self.grid(index)
        seconds["look"] = time.perf_counter() - began
        if not episodes:
            return records, seconds
        noise = torch.stack([tie_noise(self.scenes, episode, len(grid), protocol) for episode in episodes])
        for name in config.policies:
            began = time.perf_counter()
            with torch.inference_mode():
                outcomes = run_episodes(
                    episodes,
                    self.searcher(name),
                    detections,
                    grid,
                    noise,
                    shifts=protocol.shifts,
                    batch=protocol.batch,
                )
            seconds[name] = time.perf_counter() - began
            records += [
                self._record(name, episode, outcome) for episode, outcome in zip(episodes, outcomes, strict=True)
            ]
        return records, seconds

    def _record(self, policy: str, episode: object, outcome: Outcome) -> dict[str, object]:
        fields = asdict(episode)  # type: ignore[call-overload]
        scene = fields.pop("scene")
        return {
            "policy": policy,
            "scene": self.scenes.ids[scene],
            **fields,
            "target_name": self.scenes.classes[fields["target"] - 1],
            "cells": list(outcome.cells),
            "found_at": outcome.found_at,
        }


def cache_folder(config: SearchConfig) -> Path:
    """Folder of the detection store."""
    if config.cache is not None:
        return config.cache / "looks"
    from semfov.detection.weights import cache_folder as user_cache

    return user_cache() / "looks"


class Parts:
    """Outcomes of finished scenes, one file each, so that a killed run goes on where it was."""

    def __init__(self, folder: Path, key: str) -> None:
        self.folder = folder / key[:16]
        self.key = key

    def path(self, index: int) -> Path:
        """File of a scene."""
        return self.folder / f"{index:06d}.json"

    def load(self, index: int) -> dict[str, object] | None:
        """Outcomes of a scene, or None if they are not there whole."""
        try:
            part = json.loads(self.path(index).read_text(encoding="utf-8"))
            whole = part["key"] == self.key and part["sha256"] == _digest(part["records"])
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return part if whole else None

    def save(self, index: int, records: list[dict[str, object]], seconds: dict[str, float]) -> None:
        """Keep the outcomes of a scene."""
        part = {"key": self.key, "sha256": _digest(records), "records": records, "seconds": seconds}
        write_text(self.path(index), json.dumps(part))


def _digest(records: object) -> str:
    return hashlib.sha256(json.dumps(records).encode()).hexdigest()


_process: dict[str, SearchRun] = {}


def prepare_process(config: SearchConfig) -> None:
    """Build the run once in this process."""
    prepare_worker()
    _process["run"] = SearchRun(config)


def search_scene(index: int) -> int:
    """Run all episodes of a scene and keep their outcomes as a part; returns the scene."""
    run = _process["run"]
    parts = Parts(run.config.out / "parts", run.key)
    records, seconds = run.outcomes(index)
    parts.save(index, records, seconds)
    return index
