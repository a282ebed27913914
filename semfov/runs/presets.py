"""Presets: policies by name, and labels for policies without a name."""

from collections.abc import Mapping
from dataclasses import fields, replace
from functools import cache
from types import MappingProxyType
from typing import get_args

from semfov.belief.grid import Footprint
from semfov.belief.observers import Association, CellMemory
from semfov.errors import InputError, lookup
from semfov.gaze.acquisition.base import FUNCTIONS, Task
from semfov.gaze.acquisition.static import Static, Uniform
from semfov.gaze.policies import policy_names
from semfov.runs.config import PolicyConfig, SaliencyModel, Scores

TARGET_EVIDENCE = "target-evidence"
_SALIENCY_MODELS: tuple[SaliencyModel, ...] = get_args(SaliencyModel)

_WORDS = {
    "scores": Scores,
    "footprint": Footprint,
    "memory": CellMemory,
    "association": Association,
    "saliency": SaliencyModel,
}
"""Settings with a fixed set of values."""

_ALIASES = ("recommended", "published")
"""Presets that have another name in tables, like those of `_MAXIMUM_A_POSTERIORI`."""

_MAXIMUM_A_POSTERIORI = "maximum-a-posteriori"
"""Name of Najemnik and Geisler (2005) for the searcher that fixates where the target is most probable."""

_OF_THE_MAP = ("tempering", "footprint", "memory", "misses", "association")  # settings of the map of all classes


def presets(task: Task) -> Mapping[str, PolicyConfig]:
    return _presets(task, tuple(policy_names(task)))


@cache
def _presets(task: Task, policies: tuple[str, ...]) -> Mapping[str, PolicyConfig]:
    plain = {name: PolicyConfig(name) for name in policies if name != Static.name}
    salient = {model: PolicyConfig(Static.name, saliency=model) for model in _SALIENCY_MODELS}
    if task == "search":
        # The scores do not matter to these: no belief guides them, or one of their own.
        alone = {name: PolicyConfig(name) for name in (Uniform.name, TARGET_EVIDENCE)}
        alone |= {name: policy for name, policy in plain.items() if not FUNCTIONS[name].by_belief} | salient
        alone["non-predictive-fitted"] = PolicyConfig("non-predictive", "fitted")
        best, published = PolicyConfig(TARGET_EVIDENCE), PolicyConfig("predictive", "calibrated")
        scored = {name: policy for name, policy in plain.items() if name not in alone}
        alone |= {f"{name}-learned": PolicyConfig(name, "learned") for name in scored if FUNCTIONS[name].by_place}
    else:
        best, published = PolicyConfig("closer-look", "learned"), PolicyConfig("kl", "calibrated")
        scored = {name: policy for name, policy in plain.items() if not FUNCTIONS[name].needs_map} | salient
        mapped = {**scored, "expected-gain": PolicyConfig("expected-gain")}
        mapped = {name: policy for name, policy in mapped.items() if not FUNCTIONS[policy.policy].needs_model}
        alone = {f"{name}-learned": replace(policy, scores="learned") for name, policy in mapped.items()}
    kinds: tuple[Scores, ...] = ("raw", "calibrated")
    both = {f"{name}-{kind}": replace(policy, scores=kind) for name, policy in scored.items() for kind in kinds}
    same = {"recommended": best, "published": published}
    if task == "search":
        same |= {f"{_MAXIMUM_A_POSTERIORI}-{kind}": both[f"non-predictive-{kind}"] for kind in kinds}
        same[f"{_MAXIMUM_A_POSTERIORI}-learned"] = alone[TARGET_EVIDENCE]
    return MappingProxyType({**alone, **both, **same})


def resolve(choice: str | PolicyConfig, task: Task) -> PolicyConfig:
    """The settings of a policy, which is given by the name of a preset or by settings."""
    by_name = presets(task)
    if isinstance(choice, str):
        if choice[:1] in ("[", "{"):
            settings = ", ".join(field.name for field in fields(PolicyConfig))
            raise InputError(f"policies: expected names of presets, or mappings with the keys {settings}; got {choice}")
        return by_name[lookup(choice, by_name, "policy")]
    lookup(choice.policy, [*policy_names(task), *([TARGET_EVIDENCE] if task == "search" else [])], "policy")
    saliency = choice.saliency if choice.policy == Static.name else None
    if choice.policy == Static.name and saliency is None:
        models = ", ".join(_SALIENCY_MODELS)
        raise InputError(f"saliency: expected a saliency model ({models}) for policy {choice.policy!r}, got none")
    for setting, words in _WORDS.items():
        if getattr(choice, setting) is not None:
            lookup(getattr(choice, setting), get_args(words), setting)
    if choice.samples is not None and not (
        choice.policy in FUNCTIONS and "likelihoods" in FUNCTIONS[choice.policy].takes
    ):
        names = ", ".join(name for name in policy_names(task) if "likelihoods" in FUNCTIONS[name].takes)
        raise InputError(f"samples: expected null, except for {names}; got {choice.samples} for {choice.policy!r}")
    known = presets(task).values()
    scores = [s for s in get_args(Scores) if PolicyConfig(choice.policy, s, saliency=saliency) in known] or ["raw"]
    if choice.scores not in scores:
        expected = " or ".join(map(repr, scores))
        raise InputError(f"scores: expected {expected} for policy {choice.policy!r}, got {choice.scores!r}")
    if choice.scores in ("learned", "fitted") or choice.policy == TARGET_EVIDENCE:
        conflict = next((setting for setting in _OF_THE_MAP if getattr(choice, setting) is not None), None)
        if conflict is not None:
            raise InputError(
                f"{conflict}: expected null, since policy {choice.policy!r} with {choice.scores!r} scores has its own "
                f"belief, got {getattr(choice, conflict)!r}"
            )
    return choice


def label(choice: str | PolicyConfig, task: Task) -> str:
    """The name of a policy in tables: the preset that it is based on, and the settings that differ from it."""
    settings = resolve(choice, task)
    names = {
        preset: name
        for name, preset in presets(task).items()
        if name not in _ALIASES and not name.startswith(_MAXIMUM_A_POSTERIORI)
    }
    alone = settings.saliency if settings.policy == Static.name else None
    base = names[PolicyConfig(settings.policy, settings.scores, saliency=alone)]
    differs = []
    for field in fields(PolicyConfig)[2:]:
        value = getattr(settings, field.name)
        if value is not None and not (field.name == "saliency" and alone is not None):
            text = f"{value:.15g}" if isinstance(value, float) else str(value).lower()
            differs.append(field.name if value is True else f"{field.name} {text}")
    return ", ".join([base, *differs])
