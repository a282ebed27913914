"""Fit evidence by magnification: `python -m train.fit_zoom` learns where closer looks find objects.

    python -m train.fit_zoom --data.root DIR --data.annotations instances.json --out runs/fit_zoom

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

The detector looks at mosaics of 4 × 4 and of 8 × 6 photographs and at other kinds of pictures that are composed of
photographs (`kinds`), in windows at steps of half a window and at all magnifications. The model learns to predict the
results of closer looks from coarser looks at the same place. The folder `out` gets the model (`<name>.safetensors`),
and a report that evaluates it on mosaics of held-out photographs. If the looking is interrupted, repeat the command to
continue.
"""

import json
import sys
from typing import get_args

from semfov.agents.windows import window_eye
from semfov.errors import check
from semfov.fit.training import training_of
from semfov.fit.windows import RefitPart
from semfov.io.files import inside
from semfov.runs.command import command
from semfov.runs.setup import make_detector
from semfov.zoom.evidence import GlimpseEvidence
from train.outputs import write_outputs
from train.zoom_pictures import FitZoomConfig, PicturesFit


def fit_zoom(config: FitZoomConfig) -> None:
    """Look at mosaics, fit, evaluate on held-out photographs, and write the model and a report."""
    check(len(config.refit) > 0, "refit", "at least one part of the model", config.refit)
    model = None
    eye = None
    parts = get_args(RefitPart)
    if config.evidence is not None:
        model = GlimpseEvidence.from_pretrained(config.evidence).requires_grad_(False)
        eye = window_eye(make_detector(config.detector), model).eval().requires_grad_(False)
        model.check_compatible(eye.settings())
        parts = config.refit
    fit = PicturesFit(config, eye)
    model, lines = fit.fit(parts, model)
    settings = training_of(config, fit.mosaics["near"])["training"]
    # The evidence for photographs notes its own metadata.
    model.metadata |= {part: settings for part in parts if part != "photograph"}
    path = inside(config.out, f"{fit.eye.detector.name}.safetensors")
    model.save(path)
    write_outputs(config, "\n".join(lines), {"figures.json": json.dumps(fit.figures, indent=1)}, path)


main = command(fit_zoom, FitZoomConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
