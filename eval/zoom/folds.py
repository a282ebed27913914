"""Photographs judged in folds, each with evidence for photographs that was fitted to the others."""

from copy import deepcopy
from dataclasses import replace

from eval.zoom.run import ZoomRun
from semfov.data.scene import ChosenScenes, Scenes
from semfov.errors import check
from semfov.fit.photographs import fit_photographs
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.io.files import json_sha256
from semfov.runs.progress import track
from semfov.runs.results import ResultRecord


def outcomes_in_folds(run: ZoomRun) -> list[ResultRecord]:
    """Measure all photographs of a run, each with evidence that was not fitted to it.

    Args:
        run: the run; its evidence for photographs gives the settings of closer looks, and is replaced in each fold.

    Returns:
        The records of all photographs.

    Raises:
        InputError: there are fewer photographs than folds.
    """
    config = run.config
    count = len(run.scenes)
    check(config.folds <= count, "folds", f"at most one for each of {count} photographs", config.folds)
    shipped = run.evidence
    records: list[ResultRecord] = []
    for fold in range(config.folds):
        others = _chosen(run.scenes, [index for index in range(count) if index % config.folds != fold])
        run.evidence = deepcopy(shipped)
        fit_photographs(run.evidence, others, run.eye, _settings(run, len(others)))
        for index in track(range(fold, count, config.folds), f"judging, fold {fold + 1}", "photograph"):
            of_photograph, _ = run.outcomes(index)
            records += of_photograph
    return records


def _settings(run: ZoomRun, photographs: int) -> FitMosaicsConfig:
    """Return the settings of a fit to so many photographs, with the closer looks of the shipped evidence."""
    settings = FitMosaicsConfig(photographs=photographs, seed=run.config.seed)
    shipped = run.evidence.photograph
    return settings if shipped is None else replace(settings, window=shipped.window)


def _chosen(scenes: Scenes, numbers: list[int]) -> ChosenScenes:
    """Choose some photographs by number."""
    ids: list[int] | list[str] = [scenes.ids[number] for number in numbers]  # type: ignore[assignment]
    return ChosenScenes([(scenes, number) for number in numbers], ids, json_sha256([scenes.fingerprint, ids]))
