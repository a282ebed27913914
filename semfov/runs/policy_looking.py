"""Looks at scenes from every cell of a grid, and policies that choose among the cells, made from their settings."""

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

from semfov.belief.observers import Observer, Semantic, SemanticMap, SemanticSearch
from semfov.errors import check
from semfov.eye import Eye
from semfov.gaze.acquisition.base import FUNCTIONS, Task
from semfov.gaze.acquisition.static import Uniform
from semfov.gaze.policies import Policy
from semfov.io.code import class_digest
from semfov.observation.foveal import FovealObservationModel
from semfov.runs.config import BeliefConfig, PolicyConfig, RunConfig
from semfov.runs.looking import Looking
from semfov.runs.presets import label, resolve
from semfov.runs.scene_run import SceneRun, digest_of
from semfov.runs.setup import make_map, make_observation, make_searching
from semfov.strategy import Strategy

_OF_SEMANTIC = ("footprint", "tempering", "memory", "misses")
"""Settings of the belief that a policy may have of its own."""


class PolicyLooking(Looking):
    """Looks at scenes, and policies that choose where to look in them.

    Attributes:
        policies: the settings of the policies, by label.
        strategies: observer and policy of each, by label.
        models: the fitted models that they need.
    """

    task: Task
    config: RunConfig

    def __init__(self, config: RunConfig) -> None:
        self.policies = _labelled(config, self.task)
        super().__init__(config)
        models = _LoadedModels(config.belief, self.eye)
        self.strategies: dict[str, Strategy] = {}
        observers: dict[PolicyConfig, Observer] = {}
        for name, policy in self.policies.items():
            strategy = _make_strategy(
                policy, self.task, config.belief, len(self.scenes.classes) + 1, models, config.sensor.fovea
            )
            # Policies with the same belief share an observer, which then weighs each look only once.
            observer = observers.setdefault(_belief_settings(policy), strategy.observer)
            self.strategies[name] = Strategy(observer, strategy.policy)
        self.models = _Models(**models.loaded)

    @cached_property
    def code(self) -> str:
        """Digest of the code of the run, and of policies that the user registered."""
        chosen = {policy.policy for policy in self.policies.values()} & FUNCTIONS.keys()
        foreign = [name for name in sorted(chosen) if not FUNCTIONS[name].__module__.startswith("semfov.")]
        return digest_of([super().code, [class_digest(FUNCTIONS[name]) for name in foreign]])

    def depends_on(self) -> dict[str, Any]:
        """List the eye, the models of all policies, and the settings of belief, protocol and policies."""
        models = self.models
        belief = asdict(self.config.belief)
        protocol = asdict(self.config.protocol)
        return {
            **super().depends_on(),
            "task": self.task,
            "models": [models.observation, models.search, models.map],
            # Models count by their digests, and the size of batches changes nothing.
            "belief": {name: value for name, value in belief.items() if not name.endswith("model")},
            "protocol": {name: value for name, value in protocol.items() if name != "batch"},
            "policies": {name: asdict(policy) for name, policy in self.policies.items()},
        }

    stored = SceneRun.stored  # nothing: the records are all that a comparison needs


def _labelled(config: RunConfig, task: Task) -> dict[str, PolicyConfig]:
    """Resolve the policies of a run, by label; raises `InputError` if there is none, or one twice."""
    check(len(config.policies) > 0, "policies", "at least one policy", "none")
    labels = [label(choice, task) for choice in config.policies]
    for name in labels:
        check(labels.count(name) == 1, "policies", "each policy once", f"{name!r} {labels.count(name)} times")
    return {name: resolve(choice, task) for name, choice in zip(labels, config.policies, strict=True)}


class _Models(NamedTuple):
    """Fitted models that the policies of a run need; None for a model that no policy needs."""

    observation: FovealObservationModel | None = None
    search: FovealObservationModel | None = None
    map: FovealObservationModel | None = None


class _LoadedModels:
    """Models by name, each loaded and checked by detector and sensor when it is asked for the first time."""

    def __init__(self, belief: BeliefConfig, eye: Eye) -> None:
        self._make: dict[str, Callable[[], FovealObservationModel]] = {
            "observation": partial(make_observation, belief.model, eye),
            "search": partial(make_searching, belief.search_model, eye),
            "map": partial(make_map, belief.map_model, eye),
        }
        self.loaded: dict[str, FovealObservationModel] = {}

    def __call__(self, name: str) -> FovealObservationModel:
        if name not in self.loaded:
            self.loaded[name] = self._make[name]()
        return self.loaded[name]


_Model = Callable[[str], FovealObservationModel]
"""Gives a model by its name (`_LoadedModels`)."""


def _belief_settings(policy: PolicyConfig) -> PolicyConfig:
    """Return settings that are equal for policies with the same belief: those of the policy without its choice."""
    return replace(policy, policy=Uniform.name, saliency=None, samples=None)


def _make_strategy(
    policy: PolicyConfig,
    task: Task,
    belief: BeliefConfig,
    components: int,
    model: _Model,
    fovea: float,
) -> Strategy:
    """Build the observer and the policy that settings describe.

    Args:
        policy: settings of the policy.
        task: what it does.
        belief: settings of the belief, where the policy has none of its own.
        components: number of scores in all, K + 1.
        model: gives the models that are needed, by name.
        fovea: radius of the fovea, in units of the image's longer side.

    Returns:
        The strategy.
    """
    chosen = _make_policy(policy, belief, model, fovea)
    if policy.scores == "learned":
        observer = SemanticSearch(model("search")) if task == "search" else SemanticMap(model("map"))
        return Strategy(observer, chosen)
    return Strategy(_make_semantic(policy, belief, components, model), chosen)


def _make_policy(policy: PolicyConfig, belief: BeliefConfig, model: _Model, fovea: float) -> Policy:
    """Build the policy, with what its acquisition function takes."""
    function = FUNCTIONS[policy.policy]
    needed = model("observation") if "model" in function.takes else None
    available = {"fovea": fovea, "prior": belief.prior}
    options = {name: available[name] for name in available.keys() & function.takes}
    return Policy(function, needed, samples=policy.samples, calibrated=policy.scores == "calibrated", **options)


def _make_semantic(policy: PolicyConfig, belief: BeliefConfig, components: int, model: _Model) -> Semantic:
    """Build the observer that fuses scores, with the settings of the policy or else those of the belief."""
    settings = {name: getattr(belief if getattr(policy, name) is None else policy, name) for name in _OF_SEMANTIC}
    settings["misses"] = model("observation") if settings["misses"] else None
    observation = model("observation") if policy.scores == "calibrated" else None
    return Semantic(components, observation, prior=belief.prior, fusion=belief.fusion, **settings)
