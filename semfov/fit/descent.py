"""A training loop for small networks: AdamW with one cycle of the learning rate."""

from collections.abc import Callable, Iterable
from contextlib import closing

import torch
from torch import Tensor, nn

from semfov.runs.progress import task_bar


def descend(
    parameters: Iterable[nn.Parameter],
    loss_of: Callable[[int], Tensor],
    steps: int,
    rate: float,
    *,
    clip: float | None = 1.0,
    decay: float = 1e-2,
    title: str = "training",
) -> None:
    """Train with AdamW and one cycle of the learning rate (Smith and Topin, 2019)."""
    trained = list(parameters)
    optimiser = torch.optim.AdamW(trained, lr=rate, weight_decay=decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=steps)
    with closing(task_bar(steps, title, "step")) as bar:
        for number in range(steps):
            loss = loss_of(number)
            optimiser.zero_grad()
            loss.backward()
            if clip is not None:
                torch.nn.utils.clip_grad_norm_(trained, clip)
            optimiser.step()
            schedule.step()
            bar.update()
            if number % 25 == 0:
                bar.set_postfix(loss=f"{float(loss.detach()):.3f}")
