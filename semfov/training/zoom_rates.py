"""Fit how many new objects closer looks at a window will find, from coarser looks at the same part of the picture."""

import logging
import random

import torch
from torch import Tensor, nn

from semfov.experiments.zoom import SHOWN
from semfov.training.zoom_examples import LookedAt, ZoomExample
from semfov.zoom.belief import before_of
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.networks import STEPS

_log = logging.getLogger(__name__)


def fit_rates(model: GlimpseEvidence, examples: list[ZoomExample], steps: int, batch: int = 4) -> None:
    """Fit the expected number of objects that closer looks find, by its Poisson likelihood in every window.

    Args:
        model: the model to fit.
        examples: the training examples.
        steps: number of steps.
        batch: examples in a step.
    """
    own = [*model.rate.parameters(), model.prior, model.border]
    optimizer = torch.optim.AdamW(own, lr=6e-3, weight_decay=0.1)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 6e-3, total_steps=steps)
    for step in range(steps):
        losses = [rate_loss(model, example) for example in random.sample(examples, min(batch, len(examples)))]
        loss = torch.stack(losses).mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(own, 1.0)
        optimizer.step()
        schedule.step()
        if step % 100 == 99:
            _log.info("expected number of objects: step %d, loss %.4f", step + 1, float(loss.detach()))


def rate_loss(model: GlimpseEvidence, example: ZoomExample) -> Tensor:
    """Compute the negative log likelihood of the numbers of objects found in the windows of a mosaic.

    Only a few classes enter: random samples of the clearly and of the faintly visible ones.

    Args:
        model: the model.
        example: the mosaic.

    Returns:
        The mean over looks, a scalar.
    """
    shown = torch.stack([look.show for look in example.looks]).amax(0)
    sure, faint = (shown >= SHOWN).nonzero()[:, 0] + 1, ((shown >= 0.02) & (shown < SHOWN)).nonzero()[:, 0] + 1
    targets = torch.cat([_some(sure, 8), _some(faint, 4)])
    if not len(targets):
        targets = _some(torch.arange(len(shown)) + 1, 1)
    looks = [look for look in example.looks if look.gist is not None]
    overview, *others = looks
    logs = _log_rates(model, overview, targets, None)
    losses = [_likelihood_loss(model, example, overview, logs, targets, overview.found)]
    for closer in random.sample(others, min(2, len(others))):
        before = _before(overview, logs.detach(), closer)
        seen = overview.found | closer.found
        closer_logs = _log_rates(model, closer, targets, before)
        losses.append(_likelihood_loss(model, example, closer, closer_logs, targets, seen))
    return torch.stack(losses).mean()


def _some(values: Tensor, most: int) -> Tensor:
    return values[torch.randperm(len(values))[:most]]


def _log_rates(model: GlimpseEvidence, looked_at: LookedAt, targets: Tensor, before: Tensor | None) -> Tensor:
    assert looked_at.gist is not None
    return model.rates(looked_at.gist, targets, before)


def _before(overview: LookedAt, logs: Tensor, closer: LookedAt) -> Tensor:
    """Convert the rates of the overview to the cells of a closer look, for windows one octave closer than that look.

    Returns:
        Rates `(T, rows, columns)`, as the prediction before the closer look.
    """
    first, look = overview.gist, closer.gist
    assert first is not None
    assert look is not None
    cells = (logs.exp() / first.scale**2).repeat_interleave(first.scale, -1).repeat_interleave(first.scale, -2)
    rows, columns = (n * look.scale for n in look.scores.shape[:2])
    part = cells[..., look.first[1] : look.first[1] + rows, look.first[0] : look.first[0] + columns]
    source = torch.zeros(part.shape[-2:], dtype=torch.long)
    return torch.stack([before_of(one, source, look) for one in part])


def _likelihood_loss(
    model: GlimpseEvidence, example: ZoomExample, looked_at: LookedAt, logs: Tensor, targets: Tensor, seen: Tensor
) -> Tensor:
    """Compute the mean negative log likelihood over the closer windows inside a look."""
    look = looked_at.gist
    assert look is not None
    rates = logs.exp()
    high, wide = look.scores.shape[:2]
    terms = []
    for closer in example.looks:
        steps = closer.window.level - look.level
        x1, y1, x2, y2 = closer.window.cells
        box = [x1 - look.first[0], y1 - look.first[1], x2 - look.first[0], y2 - look.first[1]]
        x1, y1, x2, y2 = (n // look.scale for n in box)
        inside = x1 >= 0 and y1 >= 0 and x2 <= wide and y2 <= high
        if closer.window.within is not None or not 1 <= steps <= STEPS or not (inside or look.level == 0):
            continue
        weight = model.taper(x2 - x1)
        part = rates[:, steps - 1, max(y1, 0) : y2, max(x1, 0) : x2]
        expected = torch.einsum("tyx,y,x->t", part, weight[: part.shape[1]], weight[: part.shape[2]])
        new = example.labels[closer.found & ~seen]
        count = (new == targets[:, None]).sum(-1)
        terms.append((expected - count * expected.clamp(min=1e-6).log()).mean())
    return torch.stack(terms).mean() if terms else logs.sum() * 0
