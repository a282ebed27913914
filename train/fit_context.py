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

from semfov.runs.command import command
from train.context.fit import fit_context
from train.context.settings import FitContextConfig

main = command(fit_context, FitContextConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
