"""Learn the map of all classes: `python -m train.fit_map` trains what the recommended agent explores by.

    python -m train.fit_map --data.root DIR --data.annotations instances.json --out runs/fit_map

Without photographs it uses the embedded scenes, which is only good for trying it out.

Every photograph is looked at from every cell (shared with `eval.explore` under the same `--cache`). Then the model
explores them and learns from its own looks what is where, and how much more the next look will tell. The folder `out`
gets the model (`<name>.safetensors`) and a report that judges it on photographs that were held out. Looking goes on
where it was when the same command is given again.
Use it with `python -m eval.explore --policies [learned-map] --belief.map_model runs/fit_map/<name>.safetensors`.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.map_evidence import FitMapConfig, fit_map


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_map, FitMapConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
