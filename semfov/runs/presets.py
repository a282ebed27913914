"""Presets: policies by name, and labels for policies without a name."""

from collections.abc import Mapping
from dataclasses import fields, replace
from functools import cache
from types import MappingProxyType
from typing import get_args

from semfov.belief.grid import Footprint
from semfov.belief.observers import CellMemory
from semfov.errors import InputError, check, lookup
from semfov.gaze.acquisition.base import FUNCTIONS, Task
from semfov.gaze.acquisition.search import TargetPosterior
from semfov.gaze.acquisition.static import Static, Uniform
from semfov.gaze.policies import policy_names
from semfov.runs.config import PolicyConfig, SaliencyModel, Scores

AGENT = "non-predictive-learned"
"""Preset of the searches of the agent (`semfov.ActivePerception.recommended`)."""

_SALIENCY_MODELS: tuple[SaliencyModel, ...] = get_args(SaliencyModel)

_WORDS = {
    "scores": Scores,
    "footprint": Footprint,
    "memory": CellMemory,
    "saliency": SaliencyModel,
}
"""Settings with a fixed set of values."""

_ALIASES = ("recommended", "published")
"""Presets that have another name in tables, like those of `_MAXIMUM_A_POSTERIORI`."""

_MAXIMUM_A_POSTERIORI = "maximum-a-posteriori"
"""Name of Najemnik and Geisler (2005) for the searcher that fixates where the target is most probable."""

_SCORED: tuple[Scores, ...] = ("raw", "calibrated")  # scores that any policy guided by the belief can have

_Presets = dict[str, PolicyConfig]

_OF_THE_MAP = ("tempering", "footprint", "memory", "misses")  # settings of the map of all classes


def presets(task: Task) -> Mapping[str, PolicyConfig]:
    """List the policies that have a name.

    Args:
        task: `search` or `exploration`.

    Returns:
        Their settings by name.
    """
    return _presets(task, tuple(policy_names(task)))


@cache
def _presets(task: Task, policies: tuple[str, ...]) -> Mapping[str, PolicyConfig]:
    """Make the presets of a task, made anew where policies were registered since."""
    plain = {name: PolicyConfig(name) for name in policies if name != Static.name}
    salient: _Presets = {model: PolicyConfig(Static.name, saliency=model) for model in _SALIENCY_MODELS}
    if task == "search":
        return MappingProxyType(_search_presets(plain, salient))
    return MappingProxyType(_exploration_presets(plain, salient))


def _search_presets(plain: _Presets, salient: _Presets) -> _Presets:
    """Make the presets of searches, of policies and of saliency maps by name."""
    without_scores = {Uniform.name: PolicyConfig(Uniform.name)}
    scored: _Presets = {}
    for name, policy in plain.items():
        # The scores do not matter to a policy that no belief guides.
        presets = scored if FUNCTIONS[name].by_belief else without_scores
        presets[name] = policy
    # Of the learned belief these use the probabilities alone, for which it is fitted.
    by_chance = [name for name in scored if name == TargetPosterior.name or FUNCTIONS[name].by_place]
    learned = {f"{name}-learned": PolicyConfig(name, "learned") for name in by_chance}
    with_scores = {**learned, **_with_both_scores(scored)}
    named = {"recommended": with_scores[AGENT], "published": with_scores["predictive-calibrated"]}
    for scores in get_args(Scores):
        named[f"{_MAXIMUM_A_POSTERIORI}-{scores}"] = with_scores[f"non-predictive-{scores}"]
    return {**without_scores, **salient, **with_scores, **named}


def _exploration_presets(plain: _Presets, salient: _Presets) -> _Presets:
    """Make the presets of explorations, of policies and of saliency maps by name."""
    scored = plain | salient
    learned = {
        f"{name}-learned": replace(policy, scores="learned")
        for name, policy in scored.items()
        if not FUNCTIONS[policy.policy].needs_model
    }
    named = {"recommended": PolicyConfig("closer-look", "learned"), "published": PolicyConfig("kl", "calibrated")}
    return {**learned, **_with_both_scores(scored), **named}


def _with_both_scores(policies: _Presets) -> _Presets:
    """Make policies with raw and with calibrated scores, after which the presets are named."""
    named = {}
    for name, policy in policies.items():
        for scores in _SCORED:
            named[f"{name}-{scores}"] = replace(policy, scores=scores)
    return named


def resolve(choice: str | PolicyConfig, task: Task) -> PolicyConfig:
    """Find the settings of a policy, and check that they suit each other.

    Args:
        choice: the name of a preset, or settings.
        task: `search` or `exploration`.

    Returns:
        The settings.

    Raises:
        InputError: the name is unknown, or a setting does not suit the policy.
    """
    if isinstance(choice, str):
        return _preset(choice, task)
    lookup(choice.policy, policy_names(task), "policy")
    _check_words(choice)
    if choice.samples is not None:
        _check_takes_samples(choice, task)
    _check_scores(choice, task)
    # A learned belief is fitted with its own footprint, memory and tempering.
    if choice.scores == "learned":
        _check_own_belief(choice)
    return choice


def _preset(name: str, task: Task) -> PolicyConfig:
    """Look up the preset of a name."""
    if name[:1] in ("[", "{"):
        settings = ", ".join(field.name for field in fields(PolicyConfig))
        raise InputError(f"policies: expected names of presets, or mappings with the keys {settings}; got {name}")
    by_name = presets(task)
    return by_name[lookup(name, by_name, "policy")]


def _check_takes_samples(choice: PolicyConfig, task: Task) -> None:
    """Raise `InputError` for drawn looks of a policy that takes no expectation over looks."""
    names = [name for name in policy_names(task) if "likelihoods" in FUNCTIONS[name].takes]
    if choice.policy not in names:
        raise InputError(
            f"samples: expected null, except for {', '.join(names)}; got {choice.samples} for {choice.policy!r}"
        )


def _check_scores(choice: PolicyConfig, task: Task) -> None:
    """Raise `InputError` for scores with which no preset has the policy."""
    all_presets = presets(task).values()
    possible = [scores for scores in get_args(Scores) if _based_on(choice, scores) in all_presets] or ["raw"]
    check(
        choice.scores in possible,
        "scores",
        f"{' or '.join(map(repr, possible))} for policy {choice.policy!r}",
        repr(choice.scores),
    )


def _check_words(choice: PolicyConfig) -> None:
    """Raise `InputError` for a setting that is none of its words, and for a saliency map that is not named."""
    if choice.policy == Static.name and choice.saliency is None:
        models = ", ".join(_SALIENCY_MODELS)
        raise InputError(f"saliency: expected a saliency model ({models}) for policy {choice.policy!r}, got none")
    for setting, words in _WORDS.items():
        word = getattr(choice, setting)
        if word is not None:
            lookup(word, get_args(words), setting)


def _check_own_belief(choice: PolicyConfig) -> None:
    """Raise `InputError` for settings of the map of all classes where the policy has a belief of its own."""
    for setting in _OF_THE_MAP:
        value = getattr(choice, setting)
        if value is not None:
            raise InputError(
                f"{setting}: expected null, since policy {choice.policy!r} with {choice.scores!r} scores has its own "
                f"belief, got {value!r}"
            )


def _based_on(choice: PolicyConfig, scores: Scores) -> PolicyConfig:
    """Make the preset that settings are based on, with some scores: a static policy is named by its saliency map."""
    saliency = choice.saliency if choice.policy == Static.name else None
    return PolicyConfig(choice.policy, scores, saliency=saliency)


def label(choice: str | PolicyConfig, task: Task) -> str:
    """Name a policy for tables: the preset that it is based on, and the settings that differ from it.

    Args:
        choice: the name of a preset, or settings.
        task: `search` or `exploration`.

    Returns:
        The label, such as `kl-calibrated, tempering 0.5`.
    """
    settings = resolve(choice, task)
    names = {
        preset: name
        for name, preset in presets(task).items()
        if name not in _ALIASES and not name.startswith(_MAXIMUM_A_POSTERIORI)
    }
    base = _based_on(settings, settings.scores)
    differences = []
    for field in fields(PolicyConfig)[2:]:  # after the policy and its scores, which the base has
        value = getattr(settings, field.name)
        if value not in (None, getattr(base, field.name)):
            differences.append(_setting_in_words(field.name, value))
    return ", ".join([names[base], *differences])


def _setting_in_words(name: str, value: object) -> str:
    """Write a setting with its value; one that is on has its name alone."""
    if value is True:
        return name
    return f"{name} {value:.15g}" if isinstance(value, float) else f"{name} {value}".lower()
