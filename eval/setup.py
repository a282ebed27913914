"""From settings to objects: scenes, eye, observation model, policies."""

from __future__ import annotations

import json
import logging
import multiprocessing
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch

import semfov
from eval.config import BeliefConfig, DataConfig, DetectorConfig, RunConfig, SearchConfig, SensorConfig
from eval.protocol import Searcher
from eval.saliency import SALIENCY_MODELS
from semfov.belief import ContextObserver, ContextPrior, Observer, SemanticObserver, TargetEvidence
from semfov.data.scene import Scenes
from semfov.errors import DataError, InputError, check, lookup
from semfov.eye import Eye
from semfov.gaze import EXPLORATION_POLICIES, SEARCH_POLICIES, LearnedGaze, exploration_policy, search_policy
from semfov.observation.compatibility import recommended

Kind = Literal["search", "exploration"]

TARGET_EVIDENCE = "target-evidence"
LEARNED = "learned-raw"

VARIANTS: dict[str, dict[str, Any]] = {
    "tempered": {"tempering": 0.25},
    "mild": {"tempering": 0.5},
    "closest": {"memory": "closest"},
    "soft": {"footprint": "soft"},
    "central": {"footprint": "box_centre"},
    "misses": {"misses": True},
    "context": {"context": "both"},
    "place": {"context": "place"},
    "cooccurrence": {"context": "cooccurrence"},
}
"""Settings of the belief that a policy may be followed by, `+tempered` and so on."""

_POLICIES: dict[Kind, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "search": (SEARCH_POLICIES[1:], (TARGET_EVIDENCE, LEARNED, "random", *SALIENCY_MODELS)),
    "exploration": ((*EXPLORATION_POLICIES, *SALIENCY_MODELS), ()),
}
"""Names of policies that come with `-raw` or `-calibrated`, and of those that come alone."""


def make_scenes(data: DataConfig, classes: tuple[str, ...]) -> Scenes:
    """The scenes to search: photographs where a root is given, else embedded ones."""
    if (data.root is None) != (data.annotations is None):
        raise InputError("data: expected both data.root and data.annotations, or neither for the embedded scenes")
    if data.root is None:
        from semfov.data.scenes import EmbeddedScenes

        return EmbeddedScenes(classes, count=data.limit or 8, seed=data.scene_seed)
    from semfov.data.coco import CocoScenes

    return CocoScenes(
        data.root,
        data.annotations,
        classes,
        min_instances=data.min_instances,
        ids=None if data.ids is None else read_ids(data.ids),
        max_target_area=data.max_target_area,
        limit=data.limit,
    )


def read_ids(path: Path) -> list[str]:
    """Ids of photographs, one a line."""
    try:
        return path.read_text(encoding="utf-8").split()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as a list of ids ({error})") from None


def make_eye(detector: DetectorConfig, sensor: SensorConfig) -> Eye:
    """The foveal sensor and the detector behind it."""
    options: dict[str, object] = {
        "background": detector.background,
        "threshold": detector.threshold,
        "iou": detector.iou,
        "limit": detector.limit,
    }
    if detector.weights is not None:
        options["weights"] = detector.weights
    if detector.stride != "auto":
        options["stride"] = detector.stride
    if detector.input_size is not None:
        options["input_size"] = detector.input_size
    if detector.runtime != "auto":
        options["runtime"] = detector.runtime
    model = semfov.load_detector(detector.name, **options)
    return Eye(sensor.make(), model, reference=sensor.reference).eval().requires_grad_(False)


def make_observation(name: str | None, eye: Eye) -> semfov.FovealObservationModel:
    """The observation model of that name, or the one for this eye; checked to belong to detector and class list."""
    model = semfov.FovealObservationModel.from_pretrained(name or recommended(eye.detector.name, eye.sensor.growth))
    model.check_compatible(eye.settings(), eye.detector.classes)
    return model.requires_grad_(False)


def make_target_evidence(config: SearchConfig, eye: Eye) -> TargetEvidence:
    """The learned evidence for a target, checked to belong to this detector."""
    model = TargetEvidence.from_pretrained(config.belief.target_model or eye.detector.name)
    model.check_compatible(eye.settings())
    return model.requires_grad_(False)


def make_learned_gaze(config: SearchConfig, eye: Eye) -> LearnedGaze:
    """The gaze policy that was learned end to end, checked to belong to this detector."""
    gaze = LearnedGaze.from_pretrained(config.gaze_model or eye.detector.name)
    gaze.check_compatible(eye.settings())
    return gaze.requires_grad_(False)


def make_context(config: RunConfig, eye: Eye) -> ContextPrior:
    """The context of searches, checked to know the detector's classes."""
    prior = ContextPrior.from_pretrained(config.belief.context_model)
    prior.check_compatible(eye.detector.classes)
    return prior.requires_grad_(False)


def split_policy(name: str, kind: Kind) -> tuple[str, bool]:
    """The policy and whether scores are calibrated: `predictive-calibrated+soft` -> (`predictive`, True).

    For search, policies that do not look at the belief have no such ending.
    """
    moded, bare = _POLICIES[kind]
    name = name.partition("+")[0]
    known = [*bare, *(f"{policy}-{mode}" for policy in moded for mode in ("raw", "calibrated"))]
    lookup(name, known, "policy")
    base, _, mode = name.rpartition("-")
    return (name, False) if name in bare else (base, mode == "calibrated")


def belief_of(name: str, belief: BeliefConfig) -> BeliefConfig:
    """Settings of the belief for a policy: those of the run, changed as the `+` endings of its name say."""
    for variant in name.split("+")[1:]:
        if variant not in SALIENCY_MODELS:
            belief = replace(belief, **VARIANTS[lookup(variant, [*VARIANTS, *SALIENCY_MODELS], "policy setting")])
    return belief


def saliency_of(name: str, kind: Kind) -> str | None:
    """The saliency model that a policy goes by (`vocus2-raw`), or has as a prior (`non-predictive-raw+vocus2`)."""
    base, _ = split_policy(name, kind)
    if base in SALIENCY_MODELS:
        return base
    return next((variant for variant in name.split("+")[1:] if variant in SALIENCY_MODELS), None)


def saliency_policies(policies: tuple[str, ...], kind: Kind) -> list[str]:
    """Saliency models that a run needs, each once."""
    return list(dict.fromkeys(model for name in policies if (model := saliency_of(name, kind)) is not None))


def needs_model(policies: tuple[str, ...], kind: Kind) -> bool:
    """Whether a policy of the run needs an observation model: to predict, to calibrate, or for its miss rates."""
    check(len(policies) > 0, "policies", "at least one policy", "none")
    without = (TARGET_EVIDENCE, LEARNED, "random", "non-predictive", "closer-look", *SALIENCY_MODELS)
    predicts = any(base not in without or calibrated for base, calibrated in _split(policies, kind))
    return predicts or any(belief_of(name, BeliefConfig()).misses for name in policies)


def needs_target(policies: tuple[str, ...], kind: Kind) -> bool:
    """Whether a policy of the run needs learned target evidence."""
    return any(base == TARGET_EVIDENCE for base, _ in _split(policies, kind))


def needs_context(policies: tuple[str, ...], belief: BeliefConfig) -> bool:
    """Whether a policy of the run adds context."""
    return any(belief_of(name, belief).context != "none" for name in policies)


def in_context(name: str, kind: Kind, observer: Observer, belief: BeliefConfig, prior: ContextPrior | None) -> Observer:
    """The observer of a policy, with context where the policy or the run asks for it."""
    part = belief_of(name, belief).context
    if part == "none":
        return observer
    base, _ = split_policy(name, kind)
    if kind != "search" or base not in (TARGET_EVIDENCE, "non-predictive"):
        raise InputError(f"belief.context: expected a search by the probability of the target, got policy {name!r}")
    if prior is None:
        raise InputError("belief.context: expected a fitted context, got none")
    place, company = prior.weights_for("evidence" if observer.by_target else "map")
    return ContextObserver(observer, prior, (place * (part != "cooccurrence"), company * (part != "place")))


def _split(policies: tuple[str, ...], kind: Kind) -> list[tuple[str, bool]]:
    return [split_policy(name, kind) for name in policies]


def make_searcher(
    name: str,
    kind: Kind,
    belief: BeliefConfig,
    components: int,
    model: semfov.FovealObservationModel | None,
    fovea: float = 100 / 640,
) -> Searcher:
    """How the policy of this name searches or explores.

    Args:
        name: of the policy.
        kind: of the experiment.
        belief: the grid of beliefs.
        components: classes, background included.
        model: the observation model, where one is needed.
        fovea: width of the fovea in longer sides of the image.
    """
    base, calibrated = split_policy(name, kind)
    belief = belief_of(name, belief)
    if belief.misses and model is None:
        raise InputError("belief.misses: expected a policy that uses an observation model, or add +misses to its name")
    observer = SemanticObserver(
        components,
        model if calibrated else None,
        prior=belief.prior,
        fusion=belief.fusion,
        footprint=belief.footprint,
        tempering=belief.tempering,
        memory=belief.memory,
        misses=model.miss_likelihood if belief.misses and model is not None else None,
    )
    if base in SALIENCY_MODELS:
        return Searcher(observer, search_policy("random"))
    if kind == "search":
        return Searcher(observer, search_policy(base, model))
    return Searcher(observer, exploration_policy(base, model, fovea=fovea, prior=belief.prior))


def plain(settings: dict[str, Any]) -> Any:
    """Settings as JSON and YAML have them: paths as text, tuples as lists."""
    return json.loads(json.dumps(settings, default=str))


def prepare_worker() -> None:
    """One thread a process, so that detections do not depend on how many share the work; and no repeated notices."""
    torch.set_num_threads(1)
    # Freeing one large block raises glibc's threshold for handing memory back, or it would do so after every look.
    torch.empty(31 << 20, dtype=torch.uint8)
    if multiprocessing.parent_process() is not None:
        logging.getLogger("semfov").setLevel(logging.ERROR)
