"""Fit where people look: `python -m train.fit_gaze` fits a `FixationDensity` to fixations in pictures.

    python -m train.fit_gaze --fixations [osie/fixations.json] --pictures [osie/images] --detector.name yolox-nano

Several data sets may be given, with a folder of pictures for each file of fixations. Every picture passes the detector
once; its feature maps are kept in the cache. The map and the centre bias are fitted by maximum likelihood of all
fixations but the first of each person, every picture alike, and then the oculomotor biases, given the map. With
`folds`, models are first fitted without each fold of the pictures and evaluated on it, and the report has the means.
The folder `out` gets the model that is fitted to all pictures (`<name>.safetensors`, a
`semfov.saliency.FixationDensity`) and the report. To continue a stopped run, give the same command again.
`semfov fit NAME --gaze.fixations FILE --gaze.pictures FOLDER` does the same for a detector of one's own.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from semfov.detection.load import load_detector
from semfov.fit.gaze_model import GazeModelFit, fit_gaze_model, gaze_report, summaries
from semfov.io.ranges import SingleName
from semfov.runs.command import command
from semfov.runs.config import DetectorConfig
from semfov.runs.setup import detector_options
from semfov.runs.workers import prepare_worker
from train.outputs import model_path, write_outputs


@dataclass(frozen=True)
class FitGazeConfig(GazeModelFit):
    """Fit a model of where people look.

    Args:
        detector: the detector whose feature maps are read.
        name: name of the model (none: the detector's name).
        out: folder for the model and the report.
    """

    within: ClassVar[str] = ""

    detector: DetectorConfig = field(default_factory=DetectorConfig)
    name: SingleName | None = None
    out: Path = Path("runs/fit_gaze")


def fit_gaze(config: FitGazeConfig) -> None:
    """Look at all pictures, evaluate on folds, fit to all, and write model and report."""
    prepare_worker()
    detector = load_detector(config.detector.name, **detector_options(config.detector))
    fitted = fit_gaze_model(config, detector, config.out / "folds")
    path = model_path(config, detector.name)
    fitted.model.save(path)
    means = json.dumps(summaries(fitted.scores[fitted.way]), indent=2)
    write_outputs(config, gaze_report(fitted), {"folds.json": f"{means}\n"}, path)


main = command(fit_gaze, FitGazeConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
