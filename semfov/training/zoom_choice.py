"""Choosing how evidence by magnification is gone by, on mosaics that were held out: `foresight` and `patience`."""

from collections.abc import Iterator
from itertools import islice

import torch
from tqdm import tqdm

from semfov.data.mosaics import Mosaics
from semfov.experiments.zoom import SHOWN, found_in
from semfov.experiments.zoom_store import GlanceStore, StoredGlances
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import ZoomEye
from semfov.zoom.glances import Glances, LiveGlances, around
from semfov.zoom.lattice import Lattice
from semfov.zoom.search import find_everything, look_for

FORESIGHTS = (0.0, 0.1, 0.2, 0.35, 0.5)
PATIENCES = (1.5, 1.9, 2.3, 2.8, 3.5)


@torch.inference_mode()
def choose(model: GlimpseEvidence, eye: ZoomEye, near: Mosaics, far: Mosaics, store: GlanceStore) -> list[list[str]]:
    """Set `foresight` to the one by which most is found, and `patience` to the one by which a class is found soonest.

    Found is the mean recall over as many passes as a mosaic has photographs, and one; in kinds of mosaics that differ
    in how much there is to find, as a share of the most that any foresight finds. Soonest is the mean number of passes
    until a photograph is looked at that shows the class.

    Args:
        model: to set both of.
        eye: that looks.
        near: mosaics of few photographs.
        far: mosaics of many.
        store: where looks are kept.

    Returns:
        A table of what was tried.
    """
    rows = [["setting", "value", "recall, near", "recall, far", "passes to the first hit"]]
    recalls: dict[float, list[float]] = {}
    for value in tqdm(FORESIGHTS, desc="choosing foresight", unit="value", dynamic_ncols=True):
        model.foresight = value
        recalls[value] = [_recall(model, eye, mosaics, store) for mosaics in (near, far)]
        rows.append(["foresight", f"{value:g}", *(f"{recall:.4f}" for recall in recalls[value]), ""])
    most = [max(values) for values in zip(*recalls.values(), strict=True)]
    model.foresight = max(
        recalls, key=lambda value: sum(r / max(m, 1e-9) for r, m in zip(recalls[value], most, strict=True))
    )
    passes: dict[float, float] = {}
    for value in tqdm(PATIENCES, desc="choosing patience", unit="value", dynamic_ncols=True):
        model.patience = value
        passes[value] = _first_hit(model, eye, near, store)
        rows.append(["patience", f"{value:g}", "", "", f"{passes[value]:.3f}"])
    model.patience = min(passes, key=passes.__getitem__)
    return rows


def looks_at(eye: ZoomEye, mosaics: Mosaics, store: GlanceStore) -> Iterator[tuple[int, StoredGlances]]:
    """Looks at each mosaic, kept when they were used."""
    lattice = Lattice.over(mosaics.size, eye.detector.input_size, finest=eye.finest)
    for index in range(len(mosaics)):

        def live(index: int = index) -> Glances:
            return LiveGlances(eye, eye.open(mosaics[index].image))

        glances = StoredGlances(lattice, live, store, mosaics.digest(index))
        yield index, glances
        glances.save()


def _recall(model: GlimpseEvidence, eye: ZoomEye, mosaics: Mosaics, store: GlanceStore) -> float:
    """Mean share of the objects of all mosaics that were found, over the passes."""
    found, objects = 0, 0
    passes = len(mosaics.tiles(0)) + 1
    for index, glances in looks_at(eye, mosaics, store):
        annotation, seen, count = mosaics.annotation(index), [], 0
        looks = find_everything(glances, model)
        for turn in range(passes):
            for glance, _ in islice(looks, 1):
                seen.append(glance)
                count = int(found_in(seen, annotation).sum())
            # Where nothing is left to look at, what was found stays.
            found += count
            objects += len(annotation.boxes) if turn == 0 else 0
    return found / max(objects * passes, 1)


def _first_hit(model: GlimpseEvidence, eye: ZoomEye, mosaics: Mosaics, store: GlanceStore) -> float:
    """Mean passes until a photograph is looked at that shows a class, over the classes that one shows."""
    counts = []
    for index, glances in looks_at(eye, mosaics, store):
        slots = [around(glances.lattice, tuple(map(float, t.slot))) for t in mosaics.tiles(index)]  # type: ignore[arg-type]
        shown = torch.stack([glance.show for glance in glances.see(slots)]) >= SHOWN
        for target in (shown.any(0).nonzero()[:, 0] + 1).tolist():
            looks = look_for(glances, model, target, slices=slots)
            counts.append(sum(1 for _ in islice(looks, len(slots) + 1)))
    return sum(counts) / max(len(counts), 1)
