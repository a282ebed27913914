"""Fit the context of searches: `python -m train.fit_context` counts where classes occur, and which occur together.

    python -m train.fit_context --data.root DIR --data.annotations instances.json --out runs/fit_context

The command reads annotations alone and takes seconds. The folder `out` gets the prior (`<name>.safetensors`) and a
report that evaluates it on held-out photographs.

In a search, the context is added to a belief with two weights. By default they are 1. With `--weigh 400` they are
fitted on looks at 400 of the photographs. `train.fit_fom` and `train.fit_tempering` share these looks under the same
`--cache`.

Use the prior with `--policies [target-evidence] --belief.context both` and
`--belief.context_model runs/fit_context/<name>.safetensors`.
"""

import sys
from collections.abc import Sequence

from semfov.runs.command import run_command
from train.context.fit import fit_context
from train.context.settings import FitContextConfig


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_context, FitContextConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
