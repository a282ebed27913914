"""Fit a model for searches: `python -m train.fit_search` fits the one with which the recommended agent searches.

    python -m train.fit_search --data.root DIR --data.annotations instances.json --out runs/fit_search

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

The detector looks at every photograph from every cell, with `--steps 0` only from those that searches fixate;
`eval.search` shares these looks under the same `--cache`. The fit starts from an observation model. It learns the odds
of a miss from searches for the classes of the photographs, and then, from searches for present and for absent classes,
how probable a cell is, and whether a photograph holds the class. The folder `out` gets the model (`<name>.safetensors`)
with the thresholds of its decisions, and a report that evaluates it on held-out photographs. If the looking is
interrupted, repeat the command to continue.

Search with the model by `semfov search … --models runs/fit_search/<name>.safetensors --how fovea`, in Python by
`ActivePerception.from_pretrained(<file>)`, and in studies by `--policies [recommended] --belief.search_model <file>`.
"""

import json
import sys

from semfov.fit import search
from semfov.fit.search import FitSearchConfig
from semfov.runs.command import command
from semfov.runs.looking import Looking
from semfov.runs.scene_run import finish
from semfov.runs.setup import make_observation
from train.outputs import model_path, write_outputs


def fit_search(config: FitSearchConfig) -> None:
    """Look from every cell, fit, evaluate on held-out photographs, and write all results."""
    run = Looking(config)
    start = make_observation(config.model, run.eye)  # before the looks, which take long
    search.check_start(start, config)
    if config.steps > 0:
        finish(run, "looking")
    fitted = search.fit_search(start, config, run)
    path = model_path(config, run.eye.detector.name)
    fitted.model.save(path)
    write_outputs(config, fitted.report, {"judged.json": json.dumps(fitted.judged, indent=2) + "\n"}, path)


main = command(fit_search, FitSearchConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
