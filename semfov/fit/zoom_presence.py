"""Fit whether closer looks at a window will show a class, from coarser looks at the same part of the picture."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.fit.zoom_examples import ZoomExample
from semfov.runs.window_looking import LEAST_CONFIDENCE
from semfov.zoom.evidence import GlimpseEvidence, pool
from semfov.zoom.networks import STEPS


@dataclass(frozen=True)
class Windows:
    """N pairs of a look and a closer window inside it, as one table.

    Attributes:
        scores: `(N, K)`, highest score of each class that the look shows inside the window.
        summary: `(N, 3)`, further features of the window in the look (`semfov.zoom.evidence.pool`).
        steps: `(N,)`, number of octaves by which the window is looked at closer.
        shown: `(N, K)`, whether the closer look showed the class.
        before: `(N,)`, row of the overview for the same window; -1 for rows of the overview itself.
        slot: `(N,)`, whether the window is a photograph of the mosaic.
        mosaic: `(N,)`, number of the mosaic.
    """

    scores: Tensor
    summary: Tensor
    steps: Tensor
    shown: Tensor
    before: Tensor
    slot: Tensor
    mosaic: Tensor


def pair_windows(examples: list[ZoomExample]) -> Windows:
    """Pair every look with every closer window inside it."""
    rows: list[tuple[Tensor, Tensor, int, Tensor, int, bool, int]] = []
    for number, example in enumerate(examples):
        first: dict[int, int] = {}
        for looked_at in example.looks:
            look = looked_at.gist
            if look is None:
                continue
            high, wide = (n * look.scale for n in look.scores.shape[:2])
            for place, closer in enumerate(example.looks):
                steps = closer.window.level - look.level
                x1, y1, x2, y2 = closer.window.cells
                x1, y1, x2, y2 = x1 - look.first[0], y1 - look.first[1], x2 - look.first[0], y2 - look.first[1]
                inside = x1 >= 0 and y1 >= 0 and x2 <= wide and y2 <= high
                if not 1 <= steps <= STEPS or not (inside or look.level == 0):
                    continue
                box = x1 // look.scale, y1 // look.scale, -(-x2 // look.scale), -(-y2 // look.scale)
                pooled, summary = pool(look.scores, box)
                before = -1 if look.level == 0 else first.get(place, -1)
                if look.level == 0:
                    first[place] = len(rows)
                if look.level > 0 and before < 0:
                    continue
                slot = closer.window.within is not None
                rows.append((pooled, summary, steps, closer.show >= LEAST_CONFIDENCE, before, slot, number))
    columns: list[Any] = [*zip(*rows, strict=True)]
    whole = [torch.tensor(columns[place]) for place in (2, 4, 5, 6)]
    return Windows(torch.stack(columns[0]), torch.stack(columns[1]), whole[0], torch.stack(columns[3]), *whole[1:])


def fit_presence(model: GlimpseEvidence, windows: Windows, steps: int, batch: int = 1024) -> None:
    """Fit the probability that a closer look shows a class, by the mean cross-entropy over windows and classes.

    Args:
        model: the model to fit.
        windows: the training windows.
        steps: number of steps.
        batch: rows of the overview in a step; there are half as many rows of later looks.
    """
    own = [model.slope, model.offset, *model.company.parameters(), *model.shape.parameters()]
    optimizer = torch.optim.AdamW(own, lr=8e-3, weight_decay=1.0)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 8e-3, total_steps=steps)
    first, later = (windows.before < 0).nonzero()[:, 0], (windows.before >= 0).nonzero()[:, 0]
    for _ in range(steps):
        model.train()
        loss = presence_loss(model, windows, first[torch.randint(len(first), (batch,))])
        if len(later):
            loss = loss + presence_loss(model, windows, later[torch.randint(len(later), (batch // 2,))])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    model.eval()


def presence_loss(model: GlimpseEvidence, windows: Windows, rows: Tensor) -> Tensor:
    """Compute the mean cross-entropy of `presence_log_odds` over rows and classes."""
    odds = presence_log_odds(model, windows, rows)
    return F.binary_cross_entropy_with_logits(odds, windows.shown[rows].to(odds))


def presence_log_odds(model: GlimpseEvidence, windows: Windows, rows: Tensor) -> Tensor:
    """Compute the log-odds that closer looks show each class.

    Args:
        model: the model.
        windows: the windows.
        rows: rows to compute, either all of overviews or all of later looks.

    Returns:
        Log-odds, one row for each window and one column for each class.
    """
    before = None
    if bool((windows.before[rows] >= 0).all()):
        training = model.training
        model.eval()
        with torch.no_grad():
            before = presence_log_odds(model, windows, windows.before[rows])
        model.train(training)
    return model.presence(windows.scores[rows], windows.summary[rows], windows.steps[rows], None, before)
