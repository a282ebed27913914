"""Fit how unlike the pictures of a fit others are: `python -m train.fit_likeness` adds it to a model of fixations.

    python -m train.fit_likeness --fixations [osie/fixations.json,crowd/fixations.json] \
        --pictures [osie/images,crowd/images] --sizes [800x600,640x480] --detector.name yolox-nano

The pictures are those of the fit of the model. Each passes the detector once, the mean and deviation of each channel
of the feature maps that the model reads are pooled, and `semfov.gaze.saliency.PictureLikeness` is fitted to them.
Everything else in the model stays. `python -m train.fit_gaze` and `semfov fit` fit it with the model.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

from semfov.detection.load import load_detector
from semfov.errors import check
from semfov.fit.gaze_model import fitted_likeness
from semfov.fit.viewing import ViewingData, features_of, look
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.runs.command import command
from semfov.runs.config import DetectorConfig
from semfov.runs.setup import detector_options
from semfov.runs.workers import prepare_worker


@dataclass(frozen=True)
class FitLikenessConfig(ViewingData):
    """Add the likeness of pictures to a model of where people look.

    Args:
        detector: the detector whose feature maps are read.
        model: file of the model (none: the one that is shipped for the detector).
        out: folder for the model.
    """

    detector: DetectorConfig = field(default_factory=DetectorConfig)
    model: Path | None = None
    out: Path = Path("runs/fit_likeness")


def fit_likeness(config: FitLikenessConfig) -> None:
    """Look at all pictures, fit the likeness, and write the model with it."""
    check(len(config.fixations) > 0, "fixations", "at least one file", "none")
    prepare_worker()
    detector = load_detector(config.detector.name, **detector_options(config.detector))
    if config.model is None:
        model = FixationDensity.for_detector(detector)
    else:
        model = FixationDensity.from_pretrained(config.model)
    groups = look(config, features_of(detector, [*model.layers]))
    model.likeness = fitted_likeness(model, groups)
    path = config.out / f"{detector.name}.safetensors"
    model.save(path)
    print(f"written: {path}")


main = command(fit_likeness, FitLikenessConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
