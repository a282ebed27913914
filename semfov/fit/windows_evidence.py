"""Fit evidence by magnification: what closer looks will show, and how many objects, of a class or of any, they find."""

import json
import random
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.mosaics import Mosaics
from semfov.data.scene import Scenes
from semfov.detection.objects import LEAST
from semfov.fit.training import descend
from semfov.observation.matching import box_iou
from semfov.runs.tables import table
from semfov.zoom.belief import before_of
from semfov.zoom.evidence import STEPS, GlimpseEvidence, Survey, pool
from semfov.zoom.hints import DETECTION_SCORE, Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLooks, half_steps


class _WindowResult(NamedTuple):
    """A look at a window and its results; show `(K,)`, found `(M,)`."""

    window: Window
    gist: Gist | None
    show: Tensor
    found: Tensor


class ZoomExample(NamedTuple):
    """A mosaic with looks at many windows; a look shows a class with a score of `least`; labels `(M,)`."""

    lattice: Lattice
    labels: Tensor
    looks: tuple[_WindowResult, ...]
    least: float = LEAST

    @staticmethod
    def windows(pictures: Scenes, index: int, lattice: Lattice) -> list[Window]:
        """List the windows of a picture at steps of half a window, and one for each photograph of a mosaic."""
        tiles = pictures.tiles(index) if isinstance(pictures, Mosaics) else []
        slots: Any = [tuple(map(float, tile.slot)) for tile in tiles]
        return [*half_steps(lattice), *(Window.around(lattice, slot) for slot in slots)]

    @classmethod
    def of(cls, pictures: Scenes, index: int, source: WindowLooks, least: float = LEAST) -> "ZoomExample":
        """Look at all windows of a picture, and collect which objects are shown with a detection of their class."""
        annotation, looks = pictures.annotation(index), []
        for look in source.see(cls.windows(pictures, index, source.lattice)):
            detections = look.detections
            sure = detections.scores[0, :, 1:].amax(-1) >= DETECTION_SCORE
            boxes, labels = detections.boxes[0, sure], detections.labels[0, sure]
            hits = (box_iou(boxes, annotation.boxes) >= 0.5) & (labels[:, None] == annotation.labels)
            looks.append(_WindowResult(look.window, look.gist, look.show, hits.any(0)))
        return cls(source.lattice, annotation.labels, tuple(looks), least)


_Cells = tuple[int, int, int, int]  # first column and row, and those after the last


def _closer_windows(example: ZoomExample, look: Gist) -> Iterator[tuple[int, _WindowResult, int, _Cells]]:
    """The closer looks inside a look, by number, as far as it predicts them (an overview all), and the cells shown."""
    high, wide = (n * look.scale for n in look.scores.shape[:2])
    for place, closer in enumerate(example.looks):
        steps = closer.window.level - look.level
        x1, y1, x2, y2 = (cell - first for cell, first in zip(closer.window.cells, look.first * 2, strict=True))
        inside = x1 >= 0 and y1 >= 0 and x2 <= wide and y2 <= high
        if 1 <= steps <= STEPS and (inside or look.level == 0):
            yield place, closer, steps, (x1 // look.scale, y1 // look.scale, -(-x2 // look.scale), -(-y2 // look.scale))


class Windows(NamedTuple):
    """Pairs of a look and a closer window inside it; scores and presence `(N, K)`, summary `(N, 3)`, others `(N,)`."""

    scores: Tensor
    summary: Tensor
    steps: Tensor
    presence: Tensor
    before: Tensor
    slot: Tensor
    mosaic: Tensor


def pair_windows(examples: list[ZoomExample]) -> Windows:
    """Pair every look with every closer window inside it."""
    rows: list[tuple[Tensor, Tensor, int, Tensor, int, bool, int]] = []
    for number, example in enumerate(examples):
        first: dict[int, int] = {}
        for look in (each.gist for each in example.looks if each.gist is not None):
            for place, closer, steps, box in _closer_windows(example, look):
                pooled, summary = pool(look.scores, box)
                before = -1 if look.level == 0 else first.get(place, -1)
                if look.level == 0:
                    first[place] = len(rows)
                elif before < 0:
                    continue
                slot = closer.window.within is not None
                rows.append((pooled, summary, steps, closer.show >= example.least, before, slot, number))
    columns: list[Any] = [*zip(*rows, strict=True)]
    whole = [torch.tensor(columns[place]) for place in (2, 4, 5, 6)]
    return Windows(torch.stack(columns[0]), torch.stack(columns[1]), whole[0], torch.stack(columns[3]), *whole[1:])


def fit_presence(model: GlimpseEvidence, windows: Windows, steps: int, batch: int = 1024, rate: float = 8e-3) -> None:
    """Fit the probability that a closer look shows a class, by the mean cross-entropy over windows and classes."""
    own = [model.slope, model.offset, *model.company.parameters(), *model.shape.parameters()]
    first, later = (windows.before < 0).nonzero()[:, 0], (windows.before >= 0).nonzero()[:, 0]

    def loss_of(_: int) -> Tensor:
        loss = presence_loss(model, windows, first[torch.randint(len(first), (batch,))])
        if len(later):
            loss = loss + presence_loss(model, windows, later[torch.randint(len(later), (batch // 2,))])
        return loss

    model.train()
    descend(own, loss_of, steps, rate, clip=None, decay=1.0, title="learning what closer looks show")
    model.eval()


def presence_loss(model: GlimpseEvidence, windows: Windows, rows: Tensor) -> Tensor:
    """Compute the mean cross-entropy of `_presence_log_odds` over rows and classes."""
    odds = _presence_log_odds(model, windows, rows)
    return F.binary_cross_entropy_with_logits(odds, windows.presence[rows].to(odds))


def _presence_log_odds(model: GlimpseEvidence, windows: Windows, rows: Tensor) -> Tensor:
    """Compute the log-odds that closer looks show each class."""
    before = None
    if bool((windows.before[rows] >= 0).all()):
        training = model.training
        model.eval()
        with torch.no_grad():
            before = _presence_log_odds(model, windows, windows.before[rows])
        model.train(training)
    return model.presence(windows.scores[rows], windows.summary[rows], windows.steps[rows], None, before)


def fit_rates(model: GlimpseEvidence, examples: list[ZoomExample], steps: int, batch: int = 4) -> None:
    """Fit the expected number of objects that closer looks find, by its Poisson likelihood in every window."""

    def loss_of(_: int) -> Tensor:
        chosen = random.sample(examples, min(batch, len(examples)))
        return torch.stack([_rate_loss(model, example) for example in chosen]).mean()

    own = [*model.rate.parameters(), model.prior, model.border]
    descend(own, loss_of, steps, 6e-3, decay=0.1, title="learning the expected number of objects")


def _rate_loss(model: GlimpseEvidence, example: ZoomExample) -> Tensor:
    """Compute the negative log likelihood of the numbers of objects found in the windows of a mosaic."""
    strongest = torch.stack([look.show for look in example.looks]).amax(0)
    sure = strongest >= example.least
    kinds = ((sure, 8), ((strongest >= 0.02) & ~sure, 4))
    targets = torch.cat([_some(kind.nonzero()[:, 0] + 1, most) for kind, most in kinds])
    if not len(targets):
        targets = _some(torch.arange(len(strongest)) + 1, 1)
    looks = [look for look in example.looks if look.gist is not None]
    overview, *others = looks
    assert overview.gist is not None
    logs = model.rates(overview.gist, targets)
    losses = [_likelihood_loss(model, example, overview.gist, logs, targets, overview.found)]
    for closer in random.sample(others, min(2, len(others))):
        assert closer.gist is not None
        before = _rates_before(overview.gist, logs.detach(), closer.gist)
        earlier = overview.found | closer.found
        closer_logs = model.rates(closer.gist, targets, before)
        losses.append(_likelihood_loss(model, example, closer.gist, closer_logs, targets, earlier))
    return torch.stack(losses).mean()


def _some(values: Tensor, most: int) -> Tensor:
    return values[torch.randperm(len(values))[:most]]


def _rates_before(first: Gist, logs: Tensor, look: Gist) -> Tensor:
    """Rates of the overview `(T, 3, …)` in the cells of a closer look, for windows an octave closer, `(T, …)`."""
    cells = (logs.exp() / first.scale**2).repeat_interleave(first.scale, -1).repeat_interleave(first.scale, -2)
    rows, columns = (n * look.scale for n in look.scores.shape[:2])
    part = cells[..., look.first[1] : look.first[1] + rows, look.first[0] : look.first[0] + columns]
    return torch.stack([before_of(one.numpy(), look) for one in part[:, min(look.level, STEPS - 1)]])


def _likelihood_loss(
    model: GlimpseEvidence, example: ZoomExample, look: Gist, logs: Tensor, targets: Tensor, earlier: Tensor
) -> Tensor:
    """Compute the mean negative log likelihood over the closer windows inside a look."""
    rates = logs.exp()
    terms = []
    for _, closer, steps, (x1, y1, x2, y2) in _closer_windows(example, look):
        if closer.window.within is not None:  # only windows of the lattice
            continue
        weight = model.taper(x2 - x1)
        part = rates[:, steps - 1, max(y1, 0) : y2, max(x1, 0) : x2]
        expected = torch.einsum("tyx,y,x->t", part, weight[: part.shape[1]], weight[: part.shape[2]])
        new = example.labels[closer.found & ~earlier]
        count = (new == targets[:, None]).sum(-1)
        terms.append((expected - count * expected.clamp(min=1e-6).log()).mean())
    return torch.stack(terms).mean() if terms else logs.sum() * 0


class _LookCounts(NamedTuple):
    """A look, and how many new objects each of the closer looks inside it found; counts `(N,)`."""

    gist: Gist
    counts: dict[tuple[int, int], tuple[Tensor, Tensor, Tensor]]

    @classmethod
    def of(cls, example: ZoomExample, looked: _WindowResult, earlier: Tensor) -> "_LookCounts":
        """Compare a look with all closer looks inside it; earlier `(M,)`."""
        by_size = defaultdict(list)
        assert looked.gist is not None
        for _, closer, steps, (x1, y1, x2, _) in _closer_windows(example, looked.gist):
            if closer.window.within is None:
                by_size[steps, x2 - x1].append((y1, x1, int((closer.found & ~earlier).sum())))
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
            before = _rates_before(first, logs.detach(), counted.gist)
            losses.append(counted.loss(survey, survey.rates(counted.gist, before=before)[0]))
        return losses


_LATER = 2  # closer looks of a mosaic, beside its overview, whose predictions are fitted in one step


def fit_survey(survey: Survey, examples: Sequence[SurveyExample], steps: int, batch: int = 8) -> None:
    """Fit the numbers of new objects that closer looks find, by maximum Poisson likelihood."""

    def loss_of(_: int) -> Tensor:
        losses = []
        for example in random.sample(examples, min(batch, len(examples))):
            closer = random.sample(example.closer, min(_LATER, len(example.closer)))
            losses.append(torch.stack(example.losses(survey, closer)).mean())
        return torch.stack(losses).mean()

    descend(survey.parameters(), loss_of, steps, 2e-3, decay=0.1, title="learning the survey")


@torch.no_grad()
def judge_windows(model: GlimpseEvidence, examples: list[ZoomExample]) -> tuple[str, str]:
    windows = pair_windows(examples)
    first, later = (windows.before < 0).nonzero()[:, 0], (windows.before >= 0).nonzero()[:, 0]
    figures: dict[str, float] = {"cross-entropy, overview": float(presence_loss(model, windows, first))}
    if len(later):
        figures["cross-entropy, closer looks"] = float(presence_loss(model, windows, later))
        figures["the same windows by the overview"] = float(presence_loss(model, windows, windows.before[later]))
    slots = first[windows.slot[first]]
    odds, presence = _presence_log_odds(model, windows, slots), windows.presence[slots]
    passes: dict[str, list[int]] = defaultdict(list)
    for mosaic in windows.mosaic[slots].unique():
        here = windows.mosaic[slots] == mosaic
        for target in presence[here].any(0).nonzero()[:, 0].tolist():
            hits = presence[here, target]
            for name, value in (("evidence", odds), ("raw score", windows.scores[slots])):
                order = value[here, target].argsort(descending=True, stable=True)
                passes[name].append(2 + int(hits[order].int().argmax()))
    for name, counts in passes.items():
        figures[f"passes to the first hit, {name}"] = sum(counts) / len(counts)
    losses = torch.stack([_rate_loss(model, example) for example in examples])
    figures["rates, mean negative log likelihood"] = float(losses.mean())
    lines = [f"Evaluation on {len(examples)} mosaics of held-out photographs:", ""]
    rows = [["measure", "value"], *([name, f"{value:.4f}"] for name, value in figures.items())]
    lines += [*table(rows), ""]
    return "\n".join(lines), json.dumps(figures, indent=1)
