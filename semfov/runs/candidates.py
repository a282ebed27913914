"""Policies under comparison: loads their models, and builds observer and policy from the settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from semfov.belief import Grid, MapEvidence, TargetEvidence
from semfov.belief.observers import LearnedMap, Observer, Semantic, Target
from semfov.errors import InputError, check
from semfov.eye import Eye
from semfov.gaze.acquisition import AcquisitionFunction, SaliencyPrior, Static
from semfov.gaze.policies import POLICIES, Means, NonPredictive, Random, SaliencyMaximum, Task, named_policy
from semfov.observation.foveal import FovealObservationModel
from semfov.runs.config import BeliefConfig, PolicyConfig, RunConfig
from semfov.runs.presets import TARGET_EVIDENCE, resolve
from semfov.runs.setup import make_learned, make_observation
from semfov.strategy import Strategy

_T = TypeVar("_T")


@dataclass(frozen=True)
class Candidate:
    """A policy under comparison, in one scene; saliency `(X·Y, X·Y)` from every cell, or `(1, X·Y)` from anywhere."""

    strategy: Strategy
    saliency: Tensor | None = None
    weight: float = 1.0

    @property
    def observer(self) -> Observer:
        """The observer, which updates the belief with looks."""
        return self.strategy.observer

    def acquisition(self, target: int | Tensor | None, grid: Grid, cell: Tensor) -> AcquisitionFunction:
        """The acquisition function of episodes that fixate `cell` `(B,)`."""
        policy = self.strategy.policy
        if self.saliency is None:
            alone: AcquisitionFunction = policy(target, grid)
            return alone
        salient = self.saliency[cell if len(self.saliency) > 1 else torch.zeros_like(cell)]
        if isinstance(policy, SaliencyMaximum):
            return Static(salient)
        return SaliencyPrior(policy(target, grid), salient, weight=self.weight)


class _Models(NamedTuple):
    """Fitted models that the policies of a run need; None for a model that no policy needs."""

    observation: FovealObservationModel | None = None
    evidence: TargetEvidence | None = None
    map: MapEvidence | None = None


def load_models(config: RunConfig, task: Task, eye: Eye) -> _Models:
    """Load the models that a run needs, and check that they were fitted for its detector and sensor."""
    check(len(config.policies) > 0, "policies", "at least one policy", "none")
    policies = [resolve(choice, task) for choice in config.policies]
    belief = config.belief
    return _Models(
        make_observation(belief.model, eye) if _needs_observation(policies, belief) else None,
        make_learned(TargetEvidence, belief.target_model, eye)
        if any(_by_evidence(policy, task) for policy in policies)
        else None,
        make_learned(MapEvidence, belief.map_model, eye)
        if any(policy.scores == "learned" and not _by_evidence(policy, task) for policy in policies)
        else None,
    )


def _by_evidence(policy: PolicyConfig, task: Task) -> bool:
    """Whether a policy uses the learned target evidence."""
    return policy.policy == TARGET_EVIDENCE or (task == "search" and policy.scores == "learned")


def belief_settings(policy: PolicyConfig, task: Task) -> PolicyConfig:
    """The settings of a policy without those of its choice: policies for which they are equal have the same belief."""
    if _by_evidence(policy, task):
        return replace(policy, policy=TARGET_EVIDENCE, scores="learned", saliency=None, samples=None)
    return replace(policy, policy=Random.name, saliency=None, samples=None)


def _needs_observation(policies: Sequence[PolicyConfig], belief: BeliefConfig) -> bool:
    """Whether any policy needs an observation model: to predict, to calibrate scores, or for the miss rates."""
    return any(
        policy.scores == "calibrated"
        or _of(policy.misses, belief.misses)
        or (policy.policy in POLICIES and POLICIES[policy.policy].needs_model)
        for policy in policies
    )


def make_strategy(
    policy: PolicyConfig, task: Task, belief: BeliefConfig, components: int, models: _Models, fovea: float
) -> Strategy:
    """Build the observer and the policy that settings describe."""
    if policy.policy == TARGET_EVIDENCE:
        return Strategy(Target(_required(models.evidence, "policy", "learned target evidence")), NonPredictive())
    calibrated = policy.scores == "calibrated"
    means = Means(models.observation, models.map, fovea, belief.prior, policy.samples, calibrated)
    chosen = named_policy(policy.policy, task, means)
    if _by_evidence(policy, task):
        return Strategy(Target(_required(models.evidence, "scores", "learned target evidence")), chosen)
    if policy.scores == "learned":
        return Strategy(LearnedMap(_required(models.map, "scores", "a learned map")), chosen)
    misses = _of(policy.misses, belief.misses)
    observer = Semantic(
        components,
        _required(models.observation, "scores", "an observation model") if calibrated else None,
        prior=belief.prior,
        fusion=belief.fusion,
        footprint=_of(policy.footprint, belief.footprint),
        tempering=_of(policy.tempering, belief.tempering),
        memory=_of(policy.memory, belief.memory),
        misses=_required(models.observation, "misses", "an observation model") if misses else None,
    )
    return Strategy(observer, chosen)


def _of(own: _T | None, common: _T) -> _T:
    return common if own is None else own


def _required(model: _T | None, argument: str, expected: str) -> _T:
    if model is None:
        raise InputError(f"{argument}: expected {expected}, got none")
    return model
