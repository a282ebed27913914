"""Calibrating beside training: what a detector sees and finds, raw and with an observation model fitted to it."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import Scenes
from semfov.experiments.config import BeliefConfig, SearchConfig
from semfov.experiments.parallel import processor_seconds
from semfov.experiments.run import finish
from semfov.experiments.runs import SearchRun
from semfov.experiments.samples import Samples, SampleSettings, collect
from semfov.experiments.search_report import expected_random
from semfov.experiments.setup import plain
from semfov.experiments.store import versions
from semfov.experiments.summary import gather
from semfov.io.code import modules_digest
from semfov.io.files import write_text
from semfov.metrics.averages import Array
from semfov.metrics.recall import found_objects, score_for
from semfov.metrics.search import cumulative_performance
from semfov.observation.foveal import FovealObservationModel
from semfov.training.observation import fit_model
from semfov.training.observation_settings import FitConfig

SCORES = ("raw", "calibrated")


@dataclass(frozen=True)
class Arm:
    """A detector with one kind of scores: what it said of photographs that nothing was fitted on, and what it found.

    Attributes:
        probabilities: `(M, K+1)`, of the classes of its detections.
        labels: `(M,)`, their true classes, 0 where they show no object.
        level: `(M,)`, level of their distance to the fixation.
        recall: share of the objects found with `rate` false boxes a look: by photograph and level, `(P, N)`, and over
            all levels, `(P,)`, NaN where there is no object.
        objects: `(N,)`, objects of all looks by level.
        curves: cumulative performance of its searches by photograph, `(S, shifts+1)`.
        chance: what random gaze finds by the formula, `(shifts+1,)`.
        minutes: of processors that the fit of its observation model took; 0 for raw scores.
    """

    probabilities: Tensor
    labels: Tensor
    level: Tensor
    recall: tuple[Array, Array]
    objects: Tensor
    curves: Array
    chance: Array
    minutes: float


def fitted(config: FitConfig) -> tuple[FovealObservationModel, Path, float]:
    """An observation model of all photographs of the settings, its file, and the minutes of processors that it took.

    It is fitted once, and read back by later calls with the same settings. (The minutes are those of the call that
    fitted it: of a run that was stopped while it looked, the last part.)
    """
    path, record = config.out / "observation.safetensors", config.out / "fit.json"
    settings = plain(asdict(config)) | {
        "workers": None,
        "code": modules_digest("semfov.training.observation"),
        "versions": plain(versions()),
    }
    try:
        told = json.loads(record.read_text(encoding="utf-8"))
        if told["settings"] == settings:
            return FovealObservationModel.from_pretrained(path), path, float(told["minutes"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    started = processor_seconds()
    sampler, samples = collect(SampleSettings.of(config), config.out / "samples", config.workers, "looking")
    model = fit_model(config, sampler, samples)
    minutes = (processor_seconds() - started) / 60
    model.save(path)
    write_text(record, json.dumps({"settings": settings, "minutes": minutes}, indent=2) + "\n")
    return model, path, minutes


def arms_of(
    fit: FitConfig, search: SearchConfig, policy: str, fixations: int, rate: float, most: int | None = None
) -> dict[str, Arm]:
    """The arms of a detector, `raw` and `calibrated`.

    Args:
        fit: settings of the fit of its observation model.
        search: settings of the searches, without policies and model.
        policy: that searches.
        fixations: random fixations in each photograph, by which recall and calibration are measured.
        rate: false boxes in a look at which objects are counted as found.
        most: photographs that are searched, the first ones; None: all.
    """
    model, path, minutes = fitted(fit)
    settings = SampleSettings(search.data, search.detector, search.sensor, fixations, fit.iou, search.protocol.seed)
    sampler, samples = collect(settings, search.out / "samples", search.workers, "looking")
    with torch.inference_mode():
        calibrated = model.calibrate(samples.scores, samples.distance)
    limit = min((n for n in (most, search.data.limit) if n is not None), default=None)
    curves, by_chance = searched(replace(search, data=replace(search.data, limit=limit)), path, policy)
    arms = {}
    for name, probabilities in zip(SCORES, (samples.scores, calibrated), strict=True):
        recall, objects = recall_of(sampler.scenes, samples, probabilities, model.edges, fit.iou, rate)
        spent = minutes if name == "calibrated" else 0.0
        level = model.level(samples.distance)
        arms[name] = Arm(
            probabilities, samples.labels, level, recall, objects, curves[f"{policy}-{name}"], by_chance, spent
        )
    return arms


def searched(config: SearchConfig, model: Path, policy: str) -> tuple[dict[str, Array], Array]:
    """Cumulative performance of a policy with raw and calibrated scores, by photograph, and that of random gaze."""
    policies = tuple(f"{policy}-{scores}" for scores in SCORES)
    belief = BeliefConfig(config.belief.columns, config.belief.rows, model=str(model))
    run = SearchRun(SearchConfig(**{**vars(config), "policies": policies, "belief": belief}))
    finish(run, "searching")
    records, _ = gather(run)
    found: dict[str, dict[str, list[int]]] = {name: defaultdict(list) for name in policies}
    for record in records:
        found[record["policy"]][str(record["scene"])].append(record["found_at"])
    shifts = config.protocol.shifts
    chance = expected_random(records, shifts, config.belief.columns * config.belief.rows)
    return {name: curves_of(scenes, shifts) for name, scenes in found.items()}, chance


def curves_of(scenes: Mapping[str, list[int]], shifts: int) -> Array:
    """Cumulative performance of each photograph, in the order of their ids as text, from the shifts that found."""
    return np.stack([cumulative_performance(np.array(scenes[scene]), shifts) for scene in sorted(scenes)])


@torch.inference_mode()
def recall_of(
    scenes: Scenes, samples: Samples, probabilities: Tensor, edges: Tensor, iou: float, rate: float
) -> tuple[tuple[Array, Array], Tensor]:
    """Share of the objects that are found and named right, at a score that leaves `rate` false boxes a look.

    Args:
        scenes: that were looked at.
        samples: what was seen.
        probabilities: `(M, K+1)`, of the classes of the samples.
        edges: `(N-1,)`, between levels of distance from the fixation to an object's centre, in longer sides.
        iou: least overlap.
        rate: false boxes in a look.

    Returns:
        By photograph and level, `(P, N)`, and by photograph, `(P,)`, NaN where no object is; and how many objects all
        looks had in view by level, `(N,)`.
    """
    looks, levels = len(samples.scenes), len(edges) + 1
    ends = torch.searchsorted(samples.look, torch.arange(looks + 1)).tolist()
    scores, level, scene, false = [], [], [], []
    for look, index in enumerate(samples.scenes.tolist()):
        annotation, rows = scenes.annotation(index), slice(ends[look], ends[look + 1])
        found, wrong = found_objects(
            samples.boxes[rows], probabilities[rows], annotation.boxes, annotation.labels, iou=iou
        )
        away = Grid(1, 1, annotation.size).box_distance(annotation.boxes[None], samples.fixations[look][None])[0]
        scores.append(found)
        level.append(torch.bucketize(away, edges))
        scene.append(torch.full_like(annotation.labels, index))
        false.append(wrong)
    there = torch.cat(scores) > score_for(torch.cat(false), looks, rate)
    place = torch.cat(scene) * levels + torch.cat(level)
    counts = torch.stack(
        [place.bincount(minlength=len(scenes) * levels), place[there].bincount(minlength=len(scenes) * levels)]
    )
    every, found_ = counts.view(2, len(scenes), levels).double().numpy()
    with np.errstate(invalid="ignore"):
        return (found_ / every, found_.sum(1) / every.sum(1)), torch.as_tensor(every.sum(0)).long()
