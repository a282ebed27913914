"""Fit the survey: how many objects of any class closer looks find (`semfov.zoom.networks`)."""

import random
from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.fit.windows_evidence import WindowResult, ZoomExample, closer_windows, descend_examples, rates_before
from semfov.zoom.hints import Gist
from semfov.zoom.networks import Survey

_LATER = 2
"""Closer looks of a mosaic, beside its overview, whose predictions are fitted in one step."""


class _LookCounts(NamedTuple):
    """A look, and how many new objects each of the closer looks inside it found; counts `(N,)`."""

    gist: Gist
    counts: dict[tuple[int, int], tuple[Tensor, Tensor, Tensor]]

    @classmethod
    def of(cls, example: ZoomExample, looked: WindowResult, earlier: Tensor) -> "_LookCounts":
        """Compare a look with all closer looks inside it; earlier `(M,)`."""
        by_size = defaultdict(list)
        for closer, steps, (x1, y1, x2, _) in closer_windows(example, looked):
            by_size[steps, x2 - x1].append((y1, x1, int((closer.found & ~earlier).sum())))
        assert looked.gist is not None
        counts = {key: torch.tensor(rows).unbind(-1) for key, rows in by_size.items()}
        return cls(looked.gist, {key: (rows, columns, new) for key, (rows, columns, new) in counts.items()})

    def loss(self, survey: Survey, logs: Tensor) -> Tensor:
        """Mean Poisson negative log likelihood of the numbers, up to a constant; logs `(3, rows, columns)`."""
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


class SurveyExample(NamedTuple):
    """A mosaic: its overview and its closer looks, each with the numbers of new objects that looks inside it found."""

    overview: _LookCounts
    closer: tuple[_LookCounts, ...]

    @classmethod
    def of(cls, example: ZoomExample) -> "SurveyExample":
        """Prepare a mosaic for the fit."""
        overview, *others = (look for look in example.looks if look.gist is not None)
        first = overview.found
        closer = (_LookCounts.of(example, look, first | look.found) for look in others)
        return cls(_LookCounts.of(example, overview, first), tuple(closer))

    def losses(self, survey: Survey, closer: Sequence[_LookCounts]) -> list[Tensor]:
        """Losses of the overview and of closer looks, whose predictions build on those of the overview."""
        first = self.overview.gist
        logs = survey.rates(first)
        losses = [self.overview.loss(survey, logs[0])]
        for counted in closer:
            before = rates_before(first, logs.detach(), counted.gist)
            losses.append(counted.loss(survey, survey.rates(counted.gist, before=before)[0]))
        return losses


def fit_survey(survey: Survey, examples: Sequence[SurveyExample], steps: int, batch: int = 8) -> None:
    """Fit the numbers of new objects that closer looks find, by maximum Poisson likelihood."""

    def loss_of(example: SurveyExample) -> Tensor:
        closer = random.sample(example.closer, min(_LATER, len(example.closer)))
        return torch.stack(example.losses(survey, closer)).mean()

    descend_examples(survey.parameters(), loss_of, examples, steps, batch, "survey", rate=2e-3)


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
