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

_SHARP = "sharp picture"
_SEEN = "seen so far"
_HEAD = ["", f"{_SHARP}: NSS", "bits", f"{_SEEN}: NSS", "bits", "sharp less seen: NSS", "bits"]


def glimpsed(
    name: str,
    source: MapSource,
    root: Path,
    store: FoldStore,
    folds: Sequence[Fold],
    pictures: Sequence[int],
) -> dict[str, Tensor]:
    """Score a model on the sharp picture, and on what a fovea has seen so far, of held-out pictures of data set 1.

    Args:
        name: name of the model.
        source: gives the maps that it reads.
        root: folder of the pictures.
        store: keeps models and scores.
        folds: the folds; picture n is held out by fold n modulo their number.
        pictures: numbers of P pictures.

    Returns:
        The scores `(P, 3)`, by term and map (`_row`).
    """
    scores: dict[str, list[Tensor]] = {}
    for picture in tqdm(pictures, desc="glimpses", unit="picture"):
        fold = folds[picture % len(folds)]
        what = {"name": name, "picture": picture, "code": modules_digest(__name__), **fold.what}
        compute = partial(_scores, name, source, root, store, fold, picture)
        for row, of_picture in store.kept(f"{name} glimpses {picture}", what, compute).items():
            scores.setdefault(row, []).append(of_picture)
    return {row: torch.cat(of_pictures) for row, of_pictures in scores.items()}


def _scores(name: str, source: MapSource, root: Path, store: FoldStore, fold: Fold, picture: int) -> dict[str, Tensor]:
    """Score a model on one picture, `(1, 3)` by term and map."""
    model = store.model(name, fold)
    group, place = in_first(fold, picture)
    image = Pictures(root, [group.people[place][0].picture], ())[0].image
    views, fixations = views_of(image, source)
    maps: dict[str, Tensor | Callable[[Events], Tensor]] = {
        _SHARP: maps_of(model, group, [place])[0],
        _SEEN: partial(so_far, model, views, fixations, group.size),
    }
    scores = {}
    for name_of_map, of_map in maps.items():
        by_term = score(model, group, [of_map], [place], conditional=True, without=[*TERMS.values()])
        for term, of_term in zip(TERMS, by_term, strict=True):
            scores[_row(term, name_of_map)] = of_term
    return scores


def _row(term: str, name_of_map: str) -> str:
    return f"{term}: {name_of_map}"


@torch.inference_mode()
def views_of(image: Tensor, source: MapSource) -> tuple[FeatureMaps, Tensor]:
    """Compute maps of foveated views of a picture `(3, H, W)`, and where each was fixated, `(V, 2)` in pixels."""
    height, width = image.shape[-2:]
    sigma = FOVEA * max(width, height)
    fixations = Grid(*CELLS, (width, height)).centres
    views = [source.maps(foveate(image[None], fixation[None], sigma=sigma)) for fixation in fixations]
    maps = {name: torch.cat([view.maps[name] for view in views]) for name in source.layers}
    return replace(views[0], maps=maps, detections=Detections.empty(0, 0)), fixations


def so_far(
    model: FixationDensity,
    views: FeatureMaps,
    fixations: Tensor,
    size: tuple[int, int],
    events: Events,
) -> Tensor:
    """Return the map of what was seen before each event, `(E, rows, columns)`."""
    with torch.inference_mode():
        parts = [model.map(features_so_far(views, fixations, each), size) for each in events.before.split(8)]
    return torch.cat(parts)


def glimpses_table(scores: Mapping[str, Tensor]) -> list[str]:
    """Write NSS and bits above a uniform density, and their paired differences, with standard errors over pictures."""
    rows = [_HEAD]
    for term in TERMS if scores else ():
        sharp = scores[_row(term, _SHARP)][:, [0, 2]].double()  # (P, 2), NSS and bits
        seen = scores[_row(term, _SEEN)][:, [0, 2]].double()
        columns = torch.cat([sharp, seen, sharp - seen], 1).T.numpy()
        rows.append([term, *(plus_minus(float(c.mean()), float(standard_error(c)), 3) for c in columns)])
    return table(rows)
