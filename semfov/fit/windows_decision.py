"""Fit the decisions of searches in large pictures: whether the target is found or absent."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.scene import Annotation, Scenes
from semfov.fit.descent import descend
from semfov.fit.evidence import Bounds, choose_thresholds
from semfov.metrics.calibration import BinarySums
from semfov.metrics.presence import area_under_roc
from semfov.runs.progress import track
from semfov.runs.search_protocol import choose_classes
from semfov.runs.tables import table
from semfov.runs.zoom_store import StoredGlances
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.decision import SearchFacts
from semfov.zoom.episode import WindowStep, look_for
from semfov.zoom.evidence import GlimpseEvidence

_JUDGED = (1, 4, 8, 16)
"""Numbers of looks after which the probability of presence is evaluated."""


class Searches(NamedTuple):
    """E searches of n looks. A search that ends early is padded with its last values, and with 0 for `left`.

    Shapes: best `(E, n)`, case `(E, n, 10)`, looked `(E, n)`, left `(E, n)`, there `(E,)`.
    """

    best: Tensor
    case: Tensor
    looked: Tensor
    left: Tensor
    there: Tensor

    @classmethod
    def join(cls, searches: Sequence[Searches]) -> Searches:
        """Join several sets of searches."""
        return cls(*map(torch.cat, zip(*searches, strict=True)))


@torch.inference_mode()
def searches_of(
    model: GlimpseEvidence,
    pictures: Scenes,
    opened: Sequence[StoredGlances],
    *,
    classes: int,
    passes: int,
    seed: int,
    title: str,
) -> Iterator[tuple[int, Annotation, int, Iterator[tuple[WindowStep[ZoomBelief], SearchFacts]]]]:
    """Search every picture for some present classes and for as many absent ones, without decisions."""
    for index, looks in enumerate(track(opened, title, "picture")):
        annotation = pictures.annotation(index)
        for target in choose_classes(pictures, index, annotation, classes, 1.0, seed):
            turns = islice(look_for(looks, model, target, confirm=float("inf")), passes)
            yield index, annotation, target, _with_facts(turns)
        looks.save()


def _with_facts(turns: Iterable[WindowStep[ZoomBelief]]) -> Iterator[tuple[WindowStep[ZoomBelief], SearchFacts]]:
    """The turns of a search, each with the facts about the search after it."""
    facts: SearchFacts | None = None
    for turn in turns:
        facts = facts or SearchFacts(turn.belief)
        facts.add(turn.glance)
        yield turn, facts


@torch.inference_mode()
def picture_searches(
    model: GlimpseEvidence,
    pictures: Scenes,
    opened: Sequence[StoredGlances],
    *,
    classes: int,
    passes: int,
    seed: int,
    title: str,
) -> Searches:
    """Run all searches of `searches_of`, with the same arguments, and collect them."""
    rows: list[list[Tensor]] = []
    searches = searches_of(model, pictures, opened, classes=classes, passes=passes, seed=seed, title=title)
    for _, annotation, target, turns in searches:
        steps = [(facts.best, facts.case(turn.ahead), facts.detected, turn.ahead) for turn, facts in turns]
        steps += [(*steps[-1][:3], 0.0)] * (passes - len(steps))
        best, case, looked, left = zip(*steps, strict=True)
        there = torch.tensor(bool((annotation.labels == target).any()))
        rows.append([torch.tensor(best), torch.stack(case), torch.tensor(looked), torch.tensor(left), there])
    return Searches(*(torch.stack(column) for column in zip(*rows, strict=True)))


def fit_judge(model: GlimpseEvidence, searches: Searches, steps: int, batch: int = 4096) -> None:
    """Fit the probability that a picture contains the target, by the cross-entropy after all looks of all searches."""
    best, case = searches.best.flatten(), searches.case.flatten(0, 1)
    there = searches.there[:, None].expand_as(searches.best).flatten().float()

    def loss_of(_: int) -> Tensor:
        rows = torch.randint(len(best), (min(batch, len(best)),))
        return F.binary_cross_entropy_with_logits(model.anywhere(best[rows], case[rows]), there[rows])

    model.judge.requires_grad_(True)
    descend(model.judge.parameters(), loss_of, steps, 1e-2, decay=1.0, title="fitting decisions")
    model.judge.requires_grad_(False)


@torch.no_grad()
def judge_searches(model: GlimpseEvidence, searches: Searches, bounds: Bounds) -> list[str]:
    """Evaluate the probability of presence on held-out searches, and set the model's thresholds by them."""
    anywhere = model.anywhere(searches.best, searches.case).sigmoid()
    there = searches.there
    chosen = choose_thresholds(bounds, anywhere.mT, searches.looked.mT.to(anywhere), searches.left.mT, there)
    # The place is known as soon as a detection shows the target; there is no probability to put a threshold on.
    model.thresholds = chosen.changed(place=0.0)
    rows = [["looks", "area under ROC", "NLL", "Brier", "ECE", "ECE of the highest score"]]
    last = anywhere.shape[1]
    for number in sorted({last, *(each for each in _JUDGED if each < last)}):
        presence = BinarySums.of(anywhere[:, number - 1], there)
        raw = BinarySums.of(searches.best[:, number - 1], there)
        area = area_under_roc(anywhere[:, number - 1], there) if bool(there.any() and not there.all()) else float("nan")
        measures = (presence.nll, presence.brier, presence.ece, raw.ece)
        rows.append([str(number), f"{area:.3f}", *(f"{measure:.3f}" for measure in measures)])
    return table(rows)
