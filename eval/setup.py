"""From settings to objects: scenes, eye, observation model, policies."""

from __future__ import annotations

import json
import logging
import multiprocessing
from typing import Any

import torch

import semfov
from eval.config import BeliefConfig, DataConfig, DetectorConfig, SearchConfig, SensorConfig
from eval.protocol import Searcher
from semfov.belief import SemanticObserver
from semfov.data.scene import Scenes
from semfov.errors import InputError, check, lookup
from semfov.eye import Eye
from semfov.gaze import SEARCH_POLICIES, search_policy


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
        max_target_area=data.max_target_area,
        limit=data.limit,
    )


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
    model = semfov.load_detector(detector.name, **options)
    foveation = semfov.Foveation(sensor.sigma, levels=sensor.levels, growth=sensor.growth, convention=sensor.convention)
    return Eye(foveation, model, reference=sensor.reference).eval().requires_grad_(False)


def make_observation(config: SearchConfig, eye: Eye) -> semfov.FovealObservationModel:
    """The observation model, checked to belong to this detector, background policy and class list."""
    model = semfov.FovealObservationModel.from_pretrained(config.belief.model or eye.detector.name)
    model.check_compatible(eye.settings(), eye.detector.classes)
    return model.requires_grad_(False)


def split_policy(name: str) -> tuple[str, bool]:
    """`predictive-calibrated` -> (`predictive`, True); `random` -> (`random`, False)."""
    known = ["random"] + [f"{p}-{m}" for p in SEARCH_POLICIES[1:] for m in ("raw", "calibrated")]
    lookup(name, known, "policy")
    base, _, mode = name.rpartition("-")
    return (base, mode == "calibrated") if base else (name, False)


def needs_model(policies: tuple[str, ...]) -> bool:
    """Whether a policy of the run predicts or calibrates."""
    check(len(policies) > 0, "policies", "at least one policy", "none")
    return any(base == "predictive" or calibrated for base, calibrated in map(split_policy, policies))


def make_searcher(
    name: str, belief: BeliefConfig, components: int, model: semfov.FovealObservationModel | None
) -> Searcher:
    """How the policy of this name searches."""
    base, calibrated = split_policy(name)
    observer = SemanticObserver(
        components,
        model if calibrated else None,
        prior=belief.prior,
        fusion=belief.fusion,
        footprint=belief.footprint,
        tempering=belief.tempering,
        memory=belief.memory,
    )
    return Searcher(observer, search_policy(base, model, calibrated=calibrated))


def plain(settings: dict[str, Any]) -> Any:
    """Settings as JSON and YAML have them: paths as text, tuples as lists."""
    return json.loads(json.dumps(settings, default=str))


def prepare_worker() -> None:
    """One thread a process, so that detections do not depend on how many share the work; and no repeated notices."""
    torch.set_num_threads(1)
    if multiprocessing.parent_process() is not None:
        logging.getLogger("semfov").setLevel(logging.ERROR)
