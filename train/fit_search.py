"""Learn to search: `python -m train.fit_search` trains the evidence for a target on series of looks at photographs.

    python -m train.fit_search --data.root DIR --data.annotations instances.json --out runs/fit_search

Without photographs it uses the embedded scenes, which is only good for trying it out.

Every photograph is fixated at random points (the looks are shared with `train.fit_fom` under the same `--cache`). For
each class that may be searched for, some of the looks are drawn, and the model is trained by gradient, through the
gathering of evidence and a soft choice of the next fixation, so that this choice lands on the target. The folder `out`
gets the model (`<name>.safetensors`), and a report that judges it on photographs that it was not trained on.
Use it with `--policies target-evidence --belief.target_model runs/fit_search/<name>.safetensors`.
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
