"""Compare calibration with fine-tuning: evaluate a detector with raw scores and with a fitted observation model."""

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
    """Results of a detector with one kind of scores, on photographs that nothing was fitted on.

    Attributes:
        probabilities: `(M, K+1)`, class probabilities of the detections.
        labels: `(M,)`, true classes of the detections, 0 for detections that show no object.
        level: `(M,)`, level of the distance between each detection and the fixation.
        recall: share of the objects found with `rate` false boxes per look: by photograph and level, `(P, N)`, and
            over all levels, `(P,)`; NaN where there is no object.
        objects: `(N,)`, number of objects by level, summed over all looks.
        curves: cumulative performance of the searches by photograph, `(S, shifts+1)`.
        chance: expected cumulative performance of random gaze, `(shifts+1,)`.
        minutes: processor minutes that the fit of the observation model took, 0 for raw scores.
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
    """Fit an observation model to all photographs of the settings, or read it if an earlier call has fitted it.

    Args:
        config: settings of the fit.

    Returns:
        The model, its file, and the processor minutes that the fit took. If the call that fitted it continued an
        interrupted one, the minutes before the interruption are not included.
    """
    path, record = config.out / "observation.safetensors", config.out / "fit.json"
    settings = plain(asdict(config)) | {
        "workers": None,
        "code": modules_digest("semfov.training.observation"),
        "versions": plain(versions()),
    }
    try:
        known = json.loads(record.read_text(encoding="utf-8"))
        if known["settings"] == settings:
            return FovealObservationModel.from_pretrained(path), path, float(known["minutes"])
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
    """Evaluate a detector with raw and with calibrated scores.

    Args:
        fit: settings for fitting its observation model.
        search: settings of the searches, without policies and model.
        policy: the search policy.
        fixations: random fixations in each photograph for measuring recall and calibration.
        rate: number of false boxes per look at which recall is measured.
        most: search only the first so many photographs (None: all).

    Returns:
        The results under `raw` and `calibrated`.
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
    """Search with a policy on raw and on calibrated scores.

    Args:
        config: settings of the searches.
        model: file of the observation model.
        policy: the search policy.

    Returns:
        Cumulative performance by photograph for both kinds of scores, and the expected one of random gaze.
    """
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
    """Compute the cumulative performance of each photograph.

    Args:
        scenes: for each photograph's id, the gaze shift at which each search found its target.
        shifts: number of gaze shifts.

    Returns:
        Curves `(P, shifts+1)`, sorted by the ids as text.
    """
    return np.stack([cumulative_performance(np.array(scenes[scene]), shifts) for scene in sorted(scenes)])


@torch.inference_mode()
def recall_of(
    scenes: Scenes, samples: Samples, probabilities: Tensor, edges: Tensor, iou: float, rate: float
) -> tuple[tuple[Array, Array], Tensor]:
    """Compute the recall of objects at the score threshold that leaves `rate` false boxes per look.

    An object counts as found if a detection overlaps it and has the right class.

    Args:
        scenes: the photographs.
        samples: the labelled detections of the looks at them.
        probabilities: `(M, K+1)`, class probabilities of the detections.
        edges: `(N-1,)`, borders between levels of the distance from the fixation to an object's centre, in units of the
            image's longer side.
        iou: least overlap of a detection with the object, as intersection over union.
        rate: false boxes per look.

    Returns:
        The recall by photograph and level, `(P, N)`, and by photograph, `(P,)`, NaN where there is no object; and the
        number of objects by level, summed over all looks, `(N,)`.
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
