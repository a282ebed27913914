"""Fit a foveal observation model: `python -m train.fit_fom` learns how a detector scores what it sees off-centre.

    python -m train.fit_fom --data.root DIR --data.annotations instances.json --out runs/fit_fom

Without photographs it uses the embedded scenes, which is only good for trying it out.

Every photograph is fixated at random points; detections are matched to the annotated boxes, and p(scores | class,
distance to the fovea) is fitted to them. The folder `out` gets the model (`<name>.safetensors`), a report that judges
it on photographs that it was not fitted on, and a reliability diagram. A run that was stopped goes on where it was;
more machines share the work under `torchrun`. Use the model with `--belief.model runs/fit_fom/<name>.safetensors`.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.observation import fit_fom
from semfov.training.observation_settings import FitConfig


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_fom, FitConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
