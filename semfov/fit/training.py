"""Training of small networks: photographs that are held out, the loop, and what a model tells about it."""

from collections.abc import Callable, Iterable
from contextlib import closing
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from semfov.data.scene import Scenes
from semfov.errors import DataError
from semfov.io.pretrained import Pretrained
from semfov.runs.config import WHERE
from semfov.runs.progress import task_bar

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


def descend(
    parameters: Iterable[nn.Parameter] | Iterable[dict[str, Any]],
    loss_of: Callable[[int], Tensor | None],
    steps: int,
    rate: float,
    *,
    clip: float | None = 1.0,
    decay: float = 1e-2,
    rise: float = 0.3,
    title: str = "training",
) -> None:
    """Train with AdamW and one cycle of the rate (Smith and Topin, 2019); a step without a loss is left out."""
    optimiser = torch.optim.AdamW(parameters, lr=rate, weight_decay=decay)
    trained = [each for group in optimiser.param_groups for each in group["params"]]
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=max(steps, 2), pct_start=rise)
    with closing(task_bar(steps, title, "step")) as bar:
        for number in range(steps):
            loss = loss_of(number)
            if loss is None:
                continue
            optimiser.zero_grad()
            loss.backward()
            if clip is not None:
                torch.nn.utils.clip_grad_norm_(trained, clip)
            optimiser.step()
            schedule.step()
            bar.update()
            if number % 25 == 0:
                bar.set_postfix(loss=f"{float(loss.detach()):.3f}")
