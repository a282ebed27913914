"""Judge a survey, and choose its `foresight`, on mosaics of held-out photographs."""

from collections.abc import Sequence
from itertools import chain

import torch

from semfov.data.mosaics import Mosaics
from semfov.fit.windows import MosaicFit
from semfov.fit.windows_evidence import ANY_CLASS, ZoomExample
from semfov.runs.progress import track
from semfov.runs.window_looking import found_in
from semfov.zoom.episode import find_everything
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.looks import WindowLook, WindowLooks
from semfov.zoom.survey import Survey

_FORESIGHTS = (0.0, 0.1, 0.2, 0.35, 0.5)


@torch.inference_mode()
def choose_foresight(model: GlimpseEvidence, fit: MosaicFit, kinds: Sequence[str]) -> list[list[str]]:
    """Set the `foresight` of the survey to the one with which most objects are found.

    The recall is a mean over passes, from the first to one more than a mosaic has photographs. As the kinds of mosaics
    differ in difficulty, the recall of each kind is divided by the highest one that any `foresight` reaches.

    Args:
        model: evidence by magnification, with a survey.
        fit: the mosaics and their looks.
        kinds: kinds of mosaics.

    Returns:
        Rows of a table of the recalls.
    """
    opened = {kind: fit.opened(kind) for kind in kinds}
    rows = [["foresight", *(f"recall, {kind}" for kind in kinds)]]
    recalls: dict[float, list[float]] = {}
    for value in track(_FORESIGHTS, "choosing foresight", "value"):
        model.survey.foresight = value
        recalls[value] = [_mean_recall(model, looks, fit.mosaics[kind]) for kind, looks in opened.items()]
        rows.append([f"{value:g}", *(f"{recall:.4f}" for recall in recalls[value])])
        for looks in chain.from_iterable(opened.values()):
            looks.save()
    # Kinds differ in difficulty, so that each counts by its highest recall.
    highest = [max(*of_kind, 1e-9) for of_kind in zip(*recalls.values(), strict=True)]
    shares = {
        value: sum(recall / high for recall, high in zip(by_kind, highest, strict=True))
        for value, by_kind in recalls.items()
    }
    model.survey.foresight = max(shares, key=shares.__getitem__)
    return rows


def _mean_recall(model: GlimpseEvidence, opened: Sequence[WindowLooks], mosaics: Mosaics) -> float:
    """Compute the mean recall over passes of an exploration that looks for all objects."""
    passes = len(mosaics.tiles(0)) + 1
    found = 0
    objects = 0
    for index, looks in enumerate(opened):
        annotation = mosaics.annotation(index)
        objects += len(annotation.boxes)
        history: list[WindowLook] = []
        steps = find_everything(looks, model)
        count = 0
        for _ in range(passes):
            step = next(steps, None)
            if step is not None:
                history.append(step.look)
                count = int(found_in(history, annotation).sum())
            # When no window is left, the number of found objects stays the same for the remaining passes.
            found += count
    return found / max(passes * objects, 1)


@torch.no_grad()
def judge_survey(survey: Survey, examples: Sequence[ZoomExample], where: str = "") -> dict[str, float]:
    """Average the losses on mosaics that were held out, by the overview and by closer looks.

    Args:
        survey: predicts the numbers of objects of any class.
        examples: the mosaics.
        where: what is added to the names of the measures.

    Returns:
        The measures by name.
    """
    name = "objects of any class, mean negative log likelihood"
    of_overviews = []
    of_closer_looks = []
    for example in examples:
        overview, *closer = example.losses(survey, ANY_CLASS, example.closer)
        of_overviews.append(overview)
        of_closer_looks += closer
    figures = {f"{name}, overview{where}": float(torch.stack(of_overviews).mean())}
    if of_closer_looks:
        figures[f"{name}, closer looks{where}"] = float(torch.stack(of_closer_looks).mean())
    return figures
