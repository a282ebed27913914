"""The next fixation, predicted from the sharp picture or from what a fovea has shown at the fixations so far."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from eval.human.folds import in_first
from semfov.belief.grid import Grid
from semfov.data.pictures import Pictures
from semfov.detection.detections import Detections
from semfov.detection.feature_maps import FeatureMaps
from semfov.fit.gaze import maps_of, score
from semfov.fit.gaze_folds import Fold, FoldStore
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.gaze.saliency.glimpses import features_so_far
from semfov.human.viewing import Events, MapSource
from semfov.io.code import modules_digest
from semfov.metrics.episodes import standard_error
from semfov.runs.tables import plus_minus, table
from semfov.sensor.foveation import foveate

FOVEA = 100 / 640
"""Width of the fovea, in longer sides of the picture."""
CELLS = (8, 6)
"""Columns and rows of the grid in whose cells the views are fixated."""
TERMS = {"all terms": (), "without oculomotor biases": ("oculomotor biases",)}
"""Rows of the table, and the terms that they leave out."""


def glimpsed(
    name: str, source: MapSource, root: Path, store: FoldStore, folds: Sequence[Fold], pictures: Sequence[int]
) -> dict[str, Tensor]:
    """Scores of the sharp picture and of what was seen so far, `(P, 3)` by name, of held-out pictures of data set 1."""
    rows: dict[str, list[Tensor]] = {}
    for picture in tqdm(pictures, desc="glimpses", unit="picture"):
        fold = folds[picture % len(folds)]  # the one that holds it out

        def scores(picture: int = picture, fold: Fold = fold) -> dict[str, Tensor]:
            model, (group, place) = store.model(name, fold), in_first(fold, picture)
            views, fixations = views_of(Pictures(root, [group.people[place][0].picture], ())[0].image, source)
            seen = partial(so_far, model, views, fixations, group.size)
            maps: dict[str, Tensor | Callable[[Events], Tensor]] = {
                "sharp picture": maps_of(model, group, [place])[0],
                "seen so far": seen,
            }
            return {
                f"{term}: {row}": each
                for row, one in maps.items()
                for term, each in zip(
                    TERMS, score(model, group, [one], [place], conditional=True, without=[*TERMS.values()]), strict=True
                )
            }

        what = {"name": name, "picture": picture, "code": modules_digest(__name__), **fold.what}
        for row, each in store.kept(f"{name} glimpses {picture}", what, scores).items():
            rows.setdefault(row, []).append(each)
    return {row: torch.cat(parts) for row, parts in rows.items()}


@torch.inference_mode()
def views_of(image: Tensor, source: MapSource) -> tuple[FeatureMaps, Tensor]:
    """Compute maps of foveated views of a picture `(3, H, W)`, and where each was fixated, `(V, 2)` in pixels."""
    height, width = image.shape[-2:]
    fixations = Grid(*CELLS, (width, height)).centres
    seen = [source.maps(foveate(image[None], each[None], sigma=FOVEA * max(width, height))) for each in fixations]
    maps = {name: torch.cat([each.maps[name] for each in seen]) for name in source.layers}
    return replace(seen[0], maps=maps, detections=Detections.empty(0, 0)), fixations


def so_far(
    model: FixationDensity, views: FeatureMaps, fixations: Tensor, size: tuple[int, int], events: Events
) -> Tensor:
    """Return the map of what was seen before each event, `(E, rows, columns)`."""
    with torch.inference_mode():
        parts = [model.map(features_so_far(views, fixations, each), size) for each in events.before.split(8)]
    return torch.cat(parts)


def glimpses_table(scores: Mapping[str, Tensor]) -> list[str]:
    """NSS and bits above a uniform density, and their paired differences, with standard errors over pictures."""
    body = []
    for term in TERMS if scores else ():
        sharp, seen = (scores[f"{term}: {row}"][:, [0, 2]].double() for row in ("sharp picture", "seen so far"))
        columns = [each for values in (sharp, seen, sharp - seen) for each in values.T.numpy()]
        body.append([term, *(plus_minus(float(each.mean()), float(standard_error(each)), 3) for each in columns)])
    head = ["sharp picture: NSS", "bits", "seen so far: NSS", "bits", "sharp less seen: NSS", "bits"]
    return table([["", *head], *body])
