"""Fit everything to a detector of your own: `python -m train.fit_detector MODEL` makes a folder for the agent.

    python -m train.fit_detector mine.onnx --data.root PHOTOS --data.annotations instances.json --out mymodels
    python -m eval.demo PHOTO.jpg --target cup --models mymodels
    python -m eval.search --models mymodels --data.root PHOTOS --data.annotations instances.json

Without photographs it uses the embedded scenes, which is only good for trying it out.

MODEL is a name or a file, as for `semfov.load_detector` (docs/detectors.md); a few dozen photographs with boxes are
enough to begin with. Every photograph is looked at from every cell. To these looks are fitted an observation model with
its misses, the exponent of its likelihoods, target evidence with the thresholds of decisions, and a map of all classes.
Each is compared with raw scores on photographs that were held out, and what is no better is not used.

The folder `out` gets the models, a manifest, a report and figures. A run that was stopped goes on where it was when the
same command is given again. `semfov.fit_detector` does the same in Python.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.detector import fit_folder
from semfov.training.detector_settings import FitDetectorConfig

MODEL = "the detector: a name or a file, as for semfov.load_detector"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_folder, FitDetectorConfig, __doc__, arguments, positional=("model", MODEL))


if __name__ == "__main__":
    sys.exit(main())
