"""Fit all models that the agent needs to a detector of the user."""

import json
import logging
import math
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, fields, replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from semfov.agent import ActivePerception
from semfov.data.annotations import read_annotations
from semfov.detection.class_names import UnnamedClasses
from semfov.errors import DataError, InputError
from semfov.fit.evidence import EvidenceFit
from semfov.fit.gaze_model import fit_gaze_model, gaze_report
from semfov.fit.map import MapFit
from semfov.fit.observation import ObservationFit
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.settings import FitDetectorConfig
from semfov.fit.tempering import TemperingFit
from semfov.fit.verification import VerificationFit
from semfov.fit.windows_part import WindowsFit
from semfov.io.files import sha256, write_text
from semfov.io.manifest import PARTS, Manifest, Part
from semfov.runs.config import WHERE, DataConfig, DetectorConfig
from semfov.runs.looking import Looking
from semfov.runs.progress import WholeBar
from semfov.runs.scene_run import digest_of, finish
from semfov.runs.settings import plain
from semfov.runs.setup import check_sources, detector_options, make_detector
from semfov.runs.tables import table
from semfov.threads import available_cores

_TITLES = {
    "observation": "Observation model",
    "tempering": "Tempering",
    "evidence": "Target evidence (searches)",
    "verification": "Verification (closer looks)",
    "map": "Learned map (explorations)",
    "windows": "Evidence by magnification (large pictures)",
}
"""Titles of the parts in reports."""

_UNUSED = {"verification": "no, no closer looks", "windows": "no, slices in the order of raw scores"}
"""What the agent does without a part that it does not use, other than to use raw scores."""

_MOST_FAULTS = 5  # largest number of photographs that a message names

_log = logging.getLogger(__name__)

_SETTINGS = ("holdout", "fixations", "steps", "map_steps", "seed")
"""Settings that the manifest of a model folder records."""


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

    This is `semfov fit` as a function. The detector looks at every photograph from every cell. Then
    an observation model, the exponent of its likelihoods, target evidence, the verification of targets by closer looks
    and a map of all classes are fitted, and, on mosaics of enough photographs, the evidence for pictures larger than
    the detector's input (unless `windows=False`). Each of them is compared with raw scores on held-out photographs, and
    the verification with the same agent without closer looks. `ActivePerception.from_pretrained(out)` loads the agent
    again.

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
    of_detector = {each.name for each in fields(DetectorConfig)} - {"name"}
    of_fit = {each.name for each in fields(FitDetectorConfig)} - {"model", "data", "detector", "out", "workers"}
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
    config = FitDetectorConfig(
        model=Path(model),
        data=DataConfig(Path(root), Path(annotations), limit, min_instances=0, max_target_area=None),
        detector=DetectorConfig(**options),
        out=Path(out),
        workers=workers,
        **{name: value for name, value in settings.items() if name in of_fit},
    )
    fit_folder(config)
    return ActivePerception.from_pretrained(out)


def _class_counts(run: Looking, scenes: Any) -> dict[str, int]:
    """Count the objects of each class in the photographs with the given indices."""
    count = torch.zeros(len(run.scenes.classes) + 1, dtype=torch.int64)
    for index in scenes:
        count += torch.bincount(run.scenes.annotation(index).labels, minlength=len(count))
    return dict(zip(run.scenes.classes, count[1:].tolist(), strict=True))


def _thin_classes(counts: dict[str, int], thin: int) -> list[str]:
    """Write warnings, as lines of Markdown, about classes with fewer than `thin` objects to learn from."""
    rare = {
        "No object": [name for name, count in counts.items() if count == 0],
        f"Fewer than {thin} objects": [f"{name} {count}" for name, count in counts.items() if 0 < count < thin],
    }
    lines = [
        f"**{what} to learn from** ({len(some)} classes): {', '.join(some)}." for what, some in rare.items() if some
    ]
    if lines:
        lines.append(
            "The target evidence and the map process the scores of all classes with one network; only one number per "
            "class, its frequency, is separate. The observation model changes the scores of a class without examples "
            "very little."
        )
    return [text for line in lines for text in (line, "")]


def _detector_report(inputs: PartInputs, seconds: float) -> str:
    config, run, results, held_out = inputs.config, inputs.run, inputs.results, inputs.held_out
    counts = _class_counts(run, {*range(len(run.scenes))} - {*held_out})
    rows = [["part", "used", "result on held-out photographs"]]
    rows += [
        [_TITLES[name], "yes" if each.part.used else _UNUSED.get(name, "no, raw"), each.part.why]
        for name, each in results.items()
    ]
    lines = [
        f"# Models of {run.eye.detector.name}",
        "",
        f"{len(run.scenes)} photographs, {len(held_out)} of them held out (one in {config.holdout}); "
        f"{len(counts)} classes; {config.columns} × {config.rows} cells; "
        f"sensor {config.sensor.name}; {seconds / 60:.1f} minutes in this run.",
        "",
        "The agent uses a part only if it is better than raw scores by more than one standard error of the paired "
        "difference over the held-out photographs. The verification is compared with the same agent without closer "
        "looks, and the evidence by magnification with looks at slices of large pictures in the order of raw scores.",
        "",
        *table(rows),
        "",
        *_thin_classes(counts, config.thin),
    ]
    if len(held_out) < 10:
        number = "only 1 photograph" if len(held_out) == 1 else f"only {len(held_out)} photographs"
        lines += [f"The figures are rough, because {number} could be held out.", ""]
    for name, fitted in results.items():
        lines += [f"## {_TITLES[name]}", "", fitted.report, ""]
        lines += [line for figure in fitted.figures for line in (f"![{figure}]({figure})", "")]
    return "\n".join(lines)


def fit_folder(config: FitDetectorConfig) -> None:
    """Look at all photographs, fit all parts, and write the model folder with its report and figures."""
    config = _with_classes(config.named())
    if config.gaze.fixations:
        gaze = replace(config.gaze, cache=config.gaze.cache or config.cache)
        fitted, scored = fit_gaze_model(gaze, make_detector(config.detector), config.out / "progress" / "gaze")
        path, text = config.out / "gaze.safetensors", gaze_report(scored)
        fitted.save(path)
        write_text(config.out / "gaze.md", text)
        print(text, "written:", f"  {path}", f"  {config.out / 'gaze.md'}", sep="\n")
        print(f"\nnext:\n  semfov gaze PHOTO.jpg --detector {config.model} --model {path}")
        if config.data.root is None:
            return
    started = time.monotonic()
    print("opening the photographs …", flush=True)
    run = Looking(replace(config, out=config.out / "progress"))
    unseen = _check_photographs(run)
    folder = _FolderFit(config, run)
    config, results = folder.inputs.config, folder.inputs.results
    counts = _class_counts(run, range(len(run.scenes)))
    missing = [name for name, count in counts.items() if not count]
    if missing:
        some = ", ".join(missing[:8]) + (", …" if len(missing) > 8 else "")
        _log.warning(
            "%d of the detector's %d classes have no box in the photographs (%s): the fitted models can only apply to "
            "them what they learn from the other classes",
            len(missing),
            len(counts),
            some,
        )
    stages = {name: each.tasks for name, each in folder.fits.items()}
    stages = {"looking": {"looking": _seconds_of_looks(run, unseen)}, **stages}
    minutes = math.ceil(sum(sum(tasks.values()) for tasks in stages.values()) / 60)
    looks = len(run.scenes) * math.prod(config.cells)
    print(
        f"{len(run.scenes)} photographs, {len(counts)} classes: {looks:,} looks and {len(folder.fits)} fits, about "
        f"{minutes} minute{'s' if minutes != 1 else ''}",
        flush=True,
    )
    with WholeBar("fitting", stages) as whole:
        with whole.stage("looking"):
            finish(run, "looking")
        for part in PARTS:
            with whole.stage(part):
                folder.fit(part)
    path = _manifest_of(folder).write(config.out)
    text = _detector_report(folder.inputs, time.monotonic() - started)
    print(text)
    write_text(config.out / "report.md", text)
    write_text(config.out / "config.yaml", config.yaml())
    figures = [figure for fitted in results.values() for figure in fitted.figures]
    models = [fitted.part.file for fitted in results.values() if fitted.part.file]
    print("written:", *(f"  {config.out / name}" for name in [path.name, *models, "report.md", *figures]), sep="\n")
    target = max(counts.items(), key=lambda pair: pair[1])[0]
    target = f'"{target}"' if " " in target else target
    options = f"--target {target} --models {fspath(config.out)}"
    print(f"\nnext:\n  semfov search PHOTO.jpg {options}\n  semfov find PHOTOS {options} --out found.csv")


def _with_classes(config: FitDetectorConfig) -> FitDetectorConfig:
    """The settings, with the categories of the annotations as class names where a model has as many and no names."""
    try:
        check_sources(config.data, config.detector)
        make_detector(config.detector)
    except UnnamedClasses as error:
        categories = {} if config.data.annotations is None else read_annotations(config.data.annotations).categories
        names = tuple(categories[each]["name"] for each in sorted(categories))
        if len(names) != error.count:
            known = f"; the annotations have {len(names)} categories" if names else ""
            raise InputError(f"{error}{known}") from None
        print(f"classes of the annotations, in the order of their ids: {', '.join(names)}")
        return replace(config, detector=replace(config.detector, classes=names))
    return config


def _check_photographs(run: Looking) -> list[int]:
    """Decode the photographs without looks from all cells; raises `DataError` with all that cannot be decoded."""
    faults, cells = [], len(run.grid(0))
    unseen = [index for index in range(len(run.scenes)) if len(run.store.load(run.digest(index))) < cells]
    for index in tqdm(unseen, "decoding photographs", unit="photograph", leave=False, dynamic_ncols=True):
        try:
            run.scenes[index]
        except DataError as error:
            faults.append(str(error))
    if faults:
        more = f", and {len(faults) - _MOST_FAULTS} more" if len(faults) > _MOST_FAULTS else ""
        raise DataError(f"photographs: {len(faults)} cannot be read: {'; '.join(faults[:_MOST_FAULTS])}{more}")
    return unseen


def _seconds_of_looks(run: Looking, left: Sequence[int]) -> float:
    """Estimate the seconds that looks at the photographs that are left will take, from the time of one look."""
    if not left:
        return 1.0
    image = run.scenes[left[0]].image[None]
    grid = run.grid(left[0])
    with torch.inference_mode():
        run.eye(image, grid.centres[:1])
        before = time.monotonic()
        run.eye(image, grid.centres[1:2] if len(grid) > 1 else grid.centres)
    workers = min(run.config.workers or available_cores(), len(left))
    return (time.monotonic() - before) * len(grid) * len(left) / workers


def _place_of(file: str | PathLike[str], folder: str | PathLike[str]) -> dict[str, str]:
    """The path of a file, `relative` to a folder and `absolute`."""
    absolute = Path(file).resolve()
    try:
        relative = os.path.relpath(absolute, Path(folder).resolve())
    except ValueError:  # on another drive
        relative = str(absolute)
    return {"relative": Path(relative).as_posix(), "absolute": str(absolute)}


def _manifest_of(folder: "_FolderFit") -> Manifest:
    config, run = folder.inputs.config, folder.inputs.run
    detector = run.eye.detector
    options = plain(detector_options(config.detector))
    weights = options.pop("weights", None)
    is_file = Path(config.detector.name).is_file()
    return Manifest(
        classes=detector.classes,
        detector={
            "name": detector.name,
            "sha256": detector.digest,
            "model": None if is_file else config.detector.name,
            "model_file": _place_of(config.detector.name, config.out) if is_file else None,
            "weights_file": None if weights is None else _place_of(weights, config.out),
            "options": options,
        },
        sensor=config.sensor.record(),
        grid=(config.columns, config.rows),
        parts={name: fitted.part for name, fitted in folder.inputs.results.items()},
        training={
            "data": run.scenes.fingerprint,
            "photographs": len(run.scenes),
            "held_out": len(folder.inputs.held_out),
            "settings": {name: getattr(config, name) for name in _SETTINGS},
        },
    )


_FITS: tuple[type[PartFit], ...] = (ObservationFit, TemperingFit, EvidenceFit, VerificationFit, MapFit, WindowsFit)
"""The fits of `semfov.io.manifest.PARTS`."""


class _FolderFit:
    """Fit all parts of a model folder in order; those that an earlier run finished are read from the folder."""

    def __init__(self, config: FitDetectorConfig, run: Looking) -> None:
        self.inputs = PartInputs(config, run)
        self.fits = {name: fit(self.inputs) for name, fit in zip(PARTS, _FITS, strict=True)}

    def fit(self, name: str) -> PartResult:
        """Fit a part, or read it from the folder if it was fitted with the same settings, photographs and code."""
        results = self.inputs.results
        before: list[Any] = [fitted.part.sha256 for fitted in results.values()]
        before += [plain(asdict(each.part)) for each in results.values() if each.part.settings]
        own = self.fits[name].settings
        own = plain(own if isinstance(own, dict) else asdict(own))
        settings = [name, {each: own[each] for each in own.keys() - {*WHERE}}, self.inputs.config.judged, before]
        key = digest_of([self.inputs.run.key, settings])
        file = self.inputs.config.out / "progress" / f"{name}.json"
        result = self._read_result(file, key)
        if result is None:
            try:
                result = self.fits[name].fit()
            except (DataError, InputError) as error:
                result = PartResult(
                    Part(None, None, False, f"could not be fitted: {error}"), f"Could not be fitted: {error}"
                )
            write_text(file, json.dumps({"key": key, **result._asdict(), "part": asdict(result.part)}))
        results[name] = result
        return result

    def _read_result(self, file: Path, key: str) -> PartResult | None:
        """What an earlier run wrote of a part, if it is whole and has this key."""
        out = self.inputs.config.out
        with suppress(Exception):  # a damaged record is no problem, as the part can be fitted again
            record = json.loads(file.read_text(encoding="utf-8"))
            part, figures = Part(**record["part"]), tuple(record["figures"])
            kept = part.file is None or sha256(out / part.file) == part.sha256
            if record["key"] == key and kept and all((out / figure).is_file() for figure in figures):
                return PartResult(part, record["report"], figures)
        return None
