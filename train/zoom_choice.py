"""Choose `foresight` and `patience`, the settings of a search by magnification, on mosaics of held-out photographs."""

from collections.abc import Sequence
from itertools import chain, islice

import torch

from semfov.data.scene import Annotation
from semfov.fit.windows import MosaicFit
from semfov.runs.progress import track
from semfov.runs.window_looking import found_in
from semfov.zoom.episode import find_everything
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.looks import Window, WindowLook, WindowLooks
from train.zoom_slices import look_for_slice

_FORESIGHTS = (0.0, 0.1, 0.2, 0.35, 0.5)
_PATIENCES = (1.5, 1.9, 2.3, 2.8, 3.5)


@torch.inference_mode()
def choose_foresight(model: GlimpseEvidence, fit: MosaicFit, kinds: Sequence[str]) -> list[list[str]]:
    """Set the `foresight` of the survey to the one with which most objects are found.

    The recall is a mean over passes, from the first to one more than a mosaic has photographs. As the kinds of mosaics
    differ in difficulty, the recall of each kind is divided by the highest one that any `foresight` reaches.
    """
    chosen, opened = [fit.mosaics[kind] for kind in kinds], [fit.opened(kind) for kind in kinds]
    objects = [[mosaics.annotation(n) for n in range(len(mosaics))] for mosaics in chosen]
    rows = [["foresight", *(f"recall, {name}" for name in kinds)]]
    recalls: dict[float, list[float]] = {}
    for value in track(_FORESIGHTS, "choosing foresight", "value"):
        model.survey.foresight = value
        recalls[value] = [
            _mean_recall(model, looks, annotations, len(mosaics.tiles(0)) + 1)
            for looks, annotations, mosaics in zip(opened, objects, chosen, strict=True)
        ]
        rows.append([f"{value:g}", *(f"{recall:.4f}" for recall in recalls[value])])
        for source in chain.from_iterable(opened):
            source.save()
    most = [max(*values, 1e-9) for values in zip(*recalls.values(), strict=True)]
    share = {value: sum(r / m for r, m in zip(by_kind, most, strict=True)) for value, by_kind in recalls.items()}
    model.survey.foresight = max(share, key=share.__getitem__)
    return rows


@torch.inference_mode()
def choose_patience(model: GlimpseEvidence, fit: MosaicFit) -> list[list[str]]:
    """Set `patience` to the value with which a class is found soonest.

    The measure is the mean number of passes until a look at a photograph that shows the class.
    """
    near, opened = fit.mosaics["judged"], fit.opened("judged")
    slots = [[Window.around(looks.lattice, tile.slot) for tile in near.tiles(n)] for n, looks in enumerate(opened)]
    passes: dict[float, float] = {}
    for value in track(_PATIENCES, "choosing patience", "value"):
        model.patience = value
        passes[value] = _mean_passes(model, opened, slots, fit.eye.detector.least)
        for source in opened:
            source.save()
    model.patience = min(passes, key=passes.__getitem__)
    return [["patience", "passes to the first hit"], *([f"{value:g}", f"{n:.3f}"] for value, n in passes.items())]


def _mean_recall(
    model: GlimpseEvidence, sources: Sequence[WindowLooks], objects: Sequence[Annotation], passes: int
) -> float:
    """Compute the mean recall over passes of an exploration that looks for all objects."""
    total = 0
    for looks, annotation in zip(sources, objects, strict=True):
        history: list[WindowLook] = []
        path = find_everything(looks, model)
        count = 0
        for _ in range(passes):
            step = next(path, None)
            if step is not None:
                history.append(step.look)
                count = int(found_in(history, annotation).sum())
            # When no window is left, the number of found objects stays the same for the remaining passes.
            total += count
    return total / max(passes * sum(len(annotation.boxes) for annotation in objects), 1)


def _mean_passes(
    model: GlimpseEvidence, sources: Sequence[WindowLooks], slots: Sequence[Sequence[Window]], least: float
) -> float:
    """Compute the mean number of passes until a look at a photograph that shows the target."""
    counts = []
    for looks, photographs in zip(sources, slots, strict=True):
        presence = torch.stack([look.show for look in looks.see(photographs)]) >= least
        for target in (presence.any(0).nonzero()[:, 0] + 1).tolist():
            path = look_for_slice(looks, model, target, photographs, least)
            counts.append(sum(1 for _ in islice(path, len(photographs) + 1)))
    return sum(counts) / max(len(counts), 1)
