"""Fit the probability that an object of a large picture is there, on explorations of pictures.

The looks of an exploration merge to objects. Of each the merge tells facts (`semfov.zoom.certainty.FACTS`), and the
annotation whether it is right:

    looks 1 … n ─► merged objects ─► facts ─► probability that an object is there ─┐
                                                                                    ├─► expected number, with a spread
    remaining, promised ─► objects that no look has shown ──────────────────────────┘
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from itertools import islice, product
from typing import NamedTuple, Self

import torch
from torch import Tensor

from semfov.data.scene import Annotation, Scenes
from semfov.fit.logistic import logistic_regression
from semfov.metrics.calibration import BinarySums
from semfov.observation.matching import right_boxes
from semfov.runs.progress import track
from semfov.runs.tables import table
from semfov.runs.zoom_store import StoredWindowLooks
from semfov.zoom import GlimpseEvidence, Lattice
from semfov.zoom.certainty import FACTS, SPREAD, Certainty, number_of, reacts
from semfov.zoom.episode import find_everything
from semfov.zoom.looks import WindowLook
from semfov.zoom.objects import merge_with_facts

_AFTER = (3, 6, 12, 24)  # numbers of looks after which objects are taken
_EXPECTING = (1, 2, 4, 8, 16, 24)  # numbers of looks after which the number of further objects is taken
_FURTHER = 2  # explorations are this many times as long as they may be for users, to see what further looks show

# Values of the numbers of `Certainty` that are tried for objects that no look has shown.
_SCALES = tuple(0.05 * 1.25**n for n in range(21))
_STRENGTHS = tuple(2.0**n for n in range(-2, 9))
_FAINT = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0)
_PROMISES = (0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)

_SPREADS = tuple(n / 20 for n in range(41))
_FEW = 40  # below this number of claims the spread is not less than that of a model for which none was fitted
_CHECKED = (8, 24)
"""Numbers of looks after which the expected number is compared with the annotated one, to fit its spread."""
_COVERED = 0.8  # share of the pictures in which the annotated number should be within two errors of the expected one

PicturesByKind = Mapping[str, tuple[Scenes, Sequence[StoredWindowLooks]]]
"""Pictures by the name of their kind, with the looks at each."""


class Exploration(NamedTuple):
    """An exploration of a picture, judged by its annotation.

    Attributes:
        target: class that it looks for; None for all classes.
        held: number of objects of the target in the picture, without crowds.
        objects: after some numbers of looks, facts about the objects `(n, 14)`, and whether they are right `(n,)`: 1,
            0, or -1 in a crowd.
        remaining: after each look, the numbers of objects that the evidence expects in clear and in faint cells.
        promised: after each look, the number of objects that the looks so far were expected to show.
    """

    target: int | None
    held: int
    objects: dict[int, tuple[Tensor, Tensor]]
    remaining: list[tuple[float, float]]
    promised: list[float]

    @classmethod
    def of(
        cls,
        target: int | None,
        looks: Sequence[WindowLook],
        numbers: Collection[int],
        lattice: Lattice,
        annotation: Annotation,
        remaining: list[tuple[float, float]],
        promised: list[float],
    ) -> Self:
        """Judge looks at a picture after the given numbers of them; the other arguments are attributes."""
        objects = {}
        for number in sorted(numbers):
            merged, facts = merge_with_facts(looks[:number], lattice, target)
            objects[number] = facts, right_boxes(merged, annotation)
        held = int(((annotation.labels == (target or 0)) & ~annotation.crowd).sum())
        return cls(target, held, objects, remaining, promised)

    @property
    def looks(self) -> int:
        """Number of looks."""
        return len(self.promised)

    @torch.no_grad()
    def sum_after(self, certainty: Certainty, number: int) -> float:
        """Sum the probabilities of the objects after a number of looks."""
        facts, _ = self.objects[number]
        return float(certainty.probability(facts).double().sum())

    @torch.no_grad()
    def number(self, certainty: Certainty, number: int) -> tuple[float, float] | None:
        """Claim a number of objects after some looks, or none: its mean, and its variance without a spread."""
        facts, right = self.objects[number]
        chances = certainty.probability(facts)
        if not (chances >= 0.5).any() or not reacts(chances):
            return None
        discoveries = self.sum_after(certainty, number) - self.sum_after(certainty, 1)
        mean, variance = certainty.unseen(
            self.remaining[number - 1], promised=self.promised[number - 1], discoveries=max(discoveries, 0.0)
        )
        return number_of(chances[right >= 0], (float(mean), float(variance)), 0.0)


@torch.inference_mode()
def explorations_of_kinds(
    model: GlimpseEvidence, pictures: PicturesByKind, passes: int
) -> dict[str, list[Exploration]]:
    """Explore pictures by kind, for objects of all classes and for those of the most frequent class of each.

    Args:
        model: evidence by magnification, which chooses the looks.
        pictures: the pictures, with their stored looks.
        passes: number of looks that users may make; explorations are longer.

    Returns:
        The explorations by kind.
    """
    explored: dict[str, list[Exploration]] = {kind: [] for kind in pictures}
    for kind, (scenes, opened) in pictures.items():
        for index, looks in enumerate(track(opened, f"exploring, {kind}", "picture")):
            annotation = scenes.annotation(index)
            for target in (None, int(annotation.labels.bincount().argmax())):
                explored[kind].append(_explore(model, looks, annotation, target, passes))
            looks.save()
    return explored


def _explore(
    model: GlimpseEvidence,
    looks: StoredWindowLooks,
    annotation: Annotation,
    target: int | None,
    passes: int,
) -> Exploration:
    """Explore a picture for all classes, or for a target."""
    window_looks: list[WindowLook] = []
    remaining: list[tuple[float, float]] = []
    promised: list[float] = []
    for step in islice(find_everything(looks, model, target), _FURTHER * passes):
        window_looks.append(step.look)
        remaining.append(step.belief.remaining())
        # Nothing was promised before the look at the whole.
        promised.append(promised[-1] + step.value if promised else 0.0)
    numbers = {min(number, len(window_looks)) for number in (*_AFTER, passes, *_EXPECTING, _FURTHER * passes)}
    return Exploration.of(target, window_looks, numbers, looks.lattice, annotation, remaining, promised)


def _judged(explored: Sequence[Exploration], passes: int) -> tuple[Tensor, Tensor]:
    """Collect facts about the objects of explorations after some looks, and which are right, without crowds."""
    after = []
    for exploration in explored:
        numbers = sorted({min(number, exploration.looks, passes) for number in (*_AFTER, passes)})
        after += [exploration.objects[number] for number in numbers]
    facts, right = (torch.cat(column) for column in zip(*after, strict=True))
    counted = right >= 0
    return facts[counted], right[counted] > 0


def _fit_certainty(explored: Sequence[Exploration], passes: int) -> Certainty:
    """Fit the probability of objects, and then the number of objects that further looks show."""
    # After several numbers of looks, so that the probability holds whenever an exploration stops.
    offset, *weights = logistic_regression(*_judged(explored, passes))
    return _fit_unseen(Certainty(offset, tuple(weights)), explored)


class _Growth(NamedTuple):
    """How the sum of probabilities grows from some look of an exploration to its end, or of n, each `(n,)`.

    Attributes:
        clear: objects that the evidence expects in clear cells.
        faint: objects that it expects in faint cells.
        promised: objects that the looks were expected to show.
        discovered: objects that they showed beyond the first look.
        now: sum of the probabilities.
        last: sum of the probabilities after all looks.
    """

    clear: float
    faint: float
    promised: float
    discovered: float
    now: float
    last: float


def _growth_of(exploration: Exploration, certainty: Certainty) -> list[_Growth]:
    """Follow how the sum of probabilities grows after some numbers of looks of an exploration."""
    numbers = [number for number in _EXPECTING if number < exploration.looks]
    if not numbers:
        return []
    first = exploration.sum_after(certainty, 1)
    last = exploration.sum_after(certainty, exploration.looks)
    growth = []
    for number in numbers:
        clear, faint = exploration.remaining[number - 1]
        now = exploration.sum_after(certainty, number)
        discovered = max(now - first, 0.0)
        # Further looks may lower the sum, too, while an expected number never is below it.
        growth.append(_Growth(clear, faint, exploration.promised[number - 1], discovered, now, max(last, now)))
    return growth


def _fit_unseen(certainty: Certainty, explored: Sequence[Exploration]) -> Certainty:
    """Fit the number of objects that further looks show, by least squares of logarithms over a grid."""
    growth: list[_Growth] = []
    for exploration in explored:
        # Of a single class some pictures hold hundreds of a few pixels.
        if exploration.target is None:
            growth += _growth_of(exploration, certainty)
    if not growth:
        return certainty
    clear, faint, promised, discovered, now, last = torch.tensor(growth, dtype=torch.float64).unbind(-1)

    def error(numbers: tuple[float, float, float, float]) -> float:
        scale, strength, share, promise = numbers
        factor = (strength * scale + discovered) / (strength + promise * promised)
        expected = now + factor * (clear + share * faint)
        return float((expected.log1p() - last.log1p()).square().mean())

    best = min(product(_SCALES, _STRENGTHS, _FAINT, _PROMISES), key=error)
    return Certainty(certainty.offset.item(), certainty.weights.tolist(), *best)


class _Numbers(NamedTuple):
    """Claimed numbers of objects of n pictures of a kind after some looks, each `(n,)`.

    Attributes:
        mean: expected numbers.
        variance: their variances.
        held: annotated numbers.
    """

    mean: Tensor
    variance: Tensor
    held: Tensor

    def covered(self, spread: float) -> float:
        """Compute the share of the pictures in which the annotated number is within two errors of the mean."""
        error = (self.variance + (spread * self.mean) ** 2).sqrt()
        return float(((self.held - self.mean).abs() <= 2 * error).double().mean())


def _left_out(
    explored: Mapping[str, Sequence[Exploration]],
    fit: Callable[[Sequence[Exploration]], Certainty],
    checked: Sequence[int],
) -> dict[tuple[str, int], _Numbers]:
    """Claim numbers in pictures of each kind after some looks, with a certainty that was fitted to the other kinds."""
    numbers = {}
    for kind, explorations in explored.items():
        others: list[Exploration] = []
        for other, group in explored.items():
            if other != kind:
                others += group
        if not others:
            continue
        certainty = fit(others)
        judged = [found for found in explorations if found.target is not None and _shows_half(found)]
        for looks in checked:
            claimed = _claimed(judged, certainty, looks)
            if claimed is not None:
                numbers[kind, looks] = claimed
    return numbers


def _claimed(explorations: Sequence[Exploration], certainty: Certainty, looks: int) -> _Numbers | None:
    """Claim the number of objects after some looks, or after all of fewer; None if none is claimed."""
    rows = []
    for exploration in explorations:
        claim = exploration.number(certainty, min(looks, exploration.looks))
        if claim is not None:
            mean, variance = claim
            rows.append((mean, variance, exploration.held))
    return _Numbers(*torch.tensor(rows, dtype=torch.float64).unbind(-1)) if rows else None


def _shows_half(exploration: Exploration) -> bool:
    """Tell whether all looks show half of the annotated objects; where they do not, most are too small for any look."""
    _, right = exploration.objects[exploration.looks]
    return 2 * int((right > 0).sum()) >= exploration.held


def fit_spread(numbers: Mapping[tuple[str, int], _Numbers]) -> tuple[float, list[str]]:
    """Find the least spread that covers enough of the pictures, in the mean over kinds and looks.

    Args:
        numbers: claimed and annotated numbers by kind and number of looks.

    Returns:
        The spread, and lines of Markdown about it.
    """
    claims = sum(len(of_kind.mean) for of_kind in numbers.values())
    least = SPREAD if claims < _FEW else 0.0
    spread = _SPREADS[-1]
    for candidate in _SPREADS:
        covered = sum(of_kind.covered(candidate) for of_kind in numbers.values())
        if candidate >= least and covered >= _COVERED * len(numbers):
            spread = candidate
            break
    rows = [["left out", "looks", "pictures", "within two errors", "with no spread"]]
    for (kind, after), of_kind in numbers.items():
        shares = (of_kind.covered(spread), of_kind.covered(0.0))
        rows.append([kind, f"{after}", f"{len(of_kind.mean)}", *(f"{share:.2f}" for share in shares)])
    return spread, [
        f"Spread of the expected number of objects of the most frequent class of a picture: {spread:.2f}. Pictures, of "
        "those in which the looks show at least half of these objects, in which the annotated number is within two "
        "errors, each with a certainty that was fitted on the others:",
        "",
        *table(rows),
        "",
    ]


def fit_with_spread(
    explored: Mapping[str, Sequence[Exploration]],
    fit: Callable[[Sequence[Exploration]], Certainty],
    checked: Sequence[int] = _CHECKED,
) -> tuple[Certainty, list[str]]:
    """Fit a certainty to explorations of all kinds, and its spread to kinds that are left out in turn.

    Args:
        explored: explorations by kind.
        fit: fits a certainty to explorations.
        checked: numbers of looks after which the expected number is compared with the annotated one.

    Returns:
        The certainty, and lines of Markdown about its spread.
    """
    certainty = fit([exploration for of_kind in explored.values() for exploration in of_kind])
    numbers = _left_out(explored, fit, checked)
    if not numbers:
        return certainty, []
    spread, report = fit_spread(numbers)
    certainty.spread = spread
    return certainty, report


def fit_certainty(model: GlimpseEvidence, fitted: PicturesByKind, judged: PicturesByKind, *, passes: int) -> list[str]:
    """Fit the certainty of a model on some kinds of pictures, and evaluate it on others.

    Args:
        model: evidence by magnification; it gets the certainty.
        fitted: pictures to fit on.
        judged: pictures to evaluate on.
        passes: number of looks that users may make.

    Returns:
        Lines of Markdown.
    """
    by_kind = explorations_of_kinds(model, fitted, passes)
    training = [exploration for group in by_kind.values() for exploration in group]
    held_out = [exploration for group in explorations_of_kinds(model, judged, passes).values() for exploration in group]
    certainty, report_on_spread = fit_with_spread(by_kind, partial(_fit_certainty, passes=passes))
    model.certainty = certainty.requires_grad_(False)
    facts, right = _judged(held_out, passes)
    chances = certainty.probability(facts).detach()
    is_listed = chances >= 0.5
    error = BinarySums.of(chances, right).ece
    weights = ", ".join(f"{name} {weight:.2f}" for name, weight in zip(FACTS, certainty.weights.tolist(), strict=True))
    return [
        f"Probability of an object, fitted on {len(_judged(training, passes)[1])} objects: offset "
        f"{certainty.offset.item():.2f}; {weights}. Objects that no look has shown: scale "
        f"{certainty.scale.item():.3f}, strength {certainty.strength.item():g}, faint cells "
        f"{certainty.faint.item():g}, promises {certainty.promise.item():g}.",
        "",
        f"Of {len(right)} objects in pictures of held-out photographs {int(right.sum())} are right and "
        f"{float(chances.sum()):.0f} are expected; the expected calibration error is {error:.3f}. Of the "
        f"{int(is_listed.sum())} from probability 0.5 on, {int(right[is_listed].sum())} are right and "
        f"{float(chances[is_listed].sum()):.0f} expected.",
        "",
        *report_on_spread,
    ]
