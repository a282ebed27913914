"""Fitting when a search of a large picture has found its target, or gives up: on searches of mosaics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import torch
from torch import Tensor
from torch.nn import functional as F
from tqdm import tqdm

from semfov.data.mosaics import Mosaics
from semfov.experiments.search_protocol import choose_classes
from semfov.experiments.summary import table
from semfov.experiments.zoom_store import StoredGlances
from semfov.metrics.calibration import BinarySums
from semfov.metrics.presence import area_under_roc
from semfov.training.descent import descend
from semfov.training.evidence import Bounds, choose_thresholds
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.search import look_for
from semfov.zoom.tally import Tally

JUDGED = (1, 4, 8, 16)
"""Looks after which the probability of presence is judged."""


@dataclass(frozen=True)
class Searches:
    """Searches that end when nothing is left to look at, or with their passes; those that ended stay as they were.

    Attributes:
        best: `(E, n)`, highest score of the target after each look.
        case: `(E, n, 11)`, what else is known (`Tally.case`).
        looked: `(E, n)`, whether a detection shows it.
        left: `(E, n)`, what the best look that is left is worth.
        there: `(E,)`, whether the target is in the picture.
    """

    best: Tensor
    case: Tensor
    looked: Tensor
    left: Tensor
    there: Tensor

    @classmethod
    def join(cls, parts: Sequence[Searches]) -> Searches:
        """All searches of several sets."""
        return cls(*(torch.cat([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))


@torch.inference_mode()
def search_mosaics(
    model: GlimpseEvidence,
    mosaics: Mosaics,
    opened: Sequence[StoredGlances],
    *,
    classes: int,
    passes: int,
    seed: int,
    title: str,
) -> Searches:
    """Search every mosaic for some classes that it holds, and for as many that it does not.

    Args:
        model: of the evidence that is gone by.
        mosaics: to search.
        opened: looks at them.
        classes: that a mosaic holds, at most.
        passes: of the detector, at most.
        seed: of the choice of classes.
        title: label of the progress bar.
    """
    rows: list[list[Tensor]] = []
    for index, looks in enumerate(tqdm(opened, desc=title, unit="mosaic", dynamic_ncols=True)):
        annotation = mosaics.annotation(index)
        held = set(annotation.labels.tolist())
        for target in choose_classes(mosaics, index, annotation, classes, 1.0, seed):
            tally: Tally | None = None
            steps: list[tuple[float, Tensor, bool, float]] = []
            for turn in islice(look_for(looks, model, target, confirm=float("inf")), passes):
                tally = tally or Tally(turn.belief)
                tally.add(turn.glance)
                steps.append((tally.best, tally.case(turn.ahead), tally.looked, turn.ahead))
            steps += [(*steps[-1][:3], 0.0)] * (passes - len(steps))
            best, case, looked, left = zip(*steps, strict=True)
            rows.append(
                [torch.tensor(best), torch.stack(case), torch.tensor(looked), torch.tensor(left),
                 torch.tensor(target in held)]
            )  # fmt: skip
        looks.save()
    return Searches(*(torch.stack(column) for column in zip(*rows, strict=True)))


def fit_judge(model: GlimpseEvidence, searches: Searches, steps: int, batch: int = 4096) -> None:
    """Fit whether a picture holds a class: mean cross-entropy after all looks of all searches."""
    best, case = searches.best.flatten(), searches.case.flatten(0, 1)
    there = searches.there[:, None].expand_as(searches.best).flatten().float()

    def loss_of(_: int) -> Tensor:
        rows = torch.randint(len(best), (min(batch, len(best)),))
        return F.binary_cross_entropy_with_logits(model.anywhere(best[rows], case[rows]), there[rows])

    model.judge.requires_grad_(True)
    descend(model.judge.parameters(), loss_of, steps, 1e-2, decay=1.0, title="judging")
    model.judge.requires_grad_(False)


@torch.no_grad()
def judge_searches(model: GlimpseEvidence, searches: Searches, bounds: Bounds) -> list[str]:
    """Set the thresholds by searches that were held out; returns lines of a table of how well presence is told."""
    anywhere = model.anywhere(searches.best, searches.case).sigmoid()
    there = searches.there
    chosen = choose_thresholds(bounds, anywhere.mT, searches.looked.mT.to(anywhere), searches.left.mT, there)
    # A window was looked at closely enough or was not: there is no probability of its place to choose from.
    model.thresholds = chosen.changed(place=0.0)
    rows = [["looks", "area under ROC", "NLL", "Brier", "ECE", "ECE of the highest score"]]
    for number in (each for each in (*JUDGED, anywhere.shape[1]) if each <= anywhere.shape[1]):
        told = BinarySums.of(anywhere[:, number - 1], there)
        raw = BinarySums.of(searches.best[:, number - 1], there)
        area = area_under_roc(anywhere[:, number - 1], there) if bool(there.any() and not there.all()) else float("nan")
        rows.append([str(number), f"{area:.3f}", f"{told.nll:.3f}", f"{told.brier:.3f}", f"{told.ece:.3f}",
                     f"{raw.ece:.3f}"])  # fmt: skip
    return table(rows)
