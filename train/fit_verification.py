"""Learn to verify targets: `python -m train.fit_verification` fits what closer looks tell before a search ends.

    python -m train.fit_verification --data.root DIR --data.annotations instances.json --out runs/fit_verification

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

The agent searches the photographs for present and for absent classes by a model that was fitted to search. After some
looks the places that seem to hold the target are looked at closely: a window around each is enlarged to the detector's
input. Two logistic regressions learn from these closer looks whether the target is at the place, and whether it is in
the photograph. Then the searches are repeated, each with a model that was fitted to other photographs, to evaluate the
decisions and to choose their threshold. The folder `out` gets the model (`<name>.safetensors`) and the report. All
looks are stored, photograph by photograph, in the folder `cache`, where `train.fit_search` finds them, too: the same
command continues an interrupted fit.
"""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from semfov.belief.verification import TRUE_CELLS
from semfov.errors import DataError, InputError
from semfov.fit.searches import open_photographs
from semfov.fit.settings import VerificationConfig
from semfov.fit.training import training_of
from semfov.fit.verification import fit_in_folds
from semfov.fit.verification_report import verification_report
from semfov.observation.foveal import FovealObservationModel
from semfov.runs.command import command
from semfov.runs.config import DataConfig
from semfov.runs.looking import Looking
from semfov.runs.setup import make_searching
from train.outputs import model_path, write_outputs


@dataclass(frozen=True)
class FitVerificationConfig(VerificationConfig):
    """Fit the verification of targets.

    Args:
        search_model: observation model fitted to search, by name or file (None: the one shipped for the detector).
        cache: folder for the looks at the photographs, so that an interrupted fit continues (None: the user's cache).
    """

    unused: ClassVar[tuple[str, ...]] = ("workers", "scheduler")
    data: DataConfig = field(default_factory=DataConfig)
    search_model: str | None = None
    out: Path = Path("runs/fit_verification")


def fit_verification(config: FitVerificationConfig) -> None:
    """Search the photographs, look closely at candidates, fit, evaluate in folds, and write all results."""
    run = Looking(config)
    model = make_searching(config.search_model, run.eye)
    _check_thresholds(config, model)
    count = len(run.scenes)
    if count < config.folds:
        raise DataError(f"data: expected at least {config.folds} photographs for the folds, got {count}")
    photographs = open_photographs(run, range(count), config)
    fitted = fit_in_folds(photographs, model, config)
    fitted.model.metadata = {
        **run.eye.settings(),
        TRUE_CELLS: model.true_cells,
        **training_of(config, run.scenes, "search_model"),
    }
    path = model_path(config, run.eye.detector.name)
    fitted.model.save(path)
    report = verification_report(fitted, f"{len(photographs)} photographs")
    write_outputs(config, report.text, {"judged.json": json.dumps(report.figures, indent=2) + "\n"}, path)


def _check_thresholds(config: FitVerificationConfig, searching: FovealObservationModel) -> None:
    """Refuse thresholds of true probabilities for a search without: those of the belief are smaller."""
    usual = VerificationConfig()
    if not searching.true_cells and (config.place == usual.place or config.stop_below == usual.stop_below):
        raise InputError(
            "place, stop_below: expected those of a model of searches whose probabilities of cells are not true "
            f"(presence.centre), got {config.place:g}, {config.stop_below:g}; give --place 0.05 --stop_below 0.0005, "
            "or a --search_model of python -m train.fit_search"
        )


main = command(fit_verification, FitVerificationConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
