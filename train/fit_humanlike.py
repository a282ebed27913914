"""Fit how people look: `python -m train.fit_humanlike` models people's next fixations with a policy and gaze habits.

    python -m train.fit_humanlike --root DIR --fixations fixations.json --out runs/fit_humanlike

The command follows each person's scanpath. At every fixation, it computes the value that each policy gives to every
cell. The person's choice of the next cell is then fitted by maximum likelihood, one term after another: a noisy choice
by the policy's value, a centre bias, the distribution of saccade lengths, and inhibition of return that fades. The
model is fitted on half of the people in half of the pictures, and evaluated on the other people in the other pictures.

The folder `out` gets the model (`<name>.safetensors`, a `semfov.gaze.GazeHabits`) and a report. `semfov.gaze.Habitual`
draws fixations from the model.
"""

import sys
from collections.abc import Sequence

from semfov.runs.command import run_command
from train.humanlike.fit import FitHumanlikeConfig, fit_humanlike


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_humanlike, FitHumanlikeConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
