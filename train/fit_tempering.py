"""Fit the tempering of likelihoods: `python -m train.fit_tempering` finds the exponent τ that guides the gaze best.

    python -m train.fit_tempering --data.root DIR --data.annotations instances.json --out runs/fit_tempering

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

Every photograph is fixated at random points; `train.fit_fom` shares these looks under the same `--cache`. For each
class that may be searched for, the looks are fused one after another with likelihoods to the power of τ. After each
look, the most probable cell is the next fixation. The folder `out` gets a report that lists for every τ how often this
fixation hits the target, on photographs to choose τ by and on held-out photographs.

Use the best exponent with `--belief.tempering τ`, or as the `tempering` of one policy.
"""

import sys

from semfov.fit.tempering import FitTemperingConfig, fit_tempering
from semfov.runs.command import command

main = command(fit_tempering, FitTemperingConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
