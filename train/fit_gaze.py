"""Fit where people look: `python -m train.fit_gaze` fits a `FixationDensity` to fixations in pictures.

    python -m train.fit_gaze --fixations [osie/fixations.json] --pictures [osie/images] --detector.name yolox-nano

Several data sets may be given, with a folder of pictures for each file of fixations. Every picture passes the detector
once; its feature maps are kept in the cache. The map and the centre bias are fitted by maximum likelihood of all
fixations but the first of each person, every picture alike, and then the oculomotor biases, given the map. With
`folds`, models are first fitted without each fold of the pictures and evaluated on it, and the report has the means.
The folder `out` gets the model that is fitted to all pictures (`<name>.safetensors`, a
`semfov.saliency.FixationDensity`) and the report. To continue a stopped run, give the same command again.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path

from semfov.detection.load import load_detector
from semfov.errors import check
from semfov.runs.command import command
from semfov.runs.config import DetectorConfig
from semfov.runs.settings import SingleName, Whole
from semfov.runs.setup import detector_options, prepare_worker
from semfov.runs.tables import table
from train.gaze import GazeFit, describe_viewing, fitted_density, summary_of
from train.gaze_folds import CENTRE, ROWS, Fold, FoldStore, Scores, joined
from train.outputs import model_path, write_outputs
from train.viewing import ViewingData, features_of, look


@dataclass(frozen=True)
class FitGazeConfig(ViewingData, GazeFit):
    """Fit a model of where people look.

    Args:
        detector: the detector whose feature maps are read.
        layers: names of the feature maps (none: those of the shipped model, or of backbone and head at
            strides 8 to 32 that the detector has).
        folds: number of folds for the evaluation (0: none).
        name: name of the model (none: the detector's name).
        out: folder for the model and the report.
    """

    detector: DetectorConfig = field(default_factory=DetectorConfig)
    layers: tuple[str, ...] = ()
    folds: Whole = 5
    name: SingleName | None = None
    out: Path = Path("runs/fit_gaze")


def fit_gaze(config: FitGazeConfig) -> None:
    """Look at all pictures, evaluate on folds, fit to all, and write model and report."""
    check(len(config.fixations) > 0, "fixations", "at least one file", "none")
    prepare_worker()
    detector = load_detector(config.detector.name, **detector_options(config.detector))
    source = features_of(detector, config.layers)
    groups = look(config, source)
    data, fit = config.fingerprint, config.fit
    store = FoldStore(config.out / "folds", {**source.what, "data": data})
    folds = [Fold(groups, number, config.folds) for number in range(config.folds)]
    scored = joined([store.scores(detector.name, fold, fit) for fold in folds])
    model = fitted_density(fit, groups, [list(range(len(group))) for group in groups], "all pictures")
    describe_viewing(model, groups)
    people = {
        "pictures": sum(map(len, groups)),
        "scanpaths": sum(len(some) for group in groups for some in group.people),
    }
    known = {name: detector.settings()[name] for name in ("name", "digest", "input_size", "stretch")}
    model.metadata |= {"detector": known, "data": data, "training": fit.plain() | people}
    path = model_path(config, detector.name)
    model.save(path)
    write_outputs(config, gaze_report(scored), ("folds.json", json.dumps(summaries(scored), indent=2) + "\n"), path)


def summaries(scored: Scores) -> dict[str, dict[str, dict[str, float]]]:
    """Means over the held-out pictures, by number of the data set and row."""
    return {
        str(source + 1): {
            row: {**summary_of(scored[row, source], scored[CENTRE, source]), "pictures": len(scored[row, source])}
            for row in (CENTRE, *ROWS[False], *ROWS[True])
            if (row, source) in scored
        }
        for source in sorted({source for _, source in scored})
    }


def gaze_report(scored: Scores) -> str:
    """The means as Markdown."""
    if not scored:
        return "fitted to all pictures; no folds were held out\n"
    lines = []
    for source, rows in summaries(scored).items():
        body = [[name, *(f"{row[figure]:.3f}" for figure in ("NSS", "AUC", "gain"))] for name, row in rows.items()]
        lines += [f"Data set {source}: {rows[CENTRE]['pictures']} pictures, each held out once", ""]
        lines += [*table([["", "NSS", "AUC", "gain over the centre bias, bit/fixation"], *body]), ""]
    return "\n".join(lines)


main = command(fit_gaze, FitGazeConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
