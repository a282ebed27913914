"""Fit the probability that an object of a large picture is there, on explorations of mosaics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice

import torch
from torch import Tensor

from semfov.data.mosaics import Mosaics
from semfov.detection.objects import LEAST
from semfov.metrics.calibration import BinarySums
from semfov.observation.matching import match
from semfov.runs.progress import track
from semfov.runs.zoom_store import StoredGlances
from semfov.zoom.certainty import fit_certainty
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.objects import merge
from semfov.zoom.search import find_everything


@torch.inference_mode()
def judged_objects(
    model: GlimpseEvidence, mosaics: Mosaics, opened: Sequence[StoredGlances], *, passes: int, title: str
) -> tuple[Tensor, Tensor]:
    """Explore mosaics, and compare the objects with the annotated ones.

    Args:
        model: the evidence that guides the explorations.
        mosaics: the mosaics.
        opened: the stored looks at each mosaic.
        passes: number of passes of the detector in each.
        title: label of the progress bar.

    Returns:
        Scores of the objects `(n,)`, and whether the box and the class of each are right `(n,)`.
    """
    scores, right = [torch.zeros(0)], [torch.zeros(0, dtype=torch.bool)]
    for index, looks in enumerate(track(opened, title, "mosaic")):
        objects = merge([turn.glance for turn in islice(find_everything(looks, model), passes)])
        looks.save()
        annotation = mosaics.annotation(index)
        scores.append(objects.scores)
        right.append(match(objects.boxes, annotation.boxes.to(objects.boxes), annotation.labels) == objects.labels)
    return torch.cat(scores), torch.cat(right)


def certainty_again(
    model: GlimpseEvidence,
    mosaics: Mapping[str, Mosaics],
    opened: Mapping[str, Sequence[StoredGlances]],
    *,
    passes: int,
) -> list[str]:
    """Fit the certainty of a model on the mosaics `searched`, and evaluate it on those `judged`.

    Args:
        model: the model; its certainty is replaced.
        mosaics: the mosaics by kind.
        opened: the stored looks by kind.
        passes: number of passes of the detector in each mosaic.

    Returns:
        Lines of the report in Markdown.
    """
    seen = {
        kind: judged_objects(model, mosaics[kind], opened[kind], passes=passes, title=title)
        for kind, title in (("searched", "exploring"), ("judged", "exploring held-out mosaics"))
    }
    model.certainty = fit_certainty(*seen["searched"])
    scores, right = seen["judged"]
    chances, sure = model.certainty.probability(scores), scores >= LEAST
    error = BinarySums.of(chances, right).ece
    offset, slope = model.certainty
    return [
        f"Probability of an object: logit p = {offset:.3f} + {slope:.3f} logit s, fitted on {len(seen['searched'][0])} "
        f"objects. Of {len(scores)} objects in mosaics of held-out photographs {int(right.sum())} are right and "
        f"{float(chances.sum()):.0f} are expected; the expected calibration error is {error:.3f}. Of the "
        f"{int(sure.sum())} from score {LEAST:g} on, {int(right[sure].sum())} are right and "
        f"{float(chances[sure].sum()):.0f} expected.",
        "",
    ]
