"""Fit the probability that an object of a large picture is there, on explorations of pictures."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice, product
from typing import NamedTuple, Self

import torch
from torch import Tensor

from semfov.data.scene import Annotation, Scenes
from semfov.metrics.calibration import BinarySums
from semfov.runs.progress import track
from semfov.runs.tables import table
from semfov.runs.window_looking import right_boxes
from semfov.runs.zoom_store import StoredWindowLooks
from semfov.zoom import GlimpseEvidence, Lattice
from semfov.zoom.certainty import FACTS, SPREAD, Certainty, number_of, reacts
from semfov.zoom.episode import find_everything
from semfov.zoom.looks import WindowLook
from semfov.zoom.objects import merge_with_facts

_AFTER = (3, 6, 12, 24)  # numbers of looks after which objects are taken
_EXPECTING = (1, 2, 4, 8, 16, 24)  # numbers of looks after which the number of further objects is taken
_FURTHER = 2  # explorations are this many times as long as they may be for users, to see what further looks show
_SCALES = tuple(0.05 * 1.25**n for n in range(21))
_STRENGTHS = tuple(2.0**n for n in range(-2, 9))
_FAINT = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0)
_PROMISES = (0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)


_SPREADS = tuple(0.05 * n for n in range(41))
_FEW = 40  # below this number of claims the spread is not less than that of a model for which none was fitted
_CHECKED = (8, 24)
"""Numbers of looks after which the expected number is compared with the annotated one, to fit its spread."""
_COVERED = 0.8  # share of the pictures in which the annotated number should be within two errors of the expected one


class Exploration(NamedTuple):
    """An exploration of a picture for all classes, or for a target of which it holds a number of objects."""

    target: int | None
    held: int
    # After numbers of looks, facts about the objects `(n, 14)`, and whether they are right `(n,)`, -1 in a crowd.
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
        """The exploration with some looks, judged after the given numbers of them."""
        objects = {}
        for number in sorted(numbers):
            found, facts = merge_with_facts(looks[:number], lattice, target)
            objects[number] = facts, right_boxes(found, annotation)
        held = int(((annotation.labels == (target or 0)) & ~annotation.crowd).sum())
        return cls(target, held, objects, remaining, promised)

    @property
    def looks(self) -> int:
        return len(self.promised)

    def sums(self, certainty: Certainty, number: int) -> tuple[float, float]:
        """The sums of the probabilities of the objects after the first look, and after a number of them."""
        first, after = (float(certainty.probability(self.objects[n][0]).double().sum()) for n in (1, number))
        return first, after

    def number(self, certainty: Certainty, number: int) -> tuple[float, float] | None:
        """Mean and variance of the number of objects after some looks, without a spread; None where none is claimed."""
        facts, right = self.objects[number]
        chances = certainty.probability(facts)
        if not (chances >= 0.5).any() or not reacts(chances):
            return None
        first, after = self.sums(certainty, number)
        unseen = certainty.unseen(
            self.remaining[number - 1], promised=self.promised[number - 1], discoveries=max(after - first, 0.0)
        )
        return number_of(chances[right >= 0], unseen, 0.0)


@torch.inference_mode()
def explorations_of_kinds(
    model: GlimpseEvidence, some: Mapping[str, tuple[Scenes, Sequence[StoredWindowLooks]]], passes: int
) -> dict[str, list[Exploration]]:
    """Explore pictures by kind, for objects of all classes and for those of the most frequent class of each."""
    explored: dict[str, list[Exploration]] = {kind: [] for kind in some}
    for kind, (pictures, opened) in some.items():
        for index, looks in enumerate(track(opened, f"exploring, {kind}", "picture")):
            annotation = pictures.annotation(index)
            for target in (None, int(annotation.labels.bincount().argmax())):
                window_looks: list[WindowLook] = []
                remaining, promised = [], [0.0]
                for step in islice(find_everything(looks, model, target), _FURTHER * passes):
                    window_looks.append(step.look)
                    remaining.append(step.belief.remaining())
                    promised.append(promised[-1] + (step.worth if len(window_looks) > 1 else 0.0))
                counts = {min(n, len(window_looks)) for n in (*_AFTER, passes, *_EXPECTING, _FURTHER * passes)}
                explored[kind].append(
                    Exploration.of(target, window_looks, counts, looks.lattice, annotation, remaining, promised[1:])
                )
            looks.save()
    return explored


def logistic_regression(
    facts: Tensor, right: Tensor, *, times: Tensor | None = None, ridge: float = 1.0, steps: int = 30
) -> list[float]:
    """Fit a logistic regression by maximum likelihood, with Newton's method: offset and weights.

    Shapes: facts `(n, m)`, right `(n,)`, times `(n,)`: how often each case counts; None: once.
    """
    # Half a case for and against without any facts keeps the result finite where all cases are right or all wrong.
    inputs = torch.cat([facts.double(), facts.new_zeros(2, facts.shape[1], dtype=torch.float64)])
    inputs = torch.cat([torch.ones(len(inputs), 1, dtype=torch.float64), inputs], -1)
    there = torch.cat([right.double(), torch.tensor([0.0, 1.0], dtype=torch.float64)])
    weight = torch.ones(len(inputs), dtype=torch.float64)
    weight[-2:] = 0.5
    if times is not None:
        weight[:-2] = times
    prior = torch.full((inputs.shape[-1],), ridge, dtype=torch.float64)
    prior[0] = 1e-6
    coefficients = torch.zeros_like(prior)
    for _ in range(steps):
        chance = (inputs @ coefficients).sigmoid()
        gradient = inputs.T @ (weight * (there - chance)) - prior * coefficients
        curvature = inputs.T @ (inputs * (weight * chance * (1 - chance))[:, None]) + prior.diag()
        step = torch.linalg.solve(curvature, gradient).clamp(-2, 2)
        coefficients = coefficients + step
        if float(step.abs().max()) < 1e-9:
            break
    return coefficients.tolist()


def _judged(explored: Sequence[Exploration], passes: int) -> tuple[Tensor, Tensor]:
    """Facts about the objects of explorations after some numbers of looks, and which are right, without crowds."""
    after = [
        each.objects[n]
        for each in explored
        for n in sorted({min(number, each.looks, passes) for number in (*_AFTER, passes)})
    ]
    facts, right = (torch.cat(column) for column in zip(*after, strict=True))
    return facts[right >= 0], right[right >= 0] > 0


def _fitted(explored: Sequence[Exploration], passes: int) -> Certainty:
    """Fit the probability of objects, and then the number of objects that further looks show."""
    offset, *weights = logistic_regression(*_judged(explored, passes))
    return _fit_unseen(Certainty(offset, tuple(weights)), explored)


def _fit_unseen(certainty: Certainty, explored: Sequence[Exploration]) -> Certainty:
    """Fit the number of objects that further looks show, by least squares of logarithms over a grid."""
    cases = []
    for each in explored:  # for all classes: of a single one some pictures hold hundreds of a few pixels
        numbers = [n for n in _EXPECTING if n < each.looks] if each.target is None else []
        end = each.sums(certainty, each.looks)[1] if numbers else 0.0
        for number in numbers:
            first, sums = each.sums(certainty, number)
            shown = max(sums - first, 0.0), sums, max(end, sums)
            cases.append((*each.remaining[number - 1], each.promised[number - 1], *shown))
    if not cases:
        return certainty
    clear, faint, promised, discoveries, now, last = torch.tensor(cases, dtype=torch.float64).unbind(-1)

    def error(scale: float, strength: float, share: float, promise: float) -> float:
        factor = (strength * scale + discoveries) / (strength + promise * promised)
        expected = now + factor * (clear + share * faint)
        return float((expected.log1p() - last.log1p()).square().mean())

    chosen = min(product(_SCALES, _STRENGTHS, _FAINT, _PROMISES), key=lambda four: error(*four))
    return Certainty(certainty.offset, certainty.weights, *chosen)


class _Numbers(NamedTuple):
    """Claimed numbers of pictures of a kind after some looks: mean, variance and the annotated number; each `(n,)`."""

    mean: Tensor
    variance: Tensor
    held: Tensor

    def covered(self, spread: float) -> float:
        """Share of the pictures in which the annotated number is within two errors of the mean."""
        error = (self.variance + (spread * self.mean) ** 2).sqrt()
        return float(((self.held - self.mean).abs() <= 2 * error).double().mean())


def left_out(
    explored: Mapping[str, Sequence[Exploration]],
    fit: Callable[[Sequence[Exploration]], Certainty],
    checked: Sequence[int] = _CHECKED,
) -> dict[tuple[str, int], _Numbers]:
    """The numbers claimed in pictures of each kind, by kind and number of looks, fitted on the other kinds alone."""
    numbers = {}
    for kind, some in explored.items():
        others = [each for other, group in explored.items() if other != kind for each in group]
        if not others:
            continue
        certainty = fit(others)
        # Where all looks show less than half of the annotated objects, most are too small for any look.
        shown = [each for each in some if 2 * int((each.objects[each.looks][1] > 0).sum()) >= each.held]
        for after in checked:
            claims = [
                (*claim, each.held)
                for each in shown
                if each.target is not None
                for claim in [each.number(certainty, min(after, each.looks))]
                if claim is not None
            ]
            if claims:
                numbers[kind, after] = _Numbers(*torch.tensor(claims, dtype=torch.float64).unbind(-1))
    return numbers


def fit_spread(numbers: Mapping[tuple[str, int], _Numbers]) -> tuple[float, list[str]]:
    """The least spread that covers enough of the pictures, in the mean over kinds and looks; and the report."""
    least = SPREAD if sum(len(each.mean) for each in numbers.values()) < _FEW else 0.0
    tried = (spread for spread in _SPREADS if spread >= least)
    needed = _COVERED * len(numbers)
    spread = next((s for s in tried if sum(each.covered(s) for each in numbers.values()) >= needed), _SPREADS[-1])
    rows = [["left out", "looks", "pictures", "within two errors", "with no spread"]]
    rows += [
        [kind, f"{after}", f"{len(each.mean)}", *(f"{each.covered(s):.2f}" for s in (spread, 0.0))]
        for (kind, after), each in numbers.items()
    ]
    return spread, [
        f"Spread of the expected number of objects of the most frequent class of a picture: {spread:.2f}. Pictures, of "
        "those in which the looks show at least half of these objects, in which the annotated number is within two "
        "errors, each with a certainty that was fitted on the others:",
        "",
        *table(rows),
        "",
    ]


def spread_again(model: GlimpseEvidence, explored: Mapping[str, Sequence[Exploration]], passes: int) -> list[str]:
    """Fit the spread on explorations; the report in Markdown."""
    assert model.certainty is not None
    numbers = left_out(explored, partial(_fitted, passes=passes))
    if not numbers:
        return []
    spread, lines = fit_spread(numbers)
    model.certainty = replace(model.certainty, spread=spread)
    return lines


def certainty_again(
    model: GlimpseEvidence,
    fitted: Mapping[str, tuple[Scenes, Sequence[StoredWindowLooks]]],
    judged: Mapping[str, tuple[Scenes, Sequence[StoredWindowLooks]]],
    *,
    passes: int,
) -> list[str]:
    """Fit the certainty of a model on some kinds of pictures, and evaluate it on others."""
    kinds = explorations_of_kinds(model, fitted, passes)
    training = [each for group in kinds.values() for each in group]
    held_out = [each for group in explorations_of_kinds(model, judged, passes).values() for each in group]
    model.certainty = _fitted(training, passes)
    told = spread_again(model, kinds, passes)
    facts, right = _judged(held_out, passes)
    chances = model.certainty.probability(facts)
    sure, error = chances >= 0.5, BinarySums.of(chances, right).ece
    weights = ", ".join(f"{name} {weight:.2f}" for name, weight in zip(FACTS, model.certainty.weights, strict=True))
    return [
        f"Probability of an object, fitted on {len(_judged(training, passes)[1])} objects: offset "
        f"{model.certainty.offset:.2f}; {weights}. Objects that no look has shown: scale {model.certainty.scale:.3f}, "
        f"strength {model.certainty.strength:g}, faint cells {model.certainty.faint:g}, promises "
        f"{model.certainty.promise:g}.",
        "",
        f"Of {len(right)} objects in pictures of held-out photographs {int(right.sum())} are right and "
        f"{float(chances.sum()):.0f} are expected; the expected calibration error is {error:.3f}. Of the "
        f"{int(sure.sum())} from probability 0.5 on, {int(right[sure].sum())} are right and "
        f"{float(chances[sure].sum()):.0f} expected.",
        "",
        *told,
    ]
