"""Looks at scenes from every cell of a grid, and policies that choose among the cells, made from their settings."""

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cached_property
from typing import Any, NamedTuple

from semfov.belief import MapEvidence, TargetEvidence
from semfov.belief.observers import LearnedMap, Observer, Semantic, Target
from semfov.errors import check
from semfov.eye import Eye
from semfov.gaze.acquisition.base import FUNCTIONS, Task
from semfov.gaze.acquisition.static import Uniform
from semfov.gaze.policies import Policy
from semfov.io.code import class_digest
from semfov.observation.foveal import FovealObservationModel
from semfov.runs.config import BeliefConfig, PolicyConfig, RunConfig
from semfov.runs.looking import Looking
from semfov.runs.presets import TARGET_EVIDENCE, label, resolve
from semfov.runs.scene_run import SceneRun, digest_of
from semfov.runs.setup import make_fitted, make_learned, make_observation
from semfov.strategy import Strategy


class PolicyLooking(Looking):
    """Looks at scenes, and policies that choose where to look in them."""

    task: Task
    config: RunConfig

    def __init__(self, config: RunConfig) -> None:
        check(len(config.policies) > 0, "policies", "at least one policy", "none")
        labels = [label(choice, self.task) for choice in config.policies]
        for name in labels:
            check(labels.count(name) == 1, "policies", "each policy once", f"{name!r} {labels.count(name)} times")
        self.policies = {name: resolve(choice, self.task) for name, choice in zip(labels, config.policies, strict=True)}
        super().__init__(config)
        components, fovea = len(self.scenes.classes) + 1, config.sensor.fovea
        loaded: dict[str, Any] = {}

        def model(name: str) -> Any:
            loaded[name] = loaded[name] if name in loaded else _load(name, config.belief, self.eye)
            return loaded[name]

        self.strategies: dict[str, Strategy] = {}
        observers: dict[PolicyConfig, Observer] = {}
        for name, policy in self.policies.items():
            made = _make_strategy(policy, self.task, config.belief, components, model, fovea)
            # Policies with the same belief share an observer, which then weighs each look only once.
            observer = observers.setdefault(_belief_settings(policy, self.task), made.observer)
            self.strategies[name] = Strategy(observer, made.policy)
        self.models = _Models(**loaded)

    @cached_property
    def code(self) -> str:
        """Digest of the code of the run, and of policies that the user registered."""
        chosen = {policy.policy for policy in self.policies.values()} & FUNCTIONS.keys()
        foreign = [name for name in sorted(chosen) if not FUNCTIONS[name].__module__.startswith("semfov.")]
        return digest_of([super().code, [class_digest(FUNCTIONS[name]) for name in foreign]])

    def depends_on(self) -> dict[str, Any]:
        """List the eye, the models of all policies, and the settings of belief, protocol and policies."""
        config, models = self.config, self.models
        policies = {name: asdict(policy) for name, policy in self.policies.items()}
        return {
            **super().depends_on(),
            "task": self.task,
            "models": [models.observation, models.fitted, models.evidence, models.map],
            "belief": {name: value for name, value in asdict(config.belief).items() if not name.endswith("model")},
            "protocol": {name: value for name, value in asdict(config.protocol).items() if name != "batch"},
            "policies": policies,
        }

    stored = SceneRun.stored  # nothing: the records are all that a comparison needs


class _Models(NamedTuple):
    """Fitted models that the policies of a run need; None for a model that no policy needs."""

    observation: FovealObservationModel | None = None
    fitted: FovealObservationModel | None = None
    evidence: TargetEvidence | None = None
    map: MapEvidence | None = None


def _load(name: str, belief: BeliefConfig, eye: Eye) -> Any:
    """Load a model that a policy needs, and check that it was fitted for the detector and the sensor."""
    if name == "observation":
        return make_observation(belief.model, eye)
    if name == "fitted":
        return make_fitted(belief.search_model, eye)
    if name == "evidence":
        return make_learned(TargetEvidence, belief.target_model, eye)
    return make_learned(MapEvidence, belief.map_model, eye)


def _by_evidence(policy: PolicyConfig, task: Task) -> bool:
    """Whether a policy uses the learned target evidence."""
    return policy.policy == TARGET_EVIDENCE or (task == "search" and policy.scores == "learned")


def _belief_settings(policy: PolicyConfig, task: Task) -> PolicyConfig:
    """The settings of a policy without those of its choice: policies for which they are equal have the same belief."""
    if _by_evidence(policy, task):
        return replace(policy, policy=TARGET_EVIDENCE, scores="learned", saliency=None, samples=None)
    return replace(policy, policy=Uniform.name, saliency=None, samples=None)


def _make_strategy(
    policy: PolicyConfig, task: Task, belief: BeliefConfig, components: int, model: Callable[[str], Any], fovea: float
) -> Strategy:
    """Build the observer and the policy that settings describe; `model` gives what they need by its name."""
    if policy.policy == TARGET_EVIDENCE:
        return Strategy(Target(model("evidence")), Policy("non-predictive"))
    calibrated, function = policy.scores == "calibrated", FUNCTIONS[policy.policy]
    needed = model("map" if function.needs_map else "observation") if "model" in function.takes else None
    common = {"fovea": fovea, "prior": belief.prior}
    own = {name: common[name] for name in common.keys() & function.takes}
    chosen = Policy(function, needed, samples=policy.samples, calibrated=calibrated, **own)
    if _by_evidence(policy, task):
        return Strategy(Target(model("evidence")), chosen)
    if policy.scores == "learned":
        return Strategy(LearnedMap(model("map")), chosen)
    if policy.scores == "fitted":
        return Strategy(Semantic.searching(model("fitted")), chosen)
    names = ("footprint", "tempering", "memory", "misses", "association")
    common_or_own = {name: getattr(belief if getattr(policy, name) is None else policy, name) for name in names}
    common_or_own["misses"] = model("observation") if common_or_own["misses"] else None
    observation = model("observation") if calibrated else None
    observer = Semantic(components, observation, prior=belief.prior, fusion=belief.fusion, **common_or_own)
    return Strategy(observer, chosen)
