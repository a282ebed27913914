"""Fit the verification of targets by closer looks, from searches of photographs with boxes."""

from __future__ import annotations

import json
from dataclasses import replace

from semfov.errors import DataError
from semfov.fit.closer_looks import photographs
from semfov.fit.outputs import model_path, training_of, write_outputs
from semfov.fit.verification_fit import fit_and_verify
from semfov.fit.verification_report import report
from semfov.fit.verification_settings import FitVerificationConfig
from semfov.runs.scene_run import cache_folder
from semfov.runs.setup import make_eye, make_scenes, make_target_evidence
from semfov.runs.store import cell_store


def fit_verification(config: FitVerificationConfig) -> None:
    """Search the photographs, look closely at candidates, fit, evaluate in folds, and write all results."""
    eye = make_eye(config.detector, config.sensor)
    evidence = make_target_evidence(config.target_model, eye)
    scenes = make_scenes(config.data, eye.detector.classes)
    left_out = set()
    if config.fitted is not None:
        data = replace(config.data, min_instances=2, max_target_area=None, limit=config.fitted)
        known = make_scenes(data, eye.detector.classes).ids
        holdout = evidence.metadata.get("training", {}).get("holdout", 5)
        left_out = {name for number, name in enumerate(known) if number % holdout}
    chosen = [index for index, name in enumerate(scenes.ids) if name not in left_out]
    if len(chosen) < config.folds:
        raise DataError(f"data: expected at least {config.folds} photographs for the folds, got {len(chosen)}")
    size, components = (config.columns, config.rows), len(eye.detector.classes) + 1
    store = cell_store(cache_folder(config.cache) / "searches", eye.settings(), *size, components)
    seen = photographs(
        eye,
        scenes,
        chosen,
        size,
        classes=config.classes,
        absent=config.absent,
        max_area=config.max_target_area,
        seed=config.seed,
        store=store,
    )
    fitted = fit_and_verify(seen, evidence, config)
    fitted.model.metadata = {**eye.settings(), **training_of(config, scenes, "target_model")}
    path = model_path(config, eye.detector.name)
    fitted.model.save(path)
    text, figures = report(fitted, f"{len(seen)} photographs")
    write_outputs(config, text, ("judged.json", json.dumps(figures, indent=2) + "\n"), path)
