"""Learn evidence for targets: `python -m train.fit_search` trains the model with which the recommended agent searches.

    python -m train.fit_search --data.root DIR --data.annotations instances.json --out runs/fit_search

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

The detector looks at every photograph from every cell; `eval.search` shares these looks under the same `--cache`. Then
the model searches the photographs for present and for absent classes. From its own looks it learns where the target is,
whether it is present, and where to look next. The folder `out` gets the model (`<name>.safetensors`) with the
thresholds of its decisions, and a report that evaluates it on held-out photographs. If the looking is interrupted,
repeat the command to continue.

Use the model with `--policies [target-evidence] --belief.target_model runs/fit_search/<name>.safetensors`.
"""

import sys

from semfov.fit.evidence import FitSearchConfig, fit_evidence
from semfov.runs.command import command
from train.outputs import fit_and_write


def fit_search(config: FitSearchConfig) -> None:
    """Look from every cell, train, evaluate on held-out photographs, and write all results."""
    fit_and_write(config, fit_evidence)


main = command(fit_search, FitSearchConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
