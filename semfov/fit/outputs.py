"""The outputs of every fit: a model with metadata about the training, a report, the settings and measures as JSON."""

from typing import Any, Generic, NamedTuple, TypeVar

from torch import Tensor

from semfov.data.scene import Scenes
from semfov.errors import DataError
from semfov.io.pretrained import Pretrained
from semfov.runs.config import WHERE

_Model = TypeVar("_Model", bound=Pretrained)


def training_of(config: Any, scenes: Scenes, *besides: str) -> dict[str, Any]:
    """Build the metadata of a model about its training: the photographs, and the settings that the model depends on."""
    left_out = {*WHERE, "data", "detector", "sensor", *besides}
    settings = {name: value for name, value in config.plain().items() if name not in left_out}
    return {"data": scenes.fingerprint, "training": settings}


class Fit(NamedTuple, Generic[_Model]):
    """The result of a fit."""

    model: _Model
    judged: list[dict[str, float]]
    trained: int
    held_out: int
    report: str


def split(scene: Tensor, holdout: int) -> Tensor:
    """Select the examples to hold out; scene `(E,)` → `(E,)`."""
    held_out = scene % holdout == 0
    if held_out.all() or not held_out.any():
        raise DataError(
            f"data: expected examples both to train on and to hold out, got {len(scene)}, all of one kind; give more "
            "photographs"
        )
    return held_out
