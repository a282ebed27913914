"""Fit how many new objects closer looks at a window will find, from coarser looks at the same part of the picture."""

import logging
import random
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn

from semfov.fit.zoom_examples import LookedAt, ZoomExample, closer_windows
from semfov.runs.window_looking import LEAST_CONFIDENCE
from semfov.zoom.belief import before_of
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.gist import Gist
from semfov.zoom.networks import STEPS

E = TypeVar("E")

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
    descend_examples(
        own, lambda example: rate_loss(model, example), examples, steps, batch, "expected number of objects"
    )


def descend_examples(
    parameters: Iterable[nn.Parameter],
    loss_of: Callable[[E], Tensor],
    examples: Sequence[E],
    steps: int,
    batch: int,
    title: str,
    rate: float = 6e-3,
) -> None:
    """Minimise the mean loss of random examples.

    Args:
        parameters: the parameters to fit.
        loss_of: loss of an example, a scalar.
        examples: the training examples.
        steps: number of steps.
        batch: examples in a step.
        title: name of the fit in the log.
        rate: highest learning rate.
    """
    own = [*parameters]
    optimizer = torch.optim.AdamW(own, lr=rate, weight_decay=0.1)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
    for step in range(steps):
        losses = [loss_of(example) for example in random.sample(examples, min(batch, len(examples)))]
        loss = torch.stack(losses).mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(own, 1.0)
        optimizer.step()
        schedule.step()
        if step % 100 == 99:
            _log.info("%s: step %d, loss %.4f", title, step + 1, float(loss.detach()))


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
    sure, faint = (
        (shown >= LEAST_CONFIDENCE).nonzero()[:, 0] + 1,
        ((shown >= 0.02) & (shown < LEAST_CONFIDENCE)).nonzero()[:, 0] + 1,
    )
    targets = torch.cat([_some(sure, 8), _some(faint, 4)])
    if not len(targets):
        targets = _some(torch.arange(len(shown)) + 1, 1)
    looks = [look for look in example.looks if look.gist is not None]
    overview, *others = looks
    assert overview.gist is not None
    logs = model.rates(overview.gist, targets)
    losses = [_likelihood_loss(model, example, overview, logs, targets, overview.found)]
    for closer in random.sample(others, min(2, len(others))):
        assert closer.gist is not None
        before = rates_before(overview.gist, logs.detach(), closer.gist)
        seen = overview.found | closer.found
        closer_logs = model.rates(closer.gist, targets, before)
        losses.append(_likelihood_loss(model, example, closer, closer_logs, targets, seen))
    return torch.stack(losses).mean()


def _some(values: Tensor, most: int) -> Tensor:
    return values[torch.randperm(len(values))[:most]]


def rates_before(first: Gist, logs: Tensor, look: Gist) -> Tensor:
    """Convert the rates of the overview to the cells of a closer look, for windows one octave closer than that look.

    Args:
        first: gist of the overview.
        logs: `(T, 3, rows, columns)`, logarithms of its rates.
        look: gist of the closer look.

    Returns:
        Logarithms `(T, rows, columns)`, as the prediction before the closer look.
    """
    cells = (logs.exp() / first.scale**2).repeat_interleave(first.scale, -1).repeat_interleave(first.scale, -2)
    rows, columns = (n * look.scale for n in look.scores.shape[:2])
    part = cells[..., look.first[1] : look.first[1] + rows, look.first[0] : look.first[0] + columns]
    return torch.stack([before_of(one.numpy(), look) for one in part[:, min(look.level, STEPS - 1)]])


def _likelihood_loss(
    model: GlimpseEvidence, example: ZoomExample, looked_at: LookedAt, logs: Tensor, targets: Tensor, seen: Tensor
) -> Tensor:
    """Compute the mean negative log likelihood over the closer windows inside a look."""
    rates = logs.exp()
    terms = []
    for closer, steps, (x1, y1, x2, y2) in closer_windows(example, looked_at):
        weight = model.taper(x2 - x1)
        part = rates[:, steps - 1, max(y1, 0) : y2, max(x1, 0) : x2]
        expected = torch.einsum("tyx,y,x->t", part, weight[: part.shape[1]], weight[: part.shape[2]])
        new = example.labels[closer.found & ~seen]
        count = (new == targets[:, None]).sum(-1)
        terms.append((expected - count * expected.clamp(min=1e-6).log()).mean())
    return torch.stack(terms).mean() if terms else logs.sum() * 0
