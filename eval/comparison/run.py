"""Policies compared in the same scenes, one scene at a time."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import asdict

from semfov.gaze.policies import POLICIES
from semfov.io.code import class_digest
from semfov.io.storage import checksum
from semfov.runs.policy_looking import PolicyLooking
from semfov.runs.results import Record
from semfov.runs.scene_run import digest_of


class Run(PolicyLooking):
    """Policies compared in the same scenes; every process builds its own run from the settings."""

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
