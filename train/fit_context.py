"""Fit the context of searches: `python -m train.fit_context` counts where the classes are, and beside what.

    python -m train.fit_context --data.root DIR --data.annotations instances.json --out runs/fit_context

It reads annotations alone and takes seconds. The folder `out` gets the prior (`<name>.safetensors`) and a report that
judges it on photographs that were held out. How much it should count beside a belief that has looked is another
matter: with `--weigh 400` its weights are fitted on looks at so many of the photographs (shared with `train.fit_fom`
and `train.fit_search` under the same `--cache`); without, they are 1.
Use it with `--policies [target-evidence] --belief.context both`, and
`--belief.context_model runs/fit_context/<name>.safetensors`.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.context import fit_context
from semfov.training.places import FitContextConfig


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_context, FitContextConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
