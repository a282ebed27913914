"""Learn where to look: `python -m train.fit_gaze` trains a gaze policy end to end, through whole searches.

    python -m train.fit_gaze --data.root DIR --data.annotations instances.json --out runs/fit_gaze

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

Each training step searches a few photographs: the fovea moves, the detector looks, the belief is updated, and a small
network computes from the belief where to look next. Fixations are drawn with a straight-through Gumbel-softmax. The
loss rewards a next fixation on the target. Its gradient flows through belief, detector and foveation back to the
choices of the earlier fixations. Only the network is trained, and with `--learn_sigma true` also the width of the
fovea. Before training, the network is equivalent to non-predictive search with tempering 0.25 and footprint
`box_centre`, and the report compares it with this search.

If a run is interrupted, repeat the command to continue. On the same machine, the result is the same as without the
interruption. The folder `out` gets the model (`<name>.safetensors`), a checkpoint, and a report that evaluates the
policy before and after training on held-out photographs. A step takes a few seconds on one CPU core.

Use the model with `--policies [learned] --gaze_model runs/fit_gaze/<name>.safetensors`.
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
