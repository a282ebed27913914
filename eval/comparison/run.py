"""Policies compared in the same scenes, one scene at a time."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import asdict
from typing import Any

from semfov.gaze.policies import POLICIES
from semfov.io.code import class_digest
from semfov.runs.policy_looking import PolicyLooking
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import digest_of


class Run(PolicyLooking):
    """Policies compared in the same scenes; every process builds its own run from the settings."""

    def _code(self) -> str:
        """Digest of the code of the run, and of policies that the user registered."""
        chosen = {policy.policy for policy in self.policies.values()} & POLICIES.keys()
        foreign = [name for name in sorted(chosen) if not POLICIES[name].__module__.startswith("semfov.")]
        return digest_of([super()._code(), [class_digest(POLICIES[name]) for name in foreign]])

    def depends_on(self) -> dict[str, Any]:
        """List the eye, the models of all policies, and the settings of belief, protocol, policies and saliency."""
        config, models = self.config, self.models
        policies = {name: asdict(policy) for name, policy in self.policies.items()}
        return {
            **super().depends_on(),
            "task": self.task,
            "models": [models.observation, models.evidence, models.map, models.templates],
            "belief": {name: value for name, value in asdict(config.belief).items() if not name.endswith("model")},
            "protocol": {name: value for name, value in asdict(config.protocol).items() if name != "batch"},
            "policies": policies,
            "saliency": asdict(config.saliency) if self.saliency_stores else None,
        }

    @abstractmethod
    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Run all episodes of a scene with all policies; returns records, and the seconds that each stage took."""
