"""Fit models of how many objects, of one class or of any, looks at smaller windows find.

A picture is looked at in windows of all magnifications. Each look is paired with the smaller windows inside it, whose
results it should predict:

    overview ──────────────────┐ predicts ┌► window, one octave closer ─┐ predicts ┌► window, two octaves closer
    (its gist: scores by cell) ┘          └──── predicts, a step more ──┼──────────┘

A prediction by a look at a smaller window builds on that of the overview for the same window (`before`).
"""

import random
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.scene import Scenes
from semfov.detection.objects import SCORE_THRESHOLD
from semfov.fit.training import descend
from semfov.observation.matching import box_iou
from semfov.zoom.belief import Rates, before_of
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.hints import DETECTION_SCORE, Gist
from semfov.zoom.looks import Window, WindowLooks, half_steps
from semfov.zoom.survey import STEPS, Survey

_SHOWN_CLASSES = 8  # largest number of classes of a mosaic, shown clearly, whose rates are fitted in one step
_HINTED_CLASSES = 4  # and that of classes that are only hinted at
_HINT = 0.02  # score from which on a class is hinted at
_CLOSER_LOOKS = 2
"""Looks at smaller windows of a mosaic, beside its overview, whose predictions are fitted in one step."""
_LEAST_RATE = 1e-6  # keeps logarithms of expected numbers finite

ANY_CLASS = torch.tensor([0])
"""The target for objects of any class, as in a `ZoomBelief`; classes are 1..K."""


class WindowResult(NamedTuple):
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


class _WindowCounts(NamedTuple):
    """Numbers of new objects that n looks at smaller windows of one size found.

    Attributes:
        rows: `(n,)`, first row of the outer look's cells that they show.
        columns: `(n,)`, first column.
        new: `(n, K+1)`, numbers of objects that no earlier look had found: of any class first, then by class.
    """

    rows: Tensor
    columns: Tensor
    new: Tensor


def _is_predicted(look: Gist, window: Window) -> bool:
    """Tell whether a look predicts another one: a look at a smaller window inside it, or any after an overview."""
    if look.level == 0:
        return True
    rows, columns = look.scores.shape[:2]
    left, top = look.first
    x1, y1, x2, y2 = window.cells  # of the lattice
    is_within_columns = x1 >= left and x2 <= left + columns * look.scale
    is_within_rows = y1 >= top and y2 <= top + rows * look.scale
    return is_within_columns and is_within_rows


def _cells_shown(look: Gist, window: Window) -> tuple[int, int, int]:
    """Find the first row and column of a look's cells that a closer window shows, and their number along a side."""
    left, top = look.first
    x1, y1, x2, _ = window.cells
    row = (y1 - top) // look.scale
    column = (x1 - left) // look.scale
    # Cells that the window shows in part count.
    after = -(-(x2 - left) // look.scale)
    return row, column, after - column


class LookCounts(NamedTuple):
    """A look, and how many new objects each look at a smaller window inside it found.

    Attributes:
        gist: the look.
        counts: numbers by octaves and by the side of the closer looks, in cells.
    """

    gist: Gist
    counts: dict[tuple[int, int], _WindowCounts]

    @classmethod
    def of(cls, look: Gist, results: Iterable[WindowResult], classes: Tensor, earlier: Tensor) -> "LookCounts":
        """Count what looks at smaller windows inside a look find; an overview predicts all.

        Args:
            look: the look.
            results: looks at the picture.
            classes: `(M, K+1)`, 1 for the class of each object, and in the first column for any.
            earlier: `(M,)` boolean, the objects that were found before.

        Returns:
            The look with the numbers.
        """
        by_size: dict[tuple[int, int], list[tuple[int, int, Tensor]]] = defaultdict(list)
        for closer in results:
            steps = closer.window.level - look.level
            if 1 <= steps <= STEPS and _is_predicted(look, closer.window):
                row, column, span = _cells_shown(look, closer.window)
                by_size[steps, span].append((row, column, closer.found & ~earlier))
        counts = {}
        for size, windows in by_size.items():
            first_rows, first_columns, found = zip(*windows, strict=True)
            new = torch.stack(found).to(classes) @ classes
            counts[size] = _WindowCounts(torch.tensor(first_rows), torch.tensor(first_columns), new)
        return cls(look, counts)

    def loss(self, model: Rates, log_rates: Tensor, targets: Tensor) -> Tensor:
        """Average the Poisson negative log likelihood of the numbers over classes and windows, up to a constant.

        Args:
            model: weighs the cells of windows.
            log_rates: `(T, 3, rows, columns)`, of each target.
            targets: `(T,)`, classes 1..K, or `ANY_CLASS`.

        Returns:
            A scalar.
        """
        rates = log_rates.exp()
        terms = []
        for (steps, span), counts in self.counts.items():
            expected = _expected_in_windows(rates[:, steps - 1], model.taper(span), counts.rows, counts.columns)
            new = counts.new[:, targets].mT
            terms.append((expected - new * expected.clamp(min=_LEAST_RATE).log()).flatten())
        # Also without windows inside it a look has a loss from which a step of training can go back.
        return torch.cat(terms).mean() if terms else log_rates.sum() * 0


def _expected_in_windows(rates: Tensor, weight: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Sum rates over square windows, weighted towards their middle.

    Args:
        rates: `(T, height, width)`, rates of each cell.
        weight: `(span,)`, weights along a side of a window.
        rows: `(n,)`, first row of each window.
        columns: `(n,)`, first column.

    Returns:
        The sums, `(T, n)`.
    """
    height, width = rates.shape[1:]
    span = len(weight)
    # Windows of an overview may reach beyond the picture, where nothing is expected.
    above = max(-int(rows.min()), 0)
    before = max(-int(columns.min()), 0)
    below = max(int(rows.max()) + span - height, 0)
    after = max(int(columns.max()) + span - width, 0)
    cells = F.pad(rates[:, None], (before, after, above, below))
    sums = F.conv2d(F.conv2d(cells, weight[None, None, None]), weight[None, None, :, None])[:, 0]
    return sums[:, rows + above, columns + before]


def _rates_before(first: Gist, log_rates: Tensor, look: Gist) -> Tensor:
    """Read the rates of the overview `(T, 3, …)` in the cells of a closer look, for windows an octave closer."""
    # The rate of a cell of the overview spreads over the cells of the lattice in it.
    rates = log_rates.exp() / first.scale**2
    in_lattice = rates.repeat_interleave(first.scale, -1).repeat_interleave(first.scale, -2)
    left, top = look.first
    bottom = top + look.scores.shape[0] * look.scale
    right = left + look.scores.shape[1] * look.scale
    # The overview, of level 0, predicts windows of level 1 in its first step.
    step = min(look.level, STEPS - 1)
    shown = in_lattice[:, step, top:bottom, left:right]
    return torch.stack([before_of(of_target, look) for of_target in shown])


class ZoomExample(NamedTuple):
    """A picture: its overview and smaller windows, each with the numbers of new objects that looks inside it found.

    Attributes:
        overview: the look at the whole.
        closer: the closer looks that predict others.
        shown: classes 1..K that its looks show.
        hinted: classes that they only hint at.
    """

    overview: LookCounts
    closer: tuple[LookCounts, ...]
    shown: Tensor
    hinted: Tensor

    @classmethod
    def of(
        cls, pictures: Scenes, index: int, source: WindowLooks, score_threshold: float = SCORE_THRESHOLD
    ) -> "ZoomExample":
        """Look at windows at steps of half a window, and count the objects that a detection of their class shows.

        Args:
            pictures: the pictures.
            index: number of the picture.
            source: looks at it.
            score_threshold: score from which on a look shows a class.

        Returns:
            The example.
        """
        annotation = pictures.annotation(index)
        results = []
        for look in source.see([*half_steps(source.lattice)]):
            detections = look.detections
            is_sure = detections.scores[0, :, 1:].amax(-1) >= DETECTION_SCORE
            boxes = detections.boxes[0, is_sure]
            labels = detections.labels[0, is_sure]
            hits = (box_iou(boxes, annotation.boxes) >= 0.5) & (labels[:, None] == annotation.labels)
            results.append(WindowResult(look.window, look.gist, look.show, hits.any(0)))
        return cls.of_results(annotation.labels, results, score_threshold)

    @classmethod
    def of_results(
        cls, labels: Tensor, results: Sequence[WindowResult], score_threshold: float = SCORE_THRESHOLD
    ) -> "ZoomExample":
        """Pair looks at a picture with those inside them.

        Args:
            labels: `(M,)`, classes of its objects, 1..K.
            results: the looks, the overview first.
            score_threshold: score from which on a look shows a class.

        Returns:
            The example.
        """
        highest = torch.stack([result.show for result in results]).amax(0)  # (K,), in any look
        is_shown = highest >= score_threshold
        is_hinted = (highest >= _HINT) & ~is_shown
        classes = F.one_hot(labels, len(highest) + 1).float()
        classes[:, 0] = 1  # of any class
        in_overview = results[0].found
        overview, *closer = [
            LookCounts.of(result.gist, results, classes, in_overview | result.found)
            for result in results
            if result.gist is not None
        ]
        return cls(overview, tuple(closer), is_shown.nonzero()[:, 0] + 1, is_hinted.nonzero()[:, 0] + 1)

    def drawn_targets(self) -> Tensor:
        """Draw classes, 1..K: some that its looks show, and some that they only hint at; at least one."""
        targets = torch.cat([_drawn(self.shown, _SHOWN_CLASSES), _drawn(self.hinted, _HINTED_CLASSES)])
        classes = self.overview.gist.scores.shape[-1]
        return targets if len(targets) else _drawn(torch.arange(classes) + 1, 1)

    def losses(self, model: Rates, targets: Tensor, closer: Sequence[LookCounts]) -> list[Tensor]:
        """Compute the losses of the overview and of closer looks, whose predictions build on those of the overview.

        Args:
            model: predicts the numbers of objects.
            targets: `(T,)`, classes 1..K, or `ANY_CLASS`.
            closer: closer looks of the picture.

        Returns:
            Scalars.
        """
        overview = self.overview.gist
        log_rates = model.rates(overview, targets)
        losses = [self.overview.loss(model, log_rates, targets)]
        for look in closer:
            before = _rates_before(overview, log_rates.detach(), look.gist)
            losses.append(look.loss(model, model.rates(look.gist, targets, before), targets))
        return losses

    def loss(self, model: Rates, targets: Tensor) -> Tensor:
        """Average the losses of the overview and of a few looks at smaller windows, drawn at random."""
        closer = random.sample(self.closer, min(_CLOSER_LOOKS, len(self.closer)))
        return torch.stack(self.losses(model, targets, closer)).mean()


def _drawn(values: Tensor, most: int) -> Tensor:
    """Draw at most so many of the values."""
    return values[torch.randperm(len(values))[:most]]


def fit_rates(model: GlimpseEvidence, examples: Sequence[ZoomExample], steps: int, batch: int = 4) -> None:
    """Fit the expected number of objects of a class that smaller windows show, by its Poisson likelihood.

    Args:
        model: evidence by magnification.
        examples: pictures with looks at many windows.
        steps: number of training steps.
        batch: number of pictures in a step.
    """
    parameters = [*model.rate.parameters(), model.prior, model.border]
    loss_of = _loss_of_batch(model, examples, batch, ZoomExample.drawn_targets)
    descend(parameters, loss_of, steps, 6e-3, decay=0.1, title="learning the expected number of objects")


def fit_survey(survey: Survey, examples: Sequence[ZoomExample], steps: int, batch: int = 8) -> None:
    """Fit the expected number of objects of any class that smaller windows show, by its Poisson likelihood.

    Args:
        survey: predicts the numbers of objects of any class.
        examples: pictures with looks at many windows.
        steps: number of training steps.
        batch: number of pictures in a step.
    """
    loss_of = _loss_of_batch(survey, examples, batch, lambda _: ANY_CLASS)
    descend(survey.parameters(), loss_of, steps, 2e-3, decay=0.1, title="learning the survey")


def _loss_of_batch(
    model: Rates, examples: Sequence[ZoomExample], batch: int, targets_of: Callable[[ZoomExample], Tensor]
) -> Callable[[int], Tensor]:
    """Make the loss of a training step, a mean over pictures drawn at random."""

    def loss_of(_: int) -> Tensor:
        chosen = random.sample(examples, min(batch, len(examples)))
        return torch.stack([example.loss(model, targets_of(example)) for example in chosen]).mean()

    return loss_of


@torch.no_grad()
def judge_windows(model: GlimpseEvidence, examples: Sequence[ZoomExample]) -> dict[str, float]:
    """Evaluate the expected number of objects of a class that smaller windows show, on held-out pictures.

    Args:
        model: evidence by magnification.
        examples: mosaics of held-out photographs with looks at many windows.

    Returns:
        The measures by name.
    """
    losses = torch.stack([example.loss(model, example.drawn_targets()) for example in examples])
    return {"objects of a class, mean negative log likelihood": float(losses.mean())}
