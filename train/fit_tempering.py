"""Fit the tempering of likelihoods: `python -m train.fit_tempering` finds the exponent with which looks count best.

    python -m train.fit_tempering --data.root DIR --data.annotations instances.json --out runs/fit_tempering

Without photographs it uses the embedded scenes, which is only good for trying it out.

Every photograph is fixated at random points (the looks are shared with `train.fit_fom` under the same `--cache`). For
each class that may be searched for, the looks are fused one after another with likelihoods to the power of τ, and after
each of them the target's posterior tells where to look next. The folder `out` gets a report with a row for every τ: how
often that fixation hits the target, on photographs to choose τ by and on photographs that were held out.
Use it with `--belief.tempering τ`, or as the `tempering` of one policy.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.tempering import FitTemperingConfig, fit_tempering


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_tempering, FitTemperingConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
