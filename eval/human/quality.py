"""What more views of a picture bring: the density from one pass of the detector, and from six."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor
from tqdm import tqdm

from eval.human.viewing import write_tables
from semfov.data.pictures import Pictures
from semfov.detection.detector import Detector
from semfov.detection.load import load_detector
from semfov.errors import check
from semfov.fit.gaze import GazeFit, score
from semfov.fit.gaze_folds import Fold, FoldStore
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.gaze.saliency.views import picture_terms
from semfov.human.viewing import Viewed, ViewingData, features_of, look
from semfov.io.code import modules_digest
from semfov.io.ranges import Range
from semfov.kinds import Quality
from semfov.metrics.episodes import standard_error
from semfov.runs.config import DetectorConfig
from semfov.runs.setup import detector_options
from semfov.runs.tables import plus_minus, table
from semfov.runs.workers import prepare_worker

QUALITIES: tuple[Quality, ...] = ("quick", "best")


@dataclass(frozen=True)
class QualityConfig(ViewingData):
    """Comparison of one view of each picture with several, on pictures that the models were fitted without.

    Args:
        detectors: detectors whose feature maps are read, each by name or by settings.
        folds: number of folds into which the pictures are divided.
        judged: number of folds whose pictures are predicted, each by a model that was fitted to the others.
        fit: how the models are fitted.
        page: page with a place for the table (`<!-- table quality -->` to `<!-- end -->`); none: it is left alone.
        out: folder for the table, and for the models of the folds.
    """

    detectors: tuple[str | DetectorConfig, ...] = ("yolox-nano", "nanodet-plus-m-1.5x")
    folds: Annotated[int, Range(2, 1000)] = 5
    judged: Annotated[int, Range(1, 1000)] = 5
    fit: GazeFit = field(default_factory=partial(GazeFit, saccade_epochs=0))
    page: Path | None = None
    out: Path = Path("runs/human_quality")


def compare_qualities(config: QualityConfig) -> None:
    """Fit models without each judged fold, predict its pictures in both ways, and write the table."""
    check(len(config.fixations) > 0, "fixations", "at least one file", "none")
    prepare_worker()
    rows: dict[str, dict[str, Tensor]] = {}
    for named in config.detectors:
        settings = DetectorConfig(name=named) if isinstance(named, str) else named
        detector = load_detector(settings.name, **detector_options(settings))
        source = features_of(detector)
        store = FoldStore(config.out, {**source.what, "data": config.fingerprint})
        groups = cache(partial(look, config, source))
        parts: dict[str, list[Tensor]] = {}
        for number in range(min(config.judged, config.folds)):
            fold = Fold(groups, number, config.folds, config.fit)
            what = {"code": modules_digest(__name__, "semfov.gaze.saliency.views"), **fold.what}
            scores = store.kept(
                f"{settings.name} qualities {fold.title}", what, partial(_scores, detector, config, store, fold)
            )
            for name, tensor in scores.items():
                parts.setdefault(name, []).append(tensor)
        rows[settings.name] = {name: torch.cat(of_folds) for name, of_folds in parts.items()}
    lines = quality_table(rows)
    write_tables("\n".join([*lines, ""]), {"quality": lines}, config.out, config.page)


def _scores(detector: Detector, config: QualityConfig, store: FoldStore, fold: Fold) -> dict[str, Tensor]:
    """Score both ways on the held-out pictures of a fold: NSS and gain over the centre bias, `(P, 2)`.

    Args:
        detector: the detector.
        config: the pictures.
        store: keeps the model of the fold.
        fold: the fold.

    Returns:
        The scores by way and number of the data set.
    """
    model = store.model(detector.name, fold)
    parts: dict[str, list[Tensor]] = {}
    for group, (_, held_out) in zip(fold.groups(), fold.split, strict=True):
        bias = FixationDensity({"none": 1}, centre=fold.centres[group.source])
        for picture in tqdm(held_out, desc=f"{detector.name}, {fold.title}", unit="picture", leave=False):
            image = _image(config.pictures[group.source], group, picture)
            for quality in QUALITIES:
                terms = picture_terms(detector, image, model, quality=quality).terms
                (of_map,) = score(model, group, [terms["map"]], [picture], conditional=False)
                flat = torch.zeros_like(terms["map"])
                (of_centre,) = score(bias, group, [flat], [picture], conditional=False)
                gain = of_map[:, 2] - of_centre[:, 2]
                parts.setdefault(f"{quality}/{group.source}", []).append(torch.stack([of_map[:, 0], gain], 1))
    return {name: torch.cat(of_pictures) for name, of_pictures in parts.items()}


def _image(root: Path, group: Viewed, picture: int) -> Tensor:
    """Read a picture of a group, `(3, H, W)`."""
    return Pictures(root, [group.people[picture][0].picture], ())[0].image


def quality_table(rows: Mapping[str, Mapping[str, Tensor]]) -> list[str]:
    """Make the table: NSS and gain by data set for each detector and way, and their paired differences.

    Args:
        rows: scores `(P, 2)` by way and number of the data set, by name of the detector.

    Returns:
        The lines.
    """
    sources = sorted({int(name.rpartition("/")[2]) for scores in rows.values() for name in scores})
    head = ["", *(f"{figure}, {source + 1}" for source in sources for figure in ("NSS", "gain"))]
    body = []
    for detector, scores in rows.items():
        of_quality = {name: [scores[f"{name}/{source}"] for source in sources] for name in QUALITIES}
        body += [[f"{detector}, {name}", *_figures(values)] for name, values in of_quality.items()]
        differences = [scores[f"best/{source}"] - scores[f"quick/{source}"] for source in sources]
        body.append([f"{detector}, best less quick", *_figures(differences)])
    return table([head, *body])


def _figures(of_sources: Sequence[Tensor]) -> list[str]:
    """Write means of scores `(P, 2)` with standard errors over pictures."""
    cells = []
    for scores in of_sources:
        columns = scores.double().numpy().T
        cells += [plus_minus(float(column.mean()), float(standard_error(column)), 3) for column in columns]
    return cells
