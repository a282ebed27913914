"""Fit all models that the agent needs to a detector of the user."""

import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import torch

from semfov.agent import ActivePerception
from semfov.data.annotations import read_annotations
from semfov.detection.class_names import UnnamedClasses
from semfov.errors import DataError, InputError
from semfov.fit.folder import FITS, FolderFit
from semfov.fit.folder_report import class_counts, folder_report
from semfov.fit.gaze_model import fit_gaze_model, gaze_report
from semfov.fit.settings import FitDetectorConfig
from semfov.io.files import write_text
from semfov.io.manifest import PARTS
from semfov.runs.config import DataConfig, DetectorConfig
from semfov.runs.looking import Looking
from semfov.runs.progress import WholeBar, track
from semfov.runs.scene_run import finish
from semfov.runs.setup import check_sources, make_detector
from semfov.threads import available_cores

_MOST_FAULTS = 5  # largest number of photographs that a message names
_MOST_CLASSES = 8  # largest number of classes that a message names
_PATIENCE = 10  # minutes of a fit from which on the plan names what makes it shorter

_log = logging.getLogger(__name__)


def fit_detector(
    model: str | PathLike[str],
    root: str | PathLike[str],
    annotations: str | PathLike[str],
    *,
    out: str | PathLike[str] = "mymodels",
    limit: int | None = None,
    workers: int = 1,
    **settings: Any,
) -> ActivePerception:
    """Fit all models that the recommended agent needs to a detector, and return the agent.

    This is `semfov fit` as a function. The detector looks at every photograph from every cell. Then an observation
    model, the exponent of its likelihoods, the model of searches and the verification of targets by closer looks are
    fitted, and, on mosaics of enough photographs, the evidence for pictures larger than the detector's input (unless
    `windows=False`). Each of them is compared with raw scores on held-out photographs, and the verification with the
    same agent without closer looks. `ActivePerception.from_pretrained(out)` loads the agent again.

    Args:
        model: the detector: a name or a file, as for `semfov.load_detector`.
        root: folder of the photographs.
        annotations: annotation file with their boxes, in COCO's format. Its categories are matched to the detector's
            classes by name.
        out: folder to write the models to. After an interruption, the same call continues where it stopped.
        limit: maximum number of photographs (None: all).
        workers: number of processes that look. More than one requires a script that calls this function under
            `if __name__ == "__main__"`.
        settings: other settings of `FitDetectorConfig` (`holdout`, `steps`, `seed`, …) and of the detector (`classes`,
            `head`, `weights`, `threshold`, …: `DetectorConfig`).

    Returns:
        The agent with the fitted models. It uses only models that were better on the held-out photographs.

    Raises:
        InputError: a setting is unknown or out of range, or there is no such detector.
        DataError: a file is missing or damaged, or none of the annotated categories is a class of the detector.

    Example::

        agent = semfov.fit_detector("mine.onnx", "photographs", "instances.json", classes=["cat", "dog", "cup"])
        scanpath = agent.search(semfov.read_image("kitchen.jpg"), "cup")
    """
    config = _config_of(model, root, annotations, out, limit, workers, settings)
    fit_folder(config)
    return ActivePerception.from_pretrained(out)


def _config_of(
    model: str | PathLike[str],
    root: str | PathLike[str],
    annotations: str | PathLike[str],
    out: str | PathLike[str],
    limit: int | None,
    workers: int,
    settings: Mapping[str, Any],
) -> FitDetectorConfig:
    """Make the settings of a fit from the arguments of `fit_detector`."""
    of_detector = {field.name for field in fields(DetectorConfig)} - {"name"}
    of_fit = {field.name for field in fields(FitDetectorConfig)} - {"model", "data", "detector", "out", "workers"}
    unknown = sorted(settings.keys() - of_detector - of_fit)
    if unknown:
        raise InputError(
            f"settings: expected names among {', '.join(sorted(of_detector | of_fit))}, got {unknown[0]!r}"
        )
    options = {name: value for name, value in settings.items() if name in of_detector}
    if options.get("classes") is not None:
        options["classes"] = tuple(options["classes"])
    if options.get("weights") is not None:
        options["weights"] = Path(options["weights"])
    return FitDetectorConfig(
        model=Path(model),
        data=DataConfig(Path(root), Path(annotations), limit, min_instances=0, max_target_area=None),
        detector=DetectorConfig(**options),
        out=Path(out),
        workers=workers,
        **{name: value for name, value in settings.items() if name in of_fit},
    )


def fit_folder(config: FitDetectorConfig) -> None:
    """Look at all photographs, fit all parts, and write the model folder with its report and figures.

    Args:
        config: the settings of the fit. With fixations of people, where people look is fitted first, and without
            photographs nothing else is.

    Raises:
        InputError: the settings name no detector, or options that contradict each other.
        DataError: a file is missing or damaged, or the photographs do not fit the detector.
    """
    config = _with_classes(config.named())
    if config.gaze.fixations:
        _fit_gaze(config)
        if config.data.root is None:
            return
    started = time.monotonic()
    print("opening the photographs …", flush=True)
    run = Looking(replace(config, out=config.out / "progress"))
    # Before hours of looks: a photograph that cannot be read ends the fit now.
    unseen = _check_photographs(run)
    folder = FolderFit(config, run)
    counts = class_counts(run, range(len(run.scenes)))
    _warn_of_missing(counts)
    stages = {"looking": {"looking": _seconds_of_looks(run, unseen)}}
    stages |= {name: fit.tasks for name, fit in folder.fits.items()}
    _print_plan(run, stages)
    with WholeBar("fitting", stages) as bar:
        with bar.stage("looking"):
            finish(run, "looking")
        for part in PARTS:
            with bar.stage(part):
                folder.fit(part)
    _write_folder(folder, time.monotonic() - started)
    _print_next(config.out, max(counts.items(), key=lambda pair: pair[1])[0])


def _fit_gaze(config: FitDetectorConfig) -> None:
    """Fit where people look, and write the model and its report."""
    settings = replace(config.gaze, cache=config.gaze.cache or config.cache)
    fitted = fit_gaze_model(settings, make_detector(config.detector), config.out / "progress" / "gaze")
    path = config.out / "gaze.safetensors"
    text = gaze_report(fitted)
    fitted.model.save(path)
    write_text(config.out / "gaze.md", text)
    print(text, "written:", f"  {path}", f"  {config.out / 'gaze.md'}", sep="\n")
    print(f"\nnext:\n  semfov gaze PHOTO.jpg --detector {config.model} --model {path}")


def _warn_of_missing(counts: Mapping[str, int]) -> None:
    """Warn of classes without any object in the photographs."""
    missing = [name for name, count in counts.items() if not count]
    if not missing:
        return
    names = ", ".join(missing[:_MOST_CLASSES]) + (", …" if len(missing) > _MOST_CLASSES else "")
    _log.warning(
        "%d of the detector's %d classes have no box in the photographs (%s): the fitted models can only apply to "
        "them what they learn from the other classes",
        len(missing),
        len(counts),
        names,
    )


def _print_plan(run: Looking, stages: Mapping[str, Mapping[str, float]]) -> None:
    """Print what is to be done, and about how long it takes; stages are seconds by task."""
    minutes = math.ceil(sum(sum(tasks.values()) for tasks in stages.values()) / 60)
    looks = len(run.scenes) * math.prod(run.cells)
    shorter = "; --data.limit N takes only N photographs, and less time" if minutes > _PATIENCE else ""
    print(
        f"{len(run.scenes)} photographs, {len(run.scenes.classes)} classes: {looks:,} looks and {len(FITS)} fits, "
        f"about {minutes} minute{'s' if minutes != 1 else ''}{shorter}",
        flush=True,
    )


def _write_folder(folder: FolderFit, seconds: float) -> None:
    """Write manifest, report and settings, print the report, and list the written files."""
    config = folder.inputs.config
    manifest = folder.manifest().write(config.out)
    text = folder_report(folder.inputs, seconds)
    print(text)
    write_text(config.out / "report.md", text)
    write_text(config.out / "config.yaml", config.yaml())
    results = folder.inputs.results.values()
    models = [fitted.part.file for fitted in results if fitted.part.file]
    figures = [figure for fitted in results for figure in fitted.figures]
    names = [manifest.name, *models, "report.md", *figures]
    print("written:", *(f"  {config.out / name}" for name in names), sep="\n")


def _print_next(out: Path, target: str) -> None:
    """Print the commands that use the folder."""
    word = f'"{target}"' if " " in target else target
    options = f"--target {word} --models {fspath(out)}"
    print(f"\nnext:\n  semfov search PHOTO.jpg {options}\n  semfov find PHOTOS {options} --out found.csv")


def _with_classes(config: FitDetectorConfig) -> FitDetectorConfig:
    """Take the categories of the annotations as class names where a model has as many classes and no names."""
    try:
        check_sources(config.data, config.detector)
        make_detector(config.detector)
    except UnnamedClasses as error:
        categories = {} if config.data.annotations is None else read_annotations(config.data.annotations).categories
        names = tuple(categories[number]["name"] for number in sorted(categories))
        if len(names) != error.count:
            known = f"; the annotations have {len(names)} categories" if names else ""
            raise InputError(f"{error}{known}") from None
        print(f"classes of the annotations, in the order of their ids: {', '.join(names)}")
        return replace(config, detector=replace(config.detector, classes=names))
    return config


def _check_photographs(run: Looking) -> list[int]:
    """Decode the photographs that lack looks; raises `DataError` with all that cannot be decoded, or returns them."""
    cells = len(run.grid(0))
    unseen = [index for index in range(len(run.scenes)) if len(run.store.load(run.digest(index))) < cells]
    faults = []
    for index in track(unseen, "decoding photographs", "photograph"):
        try:
            run.scenes[index]
        except DataError as error:
            faults.append(str(error))
    if faults:
        more = f", and {len(faults) - _MOST_FAULTS} more" if len(faults) > _MOST_FAULTS else ""
        raise DataError(f"photographs: {len(faults)} cannot be read: {'; '.join(faults[:_MOST_FAULTS])}{more}")
    return unseen


def _seconds_of_looks(run: Looking, unseen: Sequence[int]) -> float:
    """Estimate the seconds that looks at photographs without looks will take, from the time of one look."""
    if not unseen:
        return 1.0
    image = run.scenes[unseen[0]].image[None]
    grid = run.grid(unseen[0])
    with torch.inference_mode():
        run.eye(image, grid.centres[:1])  # the first look takes longer
        before = time.monotonic()
        run.eye(image, grid.centres[1:2] if len(grid) > 1 else grid.centres)
    workers = min(run.config.workers or available_cores(), len(unseen))
    return (time.monotonic() - before) * len(grid) * len(unseen) / workers
