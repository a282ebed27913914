"""Learn evidence for targets: `python -m train.fit_search` trains what the recommended agent believes and decides by.

    python -m train.fit_search --data.root DIR --data.annotations instances.json --out runs/fit_search

Without photographs it uses the embedded scenes, which is only good for trying it out.

Every photograph is looked at from every cell (shared with `eval.search` under the same `--cache`). Then the model
searches them for classes that they hold and for classes that they do not, and learns from its own looks where the
target is, whether it is there at all, and where to look next. The folder `out` gets the model (`<name>.safetensors`)
with the thresholds of its decisions, and a report that judges it on photographs that were held out. Looking goes on
where it was when the same command is given again.
Use it with `--policies [target-evidence] --belief.target_model runs/fit_search/<name>.safetensors`.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.evidence import FitSearchConfig, fit_search


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_search, FitSearchConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
