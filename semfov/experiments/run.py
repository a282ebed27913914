"""Policies compared in the same scenes, one scene at a time."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import asdict
from typing import ClassVar

from torch import Tensor

from semfov.errors import check, lookup
from semfov.experiments.attention import attend_all
from semfov.experiments.candidates import Candidate, load_models, make_strategy
from semfov.experiments.config import RunConfig, SaliencyModel
from semfov.experiments.looking import Looking
from semfov.experiments.parts import Record
from semfov.experiments.presets import label, resolve
from semfov.experiments.saliency_store import SaliencyStore, saliency_table
from semfov.experiments.scene_run import cache_folder, digest_of
from semfov.experiments.setup import fovea_of
from semfov.gaze.policies import POLICIES, Task
from semfov.io.code import class_digest
from semfov.io.storage import checksum


class Run(Looking):
    """Policies compared in the same scenes; every process builds its own run from the settings.

    Attributes:
        task: the task of the episodes.
        policies: settings of the policies under comparison, by their names in tables.
    """

    task: ClassVar[Task]
    config: RunConfig

    def __init__(self, config: RunConfig) -> None:
        labels = [label(choice, self.task) for choice in config.policies]
        for name in labels:
            check(labels.count(name) == 1, "policies", "each policy once", f"{name!r} {labels.count(name)} times")
        self.policies = {name: resolve(choice, self.task) for name, choice in zip(labels, config.policies, strict=True)}
        super().__init__(config)
        self.models = load_models(config, self.task, self.eye)
        components, fovea = len(self.scenes.classes) + 1, config.sensor.fovea
        self.strategies = {
            name: make_strategy(policy, self.task, config.belief, components, self.models, fovea)
            for name, policy in self.policies.items()
        }
        folder, sensor = cache_folder(config.cache) / "saliency", self.eye.settings()["sensor"]
        size = config.belief.columns, config.belief.rows
        self.saliency_stores = {
            name: SaliencyStore(folder, name, config.saliency, sensor, size)
            for name in dict.fromkeys(policy.saliency for policy in self.policies.values())
            if name is not None
        }

    def _code(self) -> str:
        """Digest of the code of the run, and of policies that the user registered."""
        chosen = {policy.policy for policy in self.policies.values()} & POLICIES.keys()
        foreign = [name for name in sorted(chosen) if not POLICIES[name].__module__.startswith("semfov.")]
        return digest_of([super()._code(), [class_digest(POLICIES[name]) for name in foreign]])

    def _key(self) -> str:
        config, models = self.config, self.models
        fitted = {
            name: None if model is None else checksum(model.state_dict())
            for name, model in (("observation", models.observation), ("evidence", models.evidence))
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

    @abstractmethod
    def outcomes(self, index: int) -> tuple[list[Record], dict[str, float]]:
        """Run all episodes of a scene with all policies; returns records, and the seconds that each stage took."""

    def candidate(self, name: str, index: int) -> Candidate:
        """The policy of this name in tables, for a scene."""
        policy = self.policies[lookup(name, self.policies, "policy of this run")]
        strategy = self.strategies[name]
        if strategy.policy.table == "attention":
            return Candidate(strategy, self.attention(index))
        if policy.saliency is None:
            return Candidate(strategy)
        saliency = self.saliency(policy.saliency, index)
        if strategy.policy.table == "saliency":
            return Candidate(strategy, saliency)
        return Candidate(strategy, saliency=saliency, weight=self.config.saliency.weight)

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
