"""Fit a model of where people look, evaluate it on folds of the pictures, and report it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
from tqdm import tqdm

from semfov.data.fixations import Fixations, by_picture, read_osie, read_table
from semfov.data.images import read_image
from semfov.data.pictures import Pictures
from semfov.detection.detector import Detector
from semfov.detection.load import load_detector
from semfov.errors import check
from semfov.fit.gaze import (
    Viewed,
    describe_viewing,
    fit_map,
    fit_oculomotor,
    folds,
    log_centre,
    maps_of,
    people_score,
    score,
    summary_of,
    viewed,
)
from semfov.fit.outputs import write_outputs
from semfov.gaze.saliency import FixationDensity
from semfov.io.files import inside
from semfov.runs.config import DetectorConfig
from semfov.runs.settings import Count, Positive, Range, Seed, Settings, Share, SingleName, Whole
from semfov.runs.setup import detector_options, prepare_worker
from semfov.runs.tables import table

_LAYERS = ("backbone8", "backbone16", "backbone32", "head8", "head16", "head32")


@dataclass(frozen=True)
class FitGazeConfig(Settings):
    """Fit a model of where people look.

    Args:
        fixations: files of fixations, a JSON file of OSIE's form or a table (`.csv`) for each data set.
        pictures: folder of the pictures of each data set.
        sizes: `width,height` of the frame of each JSON file (none: 800,600).
        seconds: time in seconds for which people viewed a picture, for each data set (none: 3).
        detector: the detector whose feature maps are read.
        layers: names of the feature maps (none: those of backbone and head at strides 8 to 32 that it has).
        readouts: number of readouts whose mean is the map.
        units: number of channels of a readout.
        epochs: passes over the pictures in the fit of the map.
        batch: pictures in a step.
        rate: highest learning rate.
        decay: weight decay.
        dropout: share of the channels that a readout leaves out in a step.
        folds: number of folds for the evaluation (0: none).
        limit: use only the first so many pictures of each data set (none: all).
        seed: seed of the fit.
        name: name of the model (none: the detector's name).
        out: folder for the model and the report.
    """

    fixations: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()
    sizes: tuple[str, ...] = ()
    seconds: tuple[float, ...] = ()
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    layers: tuple[str, ...] = ()
    readouts: Annotated[int, Range(1, 16)] = 3
    units: Annotated[int, Range(1, 256)] = 16
    epochs: Count = 12
    batch: Count = 8
    rate: Positive = 3e-3
    decay: Positive = 0.01
    dropout: Share = 0.2
    folds: Whole = 5
    limit: Count | None = None
    seed: Seed = 0
    name: SingleName | None = None
    out: Path = Path("runs/fit_gaze")


def fit_gaze(config: FitGazeConfig) -> None:
    """Look at all pictures, evaluate on folds, fit to all, and write model and report."""
    check(len(config.fixations) == len(config.pictures) > 0, "pictures", "a folder for each file of fixations",
          f"{len(config.pictures)} for {len(config.fixations)}")  # fmt: skip
    prepare_worker()
    detector = load_detector(config.detector.name, **detector_options(config.detector))
    groups, sources, fingerprints = _look(config, detector)
    rows: list[dict[str, Any]] = []
    for fold in range(config.folds):
        rows += _evaluate(config, groups, sources, fold)
    whole = [list(range(len(group))) for group in groups]
    model = _fit(config, groups, whole, "all")
    describe_viewing(model, groups)
    settings = {name: value for name, value in config.plain().items() if name not in _ELSEWHERE}
    people = {"pictures": sum(map(len, groups)), "scanpaths": sum(len(p) for group in groups for p in group.paths)}
    known = {name: detector.settings()[name] for name in ("name", "digest", "input_size", "stretch")}
    model.metadata |= {"detector": known, "data": fingerprints, "training": settings | people}
    path = inside(config.out, f"{config.name or detector.name}.safetensors")
    model.save(path)
    write_outputs(config, gaze_report(rows), ("folds.json", json.dumps(rows, indent=2) + "\n"), path)


_ELSEWHERE = ("fixations", "pictures", "detector", "out", "name", "folds")


def _look(config: FitGazeConfig, detector: Detector) -> tuple[list[Viewed], list[int], list[str]]:
    """Pictures of one size together, the number of the data set of each group, and digests of the data sets."""
    groups: list[Viewed] = []
    sources: list[int] = []
    fingerprints: list[str] = []
    layers = config.layers or None
    for number, (file, root) in enumerate(zip(config.fixations, config.pictures, strict=True)):
        width, height = (int(side) for side in _at(config.sizes, number, "800,600").split(","))
        people = by_picture(read_table(file) if file.suffix == ".csv" else read_osie(file, size=(width, height)))
        people = dict(list(people.items())[: config.limit])
        scenes = Pictures(root, people, detector.classes)
        fingerprints.append(scenes.fingerprint)
        if layers is None:
            have = detector.features(read_image(root / scenes.ids[0])[None]).maps
            layers = tuple(name for name in _LAYERS if name in have) or tuple(have)
        seen = viewed(detector, _pictures(root, people), layers, _at(config.seconds, number, 3.0))
        groups += seen
        sources += [number] * len(seen)
    return groups, sources, fingerprints


def _at(values: Sequence[Any], number: int, default: Any) -> Any:
    return values[number] if number < len(values) else default


def _pictures(root: Path, people: Mapping[str, list[Fixations]]) -> Iterator[tuple[torch.Tensor, list[Fixations]]]:
    """Each picture with the fixations in it."""
    for name, some in tqdm(people.items(), desc="looking", unit="picture"):
        yield read_image(inside(root, name)), some


def _fit(
    config: FitGazeConfig, groups: Sequence[Viewed], pictures: Sequence[Sequence[int]], title: str
) -> FixationDensity:
    """Fit a model to some pictures of each group."""
    counts = [group.counts() for group in groups]
    torch.manual_seed(config.seed)
    channels = {name: each.shape[1] for name, each in groups[0].features.maps.items()}
    known = [count[torch.as_tensor(some)] for count, some in zip(counts, pictures, strict=True) if len(some)]
    model = FixationDensity(channels, readouts=config.readouts, units=config.units, centre=log_centre(known))
    with tqdm(total=config.epochs, desc=f"fit, {title}", unit="epoch", leave=False) as bar:
        fit_map(
            model,
            groups,
            counts,
            pictures,
            epochs=config.epochs,
            batch=config.batch,
            rate=config.rate,
            decay=config.decay,
            dropout=config.dropout,
            seed=config.seed,
            done=lambda epoch, loss: _tell(bar, loss),
        )
    maps = [maps_of(model, group, some) for group, some in zip(groups, pictures, strict=True)]
    fit_oculomotor(model, groups, maps, pictures, seed=config.seed)
    return model.requires_grad_(False)


def _tell(bar: Any, loss: float) -> None:
    """Show the mean log likelihood of an epoch, in bits."""
    bar.set_postfix(bits=round(-loss / math.log(2), 3))
    bar.update()


def _evaluate(
    config: FitGazeConfig, groups: Sequence[Viewed], sources: Sequence[int], fold: int
) -> list[dict[str, Any]]:
    """Scores of a model on the pictures of a fold that it was fitted without, a row for each group."""
    split = [folds(len(group), config.folds, fold) for group in groups]
    model = _fit(config, groups, [fitted for fitted, _ in split], f"fold {fold + 1}")
    rows = []
    for group, source, (fitted, held) in zip(groups, sources, split, strict=True):
        if not held:
            continue
        centre = log_centre([group.counts()[torch.as_tensor(fitted)]]) if fitted else model.centre
        base = FixationDensity({"none": 1}, centre=centre)
        maps = maps_of(model, group, held)
        baseline = score(base, group, torch.zeros_like(maps), held, conditional=False)
        rows.append({"data": source, "fold": fold, "pictures": len(held)} | {
            "centre bias": summary_of(baseline, baseline),
            "map": summary_of(score(model, group, maps, held, conditional=False), baseline),
            "with oculomotor biases": summary_of(score(model, group, maps, held, conditional=True), baseline),
            "inter-observer": summary_of(people_score(group, held, centre), baseline),
        })  # fmt: skip
    return rows


def gaze_report(rows: Sequence[Mapping[str, Any]]) -> str:
    """Means over the held-out pictures of all folds, by data set, as Markdown."""
    if not rows:
        return "fitted to all pictures; no folds were held out\n"
    lines = []
    for source in sorted({row["data"] for row in rows}):
        some = [row for row in rows if row["data"] == source]
        total = sum(row["pictures"] for row in some)
        body = [
            [model, *(f"{sum(row[model][name] * row['pictures'] for row in some) / total:.3f}" for name in _FIGURES)]
            for model in ("centre bias", "map", "inter-observer", "with oculomotor biases")
        ]
        lines += [f"Data set {source + 1}: {total} pictures, each held out once", ""]
        lines += [*table([["", "NSS", "AUC", "gain over the centre bias, bit/fixation"], *body]), ""]
    return "\n".join(lines)


_FIGURES = ("NSS", "AUC", "gain")
