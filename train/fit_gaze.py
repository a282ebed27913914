"""Learn where to look: `python -m train.fit_gaze` trains a gaze policy through whole searches.

    python -m train.fit_gaze --data.root DIR --data.annotations instances.json --out runs/fit_gaze

Without photographs it uses the embedded scenes, which is only good for trying it out.

Nothing is computed beforehand. In every step a few photographs are searched: the fovea is moved, the detector looks,
the belief is updated, and a small network over the belief says where to look next. The fixation is drawn by
Gumbel-softmax and passed straight through, so the loss, which asks that the next fixation lands on the target, is
differentiated through belief, detector and foveation, back to the choices that brought the fovea there. Only the
network learns (and the width of the fovea, with `--learn_sigma true`); detector and belief stay as they are. It starts
as non-predictive search with tempering 0.25 and footprint `box_centre`, and is compared with that.

A run that was stopped goes on where it was when the same command is given again, and on the same machine ends as if it
had not been. The folder `out` gets the model (`<name>.safetensors`), a checkpoint, and a report that judges the model
and its start on photographs that it was not trained on. Expect a few seconds a step on one CPU core.
Use it with `--policies [learned] --gaze_model runs/fit_gaze/<name>.safetensors`.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.gaze import FitGazeConfig, fit_gaze


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_gaze, FitGazeConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
