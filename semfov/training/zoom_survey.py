"""Fitting how many objects of any class closer looks find (`semfov.zoom.survey`)."""

import logging
import random
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.training.zoom_examples import LookedAt, ZoomExample
from semfov.zoom.belief import before_of
from semfov.zoom.gist import Gist
from semfov.zoom.networks import STEPS
from semfov.zoom.survey import Survey

LATER = 2
"""Closer looks of a mosaic, beside its overview, whose predictions are fitted in one step."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CountedLook:
    """A look, and how many new objects each of the closer looks inside it found.

    Attributes:
        gist: the look.
        counts: by octaves and cells along a side of a window: rows and columns of the windows' first cells in the gist,
            `(N,)` each, and the numbers of new objects, `(N,)`.
    """

    gist: Gist
    counts: dict[tuple[int, int], tuple[Tensor, Tensor, Tensor]]

    @classmethod
    def of(cls, example: ZoomExample, looked: LookedAt, seen: Tensor) -> "CountedLook":
        """Compare a look with all closer looks inside it.

        Args:
            example: the mosaic.
            looked: the look.
            seen: `(M,)`, objects of the mosaic that were found before.

        Returns:
            The look with the numbers of new objects.
        """
        look = looked.gist
        assert look is not None
        high, wide = look.scores.shape[:2]
        found = defaultdict(list)
        for closer in example.looks:
            steps = closer.window.level - look.level
            corners = zip(closer.window.cells, look.first * 2, strict=True)
            x1, y1, x2, y2 = ((cell - first) // look.scale for cell, first in corners)
            inside = x1 >= 0 and y1 >= 0 and x2 <= wide and y2 <= high
            if closer.window.within is None and 1 <= steps <= STEPS and (inside or look.level == 0):
                found[steps, x2 - x1].append((y1, x1, int((closer.found & ~seen).sum())))
        counts = {key: torch.tensor(rows).unbind(-1) for key, rows in found.items()}
        return cls(look, {key: (rows, columns, new) for key, (rows, columns, new) in counts.items()})

    def loss(self, survey: Survey, logs: Tensor) -> Tensor:
        """Mean Poisson negative log likelihood of the numbers, up to a constant.

        Args:
            survey: predicts them.
            logs: `(3, rows, columns)`, its predictions for the cells of the gist.

        Returns:
            The mean over the windows, a scalar.
        """
        rates = logs.exp()
        terms = []
        for (steps, span), (rows, columns, new) in self.counts.items():
            weight = survey.taper(span)
            # Windows of an overview may reach beyond the picture.
            low, left = min(int(rows.min()), 0), min(int(columns.min()), 0)
            high, right = (
                max(int(n.max()) + span - size, 0) for n, size in zip((rows, columns), rates.shape[1:], strict=True)
            )
            cells = F.pad(rates[None, steps - 1], (-left, right, -low, high))
            sums = F.conv2d(F.conv2d(cells[None], weight[None, None, None]), weight[None, None, :, None])[0, 0]
            expected = sums[rows - low, columns - left]
            terms.append(expected - new * expected.clamp(min=1e-6).log())
        return torch.cat(terms).mean() if terms else logs.sum() * 0


@dataclass(frozen=True)
class SurveyExample:
    """A mosaic: its overview and its closer looks, each with what looks inside it found.

    Attributes:
        overview: the first look.
        closer: looks that were closer, and can be followed by closer ones.
    """

    overview: CountedLook
    closer: tuple[CountedLook, ...]

    @classmethod
    def of(cls, example: ZoomExample) -> "SurveyExample":
        """Prepare a mosaic for the fit."""
        overview, *others = (look for look in example.looks if look.gist is not None)
        first = overview.found
        closer = (CountedLook.of(example, look, first | look.found) for look in others)
        return cls(CountedLook.of(example, overview, first), tuple(closer))

    def losses(self, survey: Survey, closer: Sequence[CountedLook]) -> list[Tensor]:
        """Losses of the overview and of closer looks, whose predictions build on those of the overview."""
        logs = survey.rates(self.overview.gist)[0]
        found = [self.overview.loss(survey, logs)]
        cells = _spread(self.overview.gist, logs.detach())
        for counted in closer:
            look = counted.gist
            rows, columns = (n * look.scale for n in look.scores.shape[:2])
            part = cells[:, look.first[1] : look.first[1] + rows, look.first[0] : look.first[0] + columns]
            before = before_of(part, torch.zeros(part.shape[1:], dtype=torch.long), look)
            found.append(counted.loss(survey, survey.rates(look, before=before[None])[0]))
        return found


def _spread(look: Gist, logs: Tensor) -> Tensor:
    """Rates in the cells of the lattice, `(3, rows, columns)`."""
    cells = logs.exp() / look.scale**2
    return cells.repeat_interleave(look.scale, -1).repeat_interleave(look.scale, -2)


def fit_survey(survey: Survey, examples: Sequence[SurveyExample], steps: int, batch: int = 4) -> None:
    """Fit the numbers of new objects that closer looks find, by maximum Poisson likelihood.

    Args:
        survey: to fit.
        examples: mosaics.
        steps: of the fit.
        batch: mosaics in each step.
    """
    optimizer = torch.optim.AdamW(survey.parameters(), lr=6e-3, weight_decay=0.1)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 6e-3, total_steps=steps)
    for step in range(steps):
        losses = []
        for example in random.sample(examples, min(batch, len(examples))):
            closer = random.sample(example.closer, min(LATER, len(example.closer)))
            losses.append(torch.stack(example.losses(survey, closer)).mean())
        loss = torch.stack(losses).mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(survey.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        if step % 100 == 99:
            _log.info("survey: step %d, loss %.4f", step + 1, float(loss.detach()))


@torch.no_grad()
def judge_survey(survey: Survey, examples: Sequence[SurveyExample]) -> dict[str, float]:
    """Mean loss on mosaics that were held out, by the overview and by closer looks."""
    first, later = [], []
    for example in examples:
        overview, *closer = example.losses(survey, example.closer)
        first.append(overview)
        later += closer
    figures = {"objects of any class, mean negative log likelihood, overview": float(torch.stack(first).mean())}
    if later:
        figures["objects of any class, mean negative log likelihood, closer looks"] = float(torch.stack(later).mean())
    return figures
