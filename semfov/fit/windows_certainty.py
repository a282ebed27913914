"""Fit the probability that an object of a large picture is there, on explorations of pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice, product
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.data.scene import Scenes
from semfov.metrics.calibration import BinarySums
from semfov.runs.progress import track
from semfov.runs.window_looking import right_boxes
from semfov.runs.zoom_store import StoredGlances
from semfov.zoom.certainty import FACTS, Certainty
from semfov.zoom.episode import find_everything
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.glances import Glance
from semfov.zoom.objects import merge_with_facts, probable_objects

_AFTER = (3, 6, 12, 24)
"""Numbers of looks after which objects are taken."""
_EXPECTING = (1, 2, 4, 8, 16, 24)
"""Numbers of looks after which the number of further objects is taken."""
_FURTHER = 2
"""Explorations are this many times as long as they may be for users, to see what further looks show."""
_SCALES = tuple(0.05 * 1.25**n for n in range(21))
_STRENGTHS = tuple(2.0**n for n in range(-2, 9))
_FAINT = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0)
_PROMISES = (0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)


class _MosaicExploration(NamedTuple):
    """An exploration of a mosaic; facts `(n, 14)`, right `(n,)`."""

    looks: StoredGlances
    target: int | None
    glances: list[Glance]
    remaining: list[tuple[float, float]]
    promised: list[float]
    facts: Tensor
    right: Tensor

    def outcome(self, certainty: Certainty, number: int) -> tuple[float, float]:
        """The sums of the probabilities of the objects after the first look, and after a number of them."""
        lattice = self.looks.lattice
        return tuple(  # type: ignore[return-value]
            float(probable_objects(self.glances[:n], lattice, self.target, certainty)[0].scores.sum())
            for n in (1, number)
        )


@torch.inference_mode()
def _mosaic_explorations(
    model: GlimpseEvidence, pictures: Scenes, opened: Sequence[StoredGlances], *, passes: int, title: str
) -> Iterator[_MosaicExploration]:
    """Explore pictures, for objects of all classes and for those of the most frequent class of each."""
    for index, looks in enumerate(track(opened, title, "picture")):
        annotation = pictures.annotation(index)
        for target in (None, int(annotation.labels.bincount().argmax())):
            glances: list[Glance] = []
            remaining, promised = [], [0.0]
            for turn in islice(find_everything(looks, model, target), _FURTHER * passes):
                glances.append(turn.glance)
                remaining.append(turn.belief.remaining())
                promised.append(promised[-1] + (turn.worth if len(glances) > 1 else 0.0))
            facts, right = [], []
            for number in sorted({min(n, len(glances), passes) for n in (*_AFTER, passes)}):
                objects, object_facts = merge_with_facts(glances[:number], looks.lattice, target)
                hits = right_boxes(objects, annotation)
                facts.append(object_facts[hits >= 0])
                right.append(hits[hits >= 0] > 0)
            yield _MosaicExploration(
                looks, target, glances, remaining, promised[1:], torch.cat(facts), torch.cat(right)
            )
        looks.save()


def logistic_regression(facts: Tensor, right: Tensor, *, ridge: float = 1.0, steps: int = 30) -> list[float]:
    """Fit a logistic regression by maximum likelihood, with Newton's method in float64: the offset, then the weights.

    A weak prior (half a case for and against without any facts, and small weights) keeps the result finite where all
    cases are right or all wrong.

    >>> torch.manual_seed(0)
    <torch._C.Generator object at ...>
    >>> facts, weights = torch.randn(20_000, 3), torch.full((3,), 0.5)
    >>> fitted = logistic_regression(facts, torch.rand(20_000) < (facts @ weights - 1).sigmoid())
    >>> [round(number, 1) for number in fitted]
    [-1.0, 0.5, 0.5, 0.5]

    Shapes: facts `(n, m)`, right `(n,)`.
    """
    inputs = torch.cat([facts.double(), facts.new_zeros(2, facts.shape[1], dtype=torch.float64)])
    inputs = torch.cat([torch.ones(len(inputs), 1, dtype=torch.float64), inputs], -1)
    there = torch.cat([right.double(), torch.tensor([0.0, 1.0], dtype=torch.float64)])
    weight = torch.ones(len(inputs), dtype=torch.float64)
    weight[-2:] = 0.5
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


def fit_certainty(facts: Tensor, right: Tensor) -> Certainty:
    """Fit the probability of objects; it expects none that no look has shown. Shapes: facts `(n, 14)`, right `(n,)`."""
    offset, *weights = logistic_regression(facts, right)
    return Certainty(offset, tuple(weights))


def _fit_unseen(certainty: Certainty, explored: Sequence[_MosaicExploration]) -> Certainty:
    """Fit the number of objects that further looks show, by least squares over a grid.

    The error is that of the logarithm of one more than the number of objects in all, so that pictures with few objects
    count as much as those with many. Only explorations for objects of all classes are taken: of a single class some
    pictures hold hundreds of a few pixels.
    """
    cases = []
    for each in explored:
        numbers = [n for n in _EXPECTING if n < len(each.glances)] if each.target is None else []
        end = each.outcome(certainty, len(each.glances))[1] if numbers else 0.0
        for number in numbers:
            first, sums = each.outcome(certainty, number)
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


def certainty_again(
    model: GlimpseEvidence,
    fitted: Mapping[str, tuple[Scenes, Sequence[StoredGlances]]],
    judged: Mapping[str, tuple[Scenes, Sequence[StoredGlances]]],
    *,
    passes: int,
) -> list[str]:
    """Fit the certainty of a model on some kinds of pictures, and evaluate it on others."""
    training, held_out = (
        [
            each
            for kind, (pictures, opened) in some.items()
            for each in _mosaic_explorations(model, pictures, opened, passes=passes, title=f"exploring, {kind}")
        ]
        for some in (fitted, judged)
    )
    regression = fit_certainty(
        torch.cat([each.facts for each in training]), torch.cat([each.right for each in training])
    )
    model.certainty = _fit_unseen(regression, training)
    facts, right = torch.cat([each.facts for each in held_out]), torch.cat([each.right for each in held_out])
    chances = model.certainty.probability(facts)
    sure, error = chances >= 0.5, BinarySums.of(chances, right).ece
    weights = ", ".join(f"{name} {weight:.2f}" for name, weight in zip(FACTS, model.certainty.weights, strict=True))
    return [
        f"Probability of an object, fitted on {sum(len(each.right) for each in training)} objects: offset "
        f"{model.certainty.offset:.2f}; {weights}. Objects that no look has shown: scale {model.certainty.scale:.3f}, "
        f"strength {model.certainty.strength:g}, faint cells {model.certainty.faint:g}, promises "
        f"{model.certainty.promise:g}.",
        "",
        f"Of {len(right)} objects in pictures of held-out photographs {int(right.sum())} are right and "
        f"{float(chances.sum()):.0f} are expected; the expected calibration error is {error:.3f}. Of the "
        f"{int(sure.sum())} from probability 0.5 on, {int(right[sure].sum())} are right and "
        f"{float(chances[sure].sum()):.0f} expected.",
        "",
    ]
