"""Fit evidence by magnification: how many objects, of a class or of any, closer looks find.

A picture is looked at in windows of all magnifications. Each look is paired with the closer windows inside it, whose
results it should predict:

    overview ──────────────────┐ predicts ┌► window, one octave closer ─┐ predicts ┌► window, two octaves closer
    (its gist: scores by cell) ┘          └──── predicts, a step more ──┼──────────┘

A prediction by a closer look builds on that of the overview for the same window (`before`).
"""

import json
import random
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.scene import Scenes
from semfov.detection.objects import SCORE_THRESHOLD
from semfov.fit.training import descend
from semfov.observation.matching import box_iou
from semfov.runs.tables import table
from semfov.zoom.belief import before_of
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.hints import DETECTION_SCORE, Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLooks, half_steps
from semfov.zoom.survey import STEPS, Survey

_SHOWN_CLASSES = 8  # largest number of classes of a mosaic, shown clearly, whose rates are fitted in one step
_HINTED_CLASSES = 4  # and that of classes that are only hinted at
_HINT = 0.02  # score from which on a class is hinted at
_CLOSER_LOOKS = 2
"""Closer looks of a mosaic, beside its overview, whose predictions are fitted in one step."""
_LEAST_RATE = 1e-6  # keeps logarithms of expected numbers finite


class _WindowResult(NamedTuple):
    """A look at a window of a picture with M objects.

    Attributes:
        window: the window.
        gist: what the look hints at in its cells; None for the closest looks.
        show: `(K,)`, highest score of each class.
        found: `(M,)` boolean, the objects that a detection of their class shows.
    """

    window: Window
    gist: Gist | None
    show: Tensor
    found: Tensor


class ZoomExample(NamedTuple):
    """A picture with looks at many windows.

    Attributes:
        lattice: the lattice of its windows.
        labels: `(M,)`, classes of its objects.
        looks: the looks; the overview is the first with a gist.
        score_threshold: score from which on a look shows a class.
    """

    lattice: Lattice
    labels: Tensor
    looks: tuple[_WindowResult, ...]
    score_threshold: float = SCORE_THRESHOLD

    @classmethod
    def of(
        cls, pictures: Scenes, index: int, source: WindowLooks, score_threshold: float = SCORE_THRESHOLD
    ) -> "ZoomExample":
        """Look at windows at steps of half a window, and collect which objects a detection of their class shows."""
        annotation = pictures.annotation(index)
        looks = []
        for look in source.see([*half_steps(source.lattice)]):
            detections = look.detections
            is_sure = detections.scores[0, :, 1:].amax(-1) >= DETECTION_SCORE
            boxes = detections.boxes[0, is_sure]
            labels = detections.labels[0, is_sure]
            hits = (box_iou(boxes, annotation.boxes) >= 0.5) & (labels[:, None] == annotation.labels)
            looks.append(_WindowResult(look.window, look.gist, look.show, hits.any(0)))
        return cls(source.lattice, annotation.labels, tuple(looks), score_threshold)

    @property
    def predicting(self) -> list[_WindowResult]:
        """The looks that predict closer ones, the overview first."""
        return [look for look in self.looks if look.gist is not None]


class _CloserWindow(NamedTuple):
    """A closer look inside a look.

    Attributes:
        result: the look.
        steps: octaves by which it is closer.
        cells: first column and row of the outer look's cells that it shows, and those after the last.
    """

    result: _WindowResult
    steps: int
    cells: tuple[int, int, int, int]


def _closer_windows(example: ZoomExample, look: Gist) -> Iterator[_CloserWindow]:
    """Find the closer looks inside a look, as far as it predicts them; an overview predicts all."""
    rows, columns = look.scores.shape[:2]
    height = rows * look.scale
    width = columns * look.scale
    left, top = look.first
    for result in example.looks:
        steps = result.window.level - look.level
        # In cells of the lattice, from the corner of the look.
        x1, y1, x2, y2 = result.window.cells
        from_left = x1 - left
        from_top = y1 - top
        to_right = x2 - left
        to_bottom = y2 - top
        is_inside = from_left >= 0 and from_top >= 0 and to_right <= width and to_bottom <= height
        if 1 <= steps <= STEPS and (is_inside or look.level == 0):
            # Cells that a window shows in part count.
            first = (from_left // look.scale, from_top // look.scale)
            last = (-(-to_right // look.scale), -(-to_bottom // look.scale))
            yield _CloserWindow(result, steps, (*first, *last))


def fit_rates(model: GlimpseEvidence, examples: Sequence[ZoomExample], steps: int, batch: int = 4) -> None:
    """Fit the expected number of objects that closer looks find, by its Poisson likelihood in every window.

    Args:
        model: evidence by magnification.
        examples: pictures with looks at many windows.
        steps: number of training steps.
        batch: number of pictures in a step.
    """

    def loss_of(_: int) -> Tensor:
        chosen = random.sample(examples, min(batch, len(examples)))
        return torch.stack([_rate_loss(model, example) for example in chosen]).mean()

    parameters = [*model.rate.parameters(), model.prior, model.border]
    descend(parameters, loss_of, steps, 6e-3, decay=0.1, title="learning the expected number of objects")


def _rate_loss(model: GlimpseEvidence, example: ZoomExample) -> Tensor:
    """Compute the negative log likelihood of the numbers of objects found in the windows of a picture."""
    targets = _drawn_targets(example)
    overview, *others = example.predicting
    assert overview.gist is not None
    log_rates = model.rates(overview.gist, targets)
    losses = [_likelihood_loss(model, example, overview.gist, log_rates, targets, overview.found)]
    for closer in random.sample(others, min(_CLOSER_LOOKS, len(others))):
        assert closer.gist is not None
        before = _rates_before(overview.gist, log_rates.detach(), closer.gist)
        closer_log_rates = model.rates(closer.gist, targets, before)
        earlier = overview.found | closer.found
        losses.append(_likelihood_loss(model, example, closer.gist, closer_log_rates, targets, earlier))
    return torch.stack(losses).mean()


def _drawn_targets(example: ZoomExample) -> Tensor:
    """Draw classes of a picture, 1..K: some that its looks show, and some that they only hint at; at least one."""
    strongest = torch.stack([look.show for look in example.looks]).amax(0)
    is_shown = strongest >= example.score_threshold
    is_hinted = (strongest >= _HINT) & ~is_shown
    targets = torch.cat(
        [
            _drawn(is_shown.nonzero()[:, 0] + 1, _SHOWN_CLASSES),
            _drawn(is_hinted.nonzero()[:, 0] + 1, _HINTED_CLASSES),
        ]
    )
    return targets if len(targets) else _drawn(torch.arange(len(strongest)) + 1, 1)


def _drawn(values: Tensor, most: int) -> Tensor:
    """Draw at most so many of the values."""
    return values[torch.randperm(len(values))[:most]]


def _rates_before(first: Gist, log_rates: Tensor, look: Gist) -> Tensor:
    """Read the rates of the overview `(T, 3, …)` in the cells of a closer look, for windows an octave closer."""
    # The rate of a cell of the overview spreads over the cells of the lattice in it.
    rates = log_rates.exp() / first.scale**2
    cells = rates.repeat_interleave(first.scale, -1).repeat_interleave(first.scale, -2)
    rows, columns = (count * look.scale for count in look.scores.shape[:2])
    left, top = look.first
    shown = cells[..., top : top + rows, left : left + columns]
    return torch.stack([before_of(of_target.numpy(), look) for of_target in shown[:, min(look.level, STEPS - 1)]])


def _likelihood_loss(
    model: GlimpseEvidence, example: ZoomExample, look: Gist, log_rates: Tensor, targets: Tensor, earlier: Tensor
) -> Tensor:
    """Compute the mean negative log likelihood over the closer windows inside a look.

    Shapes: log_rates `(T, 3, rows, columns)`, targets `(T,)`, earlier `(M,)`: the objects that were found before.
    """
    rates = log_rates.exp()
    terms = []
    for closer in _closer_windows(example, look):
        x1, y1, x2, y2 = closer.cells
        weight = model.taper(x2 - x1)
        inside = rates[:, closer.steps - 1, max(y1, 0) : y2, max(x1, 0) : x2]
        expected = torch.einsum("tyx,y,x->t", inside, weight[: inside.shape[1]], weight[: inside.shape[2]])
        new = example.labels[closer.result.found & ~earlier]
        count = (new == targets[:, None]).sum(-1)
        terms.append(_poisson_loss(expected, count).mean())
    return torch.stack(terms).mean() if terms else log_rates.sum() * 0


def _poisson_loss(expected: Tensor, count: Tensor) -> Tensor:
    """Compute the negative log likelihood of counts by their expected numbers, up to a constant."""
    return expected - count * expected.clamp(min=_LEAST_RATE).log()


class _Counts(NamedTuple):
    """Numbers of new objects that n closer looks of one size found, each `(n,)`.

    Attributes:
        rows: first row of the outer look's cells that they show.
        columns: first column.
        new: numbers of objects that no earlier look had found.
    """

    rows: Tensor
    columns: Tensor
    new: Tensor


class _LookCounts(NamedTuple):
    """A look, and how many new objects each of the closer looks inside it found.

    Attributes:
        gist: the look.
        counts: numbers by octaves and by the side of the closer looks, in cells.
    """

    gist: Gist
    counts: dict[tuple[int, int], _Counts]

    @classmethod
    def of(cls, example: ZoomExample, look: _WindowResult, earlier: Tensor) -> "_LookCounts":
        """Compare a look with all closer looks inside it; earlier `(M,)`, the objects that were found before."""
        assert look.gist is not None
        by_size: dict[tuple[int, int], list[tuple[int, int, int]]] = defaultdict(list)
        for closer in _closer_windows(example, look.gist):
            x1, y1, x2, _ = closer.cells
            new = int((closer.result.found & ~earlier).sum())
            by_size[closer.steps, x2 - x1].append((y1, x1, new))
        return cls(look.gist, {size: _Counts(*torch.tensor(rows).unbind(-1)) for size, rows in by_size.items()})

    def loss(self, survey: Survey, log_rates: Tensor) -> Tensor:
        """Average the Poisson negative log likelihood of the numbers; log_rates `(3, rows, columns)`."""
        rates = log_rates.exp()
        terms = []
        for (steps, span), counts in self.counts.items():
            expected = _expected_in_windows(rates[steps - 1], survey.taper(span), counts.rows, counts.columns)
            terms.append(_poisson_loss(expected, counts.new))
        return torch.cat(terms).mean() if terms else log_rates.sum() * 0


def _expected_in_windows(rates: Tensor, weight: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Sum rates over square windows, weighted towards their middle.

    Args:
        rates: `(height, width)`, rate of each cell.
        weight: `(span,)`, weights along a side of a window.
        rows: `(n,)`, first row of each window.
        columns: `(n,)`, first column.

    Returns:
        The sums, `(n,)`.
    """
    height, width = rates.shape
    span = len(weight)
    # Windows of an overview may reach beyond the picture, where nothing is expected.
    above = max(-int(rows.min()), 0)
    before = max(-int(columns.min()), 0)
    below = max(int(rows.max()) + span - height, 0)
    after = max(int(columns.max()) + span - width, 0)
    cells = F.pad(rates[None], (before, after, above, below))
    sums = F.conv2d(F.conv2d(cells[None], weight[None, None, None]), weight[None, None, :, None])[0, 0]
    return sums[rows + above, columns + before]


class SurveyExample(NamedTuple):
    """A picture: its overview and its closer looks, each with the numbers of new objects that looks inside it found."""

    overview: _LookCounts
    closer: tuple[_LookCounts, ...]

    @classmethod
    def of(cls, example: ZoomExample) -> "SurveyExample":
        """Prepare a picture for the fit."""
        overview, *others = example.predicting
        closer = (_LookCounts.of(example, look, overview.found | look.found) for look in others)
        return cls(_LookCounts.of(example, overview, overview.found), tuple(closer))

    def losses(self, survey: Survey, closer: Sequence[_LookCounts]) -> list[Tensor]:
        """Compute the losses of the overview and of closer looks, whose predictions build on those of the overview."""
        overview = self.overview.gist
        log_rates = survey.rates(overview)
        losses = [self.overview.loss(survey, log_rates[0])]
        for look in closer:
            before = _rates_before(overview, log_rates.detach(), look.gist)
            losses.append(look.loss(survey, survey.rates(look.gist, before=before)[0]))
        return losses


def fit_survey(survey: Survey, examples: Sequence[SurveyExample], steps: int, batch: int = 8) -> None:
    """Fit the numbers of new objects that closer looks find, by maximum Poisson likelihood.

    Args:
        survey: predicts the numbers of objects of any class.
        examples: pictures with the numbers of new objects that their looks found.
        steps: number of training steps.
        batch: number of pictures in a step.
    """

    def loss_of(_: int) -> Tensor:
        losses = []
        for example in random.sample(examples, min(batch, len(examples))):
            closer = random.sample(example.closer, min(_CLOSER_LOOKS, len(example.closer)))
            losses.append(torch.stack(example.losses(survey, closer)).mean())
        return torch.stack(losses).mean()

    descend(survey.parameters(), loss_of, steps, 2e-3, decay=0.1, title="learning the survey")


@torch.no_grad()
def judge_windows(model: GlimpseEvidence, examples: Sequence[ZoomExample]) -> tuple[str, str]:
    """Evaluate the expected number of objects of a class that closer looks find, on held-out pictures.

    Args:
        model: evidence by magnification.
        examples: mosaics of held-out photographs with looks at many windows.

    Returns:
        The report in Markdown, and its measures as JSON.
    """
    losses = torch.stack([_rate_loss(model, example) for example in examples])
    figures = {"objects of a class, mean negative log likelihood": float(losses.mean())}
    rows = [["measure", "value"], *([name, f"{value:.4f}"] for name, value in figures.items())]
    report = [f"Evaluation on {len(examples)} mosaics of held-out photographs:", "", *table(rows), ""]
    return "\n".join(report), json.dumps(figures, indent=1)
