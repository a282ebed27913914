"""Fit all models to your own detector: `python -m train.fit_detector MODEL` makes a folder that the agent loads.

    python -m train.fit_detector mine.onnx --data.root PHOTOS --data.annotations instances.json --out mymodels
    python -m eval.demo PHOTO.jpg --target cup --models mymodels
    python -m eval.search --models mymodels --data.root PHOTOS --data.annotations instances.json

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

MODEL is a name or a file, as for `semfov.load_detector` (docs/detectors.md). A few dozen photographs with boxes are
enough to begin with. The detector looks at every photograph from every cell. Six parts are fitted: an observation
model with its miss rates, the exponent of its likelihoods, target evidence with the thresholds of decisions, the
verification of targets by closer looks, a map of all classes, and, on mosaics of the photographs, the evidence by
magnification for pictures larger than the detector's input. The last part needs 80 photographs; `--windows false`
leaves it out. Each part is compared with raw scores on held-out photographs, and the verification with the same agent
without closer looks. The agent uses only the parts that are better.

The folder `out` gets the models, a manifest, a report and figures. If a run is interrupted, repeat the command to
continue. `semfov.fit_detector` does the same in Python.
"""

import sys
from collections.abc import Sequence

from semfov.fit.detector import fit_folder
from semfov.fit.detector_settings import FitDetectorConfig
from semfov.runs.command import run_command

MODEL = "the detector: a name or a file, as for semfov.load_detector"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_folder, FitDetectorConfig, __doc__, arguments, positional=("model", MODEL))


if __name__ == "__main__":
    sys.exit(main())
