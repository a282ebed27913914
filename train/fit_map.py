"""Learn the map of all classes: `python -m train.fit_map` trains the model with which the recommended agent explores.

    python -m train.fit_map --data.root DIR --data.annotations instances.json --out runs/fit_map

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

The detector looks at every photograph from every cell; `eval.explore` shares these looks under the same `--cache`. Then
the model explores the photographs. From its own looks it learns which classes are in each cell, and how many more cells
the next look will classify correctly. The folder `out` gets the model (`<name>.safetensors`) and a report that
evaluates it on held-out photographs. If the looking is interrupted, repeat the command to continue.

Use it with `python -m eval.explore --policies [learned-map] --belief.map_model runs/fit_map/<name>.safetensors`.
"""

import sys

from semfov.errors import check
from semfov.fit.map import FitMapConfig, fit_map_evidence
from semfov.runs.command import command
from train.outputs import fit_and_write


def fit_map(config: FitMapConfig) -> None:
    """Look from every cell, train, evaluate on held-out photographs, and write all results."""
    check(config.others < config.classes, "others", f"from 1 to {config.classes - 1}", config.others)
    fit_and_write(config, fit_map_evidence)


main = command(fit_map, FitMapConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
