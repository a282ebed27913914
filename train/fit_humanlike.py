"""Fit how people look: `python -m train.fit_humanlike` models people's next fixations with a policy and gaze habits.

    python -m train.fit_humanlike --root DIR --fixations fixations.json --out runs/fit_humanlike

The command follows each person's scanpath. At every fixation, it computes the value that each policy gives to every
cell. The person's choice of the next cell is then fitted by maximum likelihood, one term after another: a noisy choice
by the policy's value, a centre bias, the distribution of saccade lengths, and inhibition of return that fades. The
model is fitted on half of the people in half of the pictures, and evaluated on the other people in the other pictures.

The folder `out` gets the model (`<name>.safetensors`, a `GazeHabits`) and a report. `Habitual`
draws fixations from the model.
"""

import sys

from semfov.runs.command import command
from train.humanlike.fit import FitHumanlikeConfig, fit_humanlike

main = command(fit_humanlike, FitHumanlikeConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
