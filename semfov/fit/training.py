"""Training of small networks: held-out photographs, the loop, and a record of the training."""

from collections.abc import Callable, Iterable
from contextlib import closing
from typing import Any

import torch
from torch import Tensor, nn

from semfov.data.scene import Scenes
from semfov.errors import DataError
from semfov.runs.config import WHERE
from semfov.runs.progress import task_bar
from semfov.runs.settings import Settings


def training_of(config: Settings, scenes: Scenes, *besides: str) -> dict[str, Any]:
    """Build the metadata of a model about its training.

    Args:
        config: settings of the fit.
        scenes: the photographs.
        besides: settings on which the model does not depend, beside those of data, detector, sensor and workers.

    Returns:
        The digest of the photographs (`data`), and the settings that the model depends on (`training`).
    """
    left_out = {*WHERE, "data", "detector", "sensor", *besides}
    settings = {name: value for name, value in config.plain().items() if name not in left_out}
    return {"data": scenes.fingerprint, "training": settings}


def split(scene: Tensor, holdout: int) -> Tensor:
    """Select the examples to hold out.

    Args:
        scene: `(E,)`, number of the photograph of each example.
        holdout: one in every n photographs is held out.

    Returns:
        `(E,)` boolean, true for held-out examples.

    Raises:
        DataError: all examples are of one kind.
    """
    held_out = scene % holdout == 0
    if held_out.all() or not held_out.any():
        raise DataError(
            f"data: expected examples both to train on and to hold out, got {len(scene)}, all of one kind; give more "
            "photographs"
        )
    return held_out


def descend(
    parameters: Iterable[nn.Parameter] | Iterable[dict[str, object]],
    loss_of: Callable[[int], Tensor | None],
    steps: int,
    rate: float,
    *,
    clip: float | None = 1.0,
    decay: float = 1e-2,
    rise: float = 0.3,
    title: str = "training",
) -> None:
    """Train with AdamW and a one-cycle learning rate (Smith and Topin, 2019).

    Args:
        parameters: parameters, or groups of them with their own options, as for an optimiser.
        loss_of: computes the loss of a step, by its number; a step without a loss (None) is left out.
        steps: number of steps.
        rate: highest learning rate.
        clip: largest norm of the gradient (None: any).
        decay: weight decay.
        rise: share of the steps in which the rate rises.
        title: title of the progress bar.
    """
    optimiser = torch.optim.AdamW(parameters, lr=rate, weight_decay=decay)
    trained = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    # The cycle needs two steps at least.
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
