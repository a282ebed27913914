"""What fits on the looks of whole photographs have in common: what is held out, and what is written."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from torch import Tensor

from semfov.errors import DataError
from semfov.experiments.parallel import rank
from semfov.io.pretrained import Pretrained
from semfov.training.evidence_examples import LookingRun, looking
from semfov.training.outputs import model_path, write_outputs

Model = TypeVar("Model", bound=Pretrained)


@dataclass(frozen=True)
class Fit(Generic[Model]):
    """What a fit gives.

    Attributes:
        model: fitted to the photographs that were not held out.
        judged: figures on those that were, after some looks.
        trained: examples that it was trained on.
        held_out: examples that it was judged on.
        report: the figures as Markdown.
    """

    model: Model
    judged: list[dict[str, float]]
    trained: int
    held_out: int
    report: str


def split(scene: Tensor, holdout: int) -> Tensor:
    """Which examples are held out, `(E,)` boolean: those of every so many-th photograph.

    Args:
        scene: `(E,)`, index of the photograph of each example.
        holdout: every n-th photograph is held out, the first among them.

    Raises:
        DataError: all are held out, or none is.
    """
    held_out = scene % holdout == 0
    if held_out.all() or not held_out.any():
        raise DataError(f"data: too few photographs to train and to judge by ({len(scene)} examples); give more")
    return held_out


def fit_and_write(config: Any, fit: Callable[[Any, LookingRun], Fit[Any]]) -> None:
    """Look from every cell, fit, and write model, report, settings and figures.

    Args:
        config: settings of the fit.
        fit: makes the model from the settings and a run that has looked.
    """
    run = looking(config)
    if rank() > 0:
        return
    fitted = fit(config, run)
    path = model_path(config, run.eye.detector.name)
    fitted.model.save(path)
    write_outputs(config, fitted.report, ("judged.json", json.dumps(fitted.judged, indent=2) + "\n"), path)
