"""Fit how people look: `python -m train.fit_humanlike` brings a policy as near to people as habits can.

    python -m train.fit_humanlike --root DIR --fixations fixations.json --out runs/fit_humanlike

The pictures are looked at from every cell, and each person's scanpath is followed: whenever somebody chose where to
look next, the policies are asked what they make of every cell. How people chose among the cells is then fitted by
maximum likelihood, one term after another: a noisy choice by the policy's value, a bias for the centre, saccade
lengths, and inhibition of return that fades. It is fitted on half of the people in half of the pictures, and judged by
the other people in the other pictures. The folder `out` gets the model (`<name>.safetensors`,
`semfov.gaze.GazeHabits`) and a report. Draw fixations by the model with `semfov.gaze.Habitual`.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.humanlike import FitHumanlikeConfig, fit_humanlike


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_humanlike, FitHumanlikeConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
