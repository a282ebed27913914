"""Looks at scenes from every cell of a grid, and policies that choose among the cells."""

from __future__ import annotations

from dataclasses import asdict
from functools import cached_property
from typing import Any

from semfov.belief.observers import Observer
from semfov.errors import check
from semfov.gaze.policies import POLICIES, Task
from semfov.io.code import class_digest
from semfov.runs.candidates import belief_settings, load_models, make_strategy
from semfov.runs.config import PolicyConfig, RunConfig
from semfov.runs.looking import Looking
from semfov.runs.presets import label, resolve
from semfov.runs.scene_run import digest_of
from semfov.strategy import Strategy


class PolicyLooking(Looking):
    """Looks at scenes, and policies that choose where to look in them."""

    task: Task
    config: RunConfig

    def __init__(self, config: RunConfig) -> None:
        labels = [label(choice, self.task) for choice in config.policies]
        for name in labels:
            check(labels.count(name) == 1, "policies", "each policy once", f"{name!r} {labels.count(name)} times")
        self.policies = {name: resolve(choice, self.task) for name, choice in zip(labels, config.policies, strict=True)}
        super().__init__(config)
        self.models = load_models(config, self.task, self.eye)
        components, fovea = len(self.scenes.classes) + 1, config.sensor.fovea
        self.strategies: dict[str, Strategy] = {}
        observers: dict[PolicyConfig, Observer] = {}
        for name, policy in self.policies.items():
            made = make_strategy(policy, self.task, config.belief, components, self.models, fovea)
            # Policies with the same belief share an observer, which then weighs each look only once.
            observer = observers.setdefault(belief_settings(policy, self.task), made.observer)
            self.strategies[name] = Strategy(observer, made.policy)

    @cached_property
    def code(self) -> str:
        """Digest of the code of the run, and of policies that the user registered."""
        chosen = {policy.policy for policy in self.policies.values()} & POLICIES.keys()
        foreign = [name for name in sorted(chosen) if not POLICIES[name].__module__.startswith("semfov.")]
        return digest_of([super().code, [class_digest(POLICIES[name]) for name in foreign]])

    def depends_on(self) -> dict[str, Any]:
        """List the eye, the models of all policies, and the settings of belief, protocol and policies."""
        config, models = self.config, self.models
        policies = {name: asdict(policy) for name, policy in self.policies.items()}
        return {
            **super().depends_on(),
            "task": self.task,
            "models": [models.observation, models.evidence, models.map],
            "belief": {name: value for name, value in asdict(config.belief).items() if not name.endswith("model")},
            "protocol": {name: value for name, value in asdict(config.protocol).items() if name != "batch"},
            "policies": policies,
        }

    def stored(self, index: int) -> bytes | None:
        """Nothing: the records are all that a comparison needs."""
        return None
