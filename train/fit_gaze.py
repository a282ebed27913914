"""Fit where people look: `python -m train.fit_gaze` fits a `FixationDensity` to fixations in pictures.

    python -m train.fit_gaze --fixations [osie/fixations.json] --pictures [osie/images] --detector.name yolox-nano

Several data sets may be given, with a folder of pictures for each file of fixations. Every picture passes the detector
once. The map and the centre bias are fitted by maximum likelihood of all fixations but the first of each person, every
picture alike, and then the oculomotor biases, given the map. With `folds`, models are first fitted without each fold of
the pictures and evaluated on it, and the report has the means. The folder `out` gets the model that is fitted to all
pictures (`<name>.safetensors`, a `semfov.saliency.FixationDensity`) and the report.
"""

import sys

from semfov.runs.command import command
from train.gaze import FitGazeConfig, fit_gaze

main = command(fit_gaze, FitGazeConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
