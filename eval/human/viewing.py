"""Free viewing: how well models predict where people look, on folds of pictures and people they were fitted without."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from eval.comparison.saliency import SALIENCY_CLASSES
from eval.human.folds import Maps, StudiedFold, in_first, spread, viewed_by
from eval.human.glimpses import glimpsed, glimpses_table
from eval.page.origin import END, PLACE
from semfov.detection.detections import Detections
from semfov.detection.feature_maps import FeatureMaps
from semfov.detection.load import load_detector
from semfov.detection.placement import Placement
from semfov.errors import check
from semfov.fit.gaze import GazeFit, maps_of
from semfov.fit.gaze_folds import CENTRE, ROWS, Fold, FoldStore, Groups, Scores
from semfov.gaze.saliency.cells import cell_saliency
from semfov.gaze.saliency.fixation_density import cells_of
from semfov.human.viewing import MapSource, Viewed, ViewingData, features_of, look
from semfov.io.code import modules_digest
from semfov.io.files import write_text
from semfov.io.ranges import Range, Whole
from semfov.metrics.episodes import standard_error
from semfov.metrics.scanpath import cluster_labels, multimatch, scanmatch, sequence_score, time_delay_embedding
from semfov.runs.config import DetectorConfig
from semfov.runs.setup import detector_options
from semfov.runs.tables import plus_minus, table
from semfov.runs.workers import prepare_worker

_Array = NDArray[np.float64]

PEOPLE = "inter-observer"
_BANDWIDTH = 0.08
"""Bandwidth of the clusters of fixations that make up the letters of a sequence, in longer sides of the picture."""
_OF_ONE_MAP = {"readouts": 1, "units": 4}
"""Settings of the readout of a saliency map, which is one channel."""


@dataclass(frozen=True)
class ViewingConfig(ViewingData):
    """Comparison of models with people who view the same pictures without a task.

    Args:
        detectors: detectors whose feature maps are read, each by name or by settings. Without any, and without
            saliency, people are compared with the centre bias alone.
        saliency: saliency models.
        studied: number of the detector that is also fitted to half of the people, and to the first data set alone.
        folds: number of folds; every picture is held out once.
        sequences: number of held-out pictures of the first data set for which scanpaths are drawn.
        glimpses: number of held-out pictures of the first data set at which a fovea looks.
        fit: how the models are fitted.
        page: page with places for the tables (`<!-- table viewing -->` to `<!-- end -->`); none: it is left alone.
        out: folder for the tables, and for the models and scores of the folds.
    """

    detectors: tuple[str | DetectorConfig, ...] = ("yolov3-tiny", "yolox-nano", "nanodet-plus-m-1.5x")
    saliency: tuple[Literal["itti-koch", "vocus2"], ...] = ("itti-koch", "vocus2")
    studied: Whole = 1
    folds: Annotated[int, Range(2, 1000)] = 5
    sequences: Whole = 50
    glimpses: Whole = 20
    page: Path | None = None
    fit: GazeFit = field(default_factory=GazeFit)
    out: Path = Path("runs/human_viewing")


def compare_viewing(config: ViewingConfig) -> None:
    """Fit all models to the folds of the pictures, and write the tables."""
    check(len(config.fixations) > 0, "fixations", "at least one file", "none")
    is_there = config.studied < len(config.detectors) or not config.detectors
    check(is_there, "studied", "the number of a detector", config.studied)
    prepare_worker()
    detectors = [DetectorConfig(name=each) if isinstance(each, str) else each for each in config.detectors]
    made: dict[str, Callable[[], MapSource]] = {name: partial(_saliency, name) for name in config.saliency}
    made |= {each.name: partial(_features, each) for each in detectors}
    data, fit, numbers = config.fingerprint, config.fit, range(config.folds)
    rows: dict[str, Scores] = {}
    splits: dict[str, Scores] = {}
    drawn: dict[str, list[dict[str, float]]] = {}
    seen: dict[str, Tensor] = {}
    for name, source in made.items():
        opened = source()
        groups, store = cache(partial(look, config, opened)), FoldStore(config.out, {**opened.what, "data": data})
        own = replace(fit, **_OF_ONE_MAP) if name in config.saliency else fit
        folds = [Fold(groups, number, config.folds, own) for number in numbers]
        rows[name] = store.scores(name, _bar(folds, name))
        if detectors and name == detectors[config.studied].name:
            splits[f"{name}: all data sets, all people"] = rows[name]
            alone = replace(fit, saccade_epochs=0)
            if len(config.fixations) > 1:
                lone = [StudiedFold(groups, number, config.folds, alone, only=0) for number in numbers]
                scores = store.scores(f"{name} first data set", _bar(lone, "first data set"))
                splits[f"{name}: the first data set alone"] = scores
            splits[f"{name}: half of the people, scored by the others"] = _by_people(
                store, name, groups, alone, config.folds
            )
            if config.sequences:
                drawn |= _sequences(name, store, folds, config)
            if config.glimpses:
                chosen = spread(len(config.people(0)), config.glimpses)
                seen = glimpsed(name, opened, config.pictures[0], store, folds, chosen)
    plain, store = cache(partial(look, config, _blank())), FoldStore(config.out, {"data": data})
    known: dict[str, Maps] = {CENTRE: "none", PEOPLE: "other people"}
    for name, maps in known.items():
        folds = [StudiedFold(plain, number, config.folds, fit, maps=maps) for number in numbers]
        rows[name] = store.scores(name, _bar(folds, name))
    tables = {
        "viewing": viewing_table(rows),
        "viewing terms": terms_table(rows),
        "viewing splits": splits_table(splits),
        "viewing glimpses": glimpses_table(seen),
        "viewing sequences": sequences_table(drawn),
    }
    text = "\n".join(["\n".join([f"## {name}", "", *lines, ""]) for name, lines in tables.items()])
    write_tables(text, tables, config.out, config.page)


def _bar(folds: Sequence[Fold], name: str) -> Iterator[Fold]:
    yield from tqdm(folds, desc=name, unit="fold")


def _features(detector: DetectorConfig) -> MapSource:
    return features_of(load_detector(detector.name, **detector_options(detector)))


def _saliency(name: str) -> MapSource:
    """Compute the saliency map of a model over the cells of pictures, as if it were a feature map."""
    model = SALIENCY_CLASSES[name]()

    def maps(image: Tensor) -> FeatureMaps:
        height, width = image.shape[-2:]
        rows, columns = cells_of((height, width))
        cells = cell_saliency(model(image), columns, rows).unflatten(1, (1, rows, columns))
        return covering({name: cells}, (height, width))

    return MapSource((name,), maps, {"saliency": name})


def covering(maps: Mapping[str, Tensor], size: tuple[int, int]) -> FeatureMaps:
    """Compute maps `(B, C, rows, columns)` over the whole of pictures of `(height, width)`, without detections."""
    rows, columns = next(iter(maps.values())).shape[-2:]
    placement = Placement((size[1], size[0]), (columns / size[1], rows / size[0]), (0, 0))
    return FeatureMaps(maps, (columns, rows), placement, Detections.empty(0, 0))


def _blank() -> MapSource:
    """Give every picture a map of zeros, for models that read none."""

    def maps(image: Tensor) -> FeatureMaps:
        height, width = image.shape[-2:]
        return covering({"none": torch.zeros(1, 1, *cells_of((height, width)))}, (height, width))

    return MapSource(("none",), maps, {"none": 0})


def _by_people(store: FoldStore, name: str, groups: Groups, fit: GazeFit, count: int) -> Scores:
    """Scores by half of the people on held-out pictures, of models that were fitted to the other half."""

    def half(part: int) -> list[Viewed]:
        order = [sorted({p.subject for some in group.people for p in some}, key=_in_order) for group in groups()]
        return [viewed_by(group, every[part % 2 :: 2]) for group, every in zip(groups(), order, strict=True)]

    file = f"{name} half of the people"
    folds = [
        StudiedFold(cache(partial(half, number)), number, count, fit, judges=partial(half, number + 1))
        for number in range(count)
    ]
    return store.scores(file, _bar(folds, file))


def _in_order(subject: str) -> tuple[int, str]:
    return (int(subject), "") if subject.isdecimal() else (0, subject)


def viewing_table(rows: Mapping[str, Scores]) -> list[str]:
    """Each map with the centre bias, and with oculomotor biases too, by data set."""
    sources = sorted({source for _, source in rows[CENTRE]})
    head = ["", *(f"{figure}, {source + 1}" for source in sources for figure in ("NSS", "AUC", "gain"))]
    body = [[CENTRE, *(cell for source in sources for cell in _figures(rows[PEOPLE], CENTRE, source))]]
    for row, words in (("map and centre bias", "{}"), ("all terms", "{}, with oculomotor biases")):
        for name, scores in rows.items():
            if (row, sources[0]) in scores and (name, row) != (CENTRE, "map and centre bias"):
                cells = [cell for source in sources for cell in _figures(scores, row, source)]
                body.append([words.format(name), *cells])
    return table([head, *body])


def terms_table(rows: Mapping[str, Scores]) -> list[str]:
    """NSS and gain on the first data set with and without each term."""
    terms = (*ROWS[False], *ROWS[True])
    head = ["", *(f"{term}: {figure}" for term in terms for figure in ("NSS", "gain"))]
    body = []
    for name, scores in rows.items():
        if name not in (CENTRE, PEOPLE):
            figures = [_figures(scores, term, 0) if (term, 0) in scores else ["", "", ""] for term in terms]
            body.append([name, *(cell for nss, _, gain in figures for cell in (nss, gain))])
    return table([head, *body])


def splits_table(splits: Mapping[str, Scores]) -> list[str]:
    """Return the studied detector, by what its model was fitted to."""
    sources = sorted({source for scores in splits.values() for _, source in scores})
    head = ["fitted to", *(f"{figure}, {source + 1}" for source in sources for figure in ("NSS", "AUC", "gain"))]
    body = [
        [name, *(cell for source in sources for cell in _figures(scores, "map and centre bias", source))]
        for name, scores in splits.items()
    ]
    return table([head, *body])


def _figures(scores: Scores, row: str, source: int) -> list[str]:
    """NSS, AUC and information gain over the centre bias of the data set, with standard errors over pictures."""
    own, base = scores[row, source].double().numpy(), scores[CENTRE, source].double().numpy()
    columns = own[:, 0], own[:, 1], own[:, 2] - base[:, 2]
    return [plus_minus(float(each.mean()), float(standard_error(each)), 3) for each in columns]


def write_tables(text: str, tables: Mapping[str, list[str]], out: Path, page: Path | None) -> None:
    """Print tables, write them as `summary.md`, and put them into a page.

    Args:
        text: the tables in one text.
        tables: the lines of each table by its name on the page.
        out: folder of the study.
        page: page of the site; None for none.
    """
    print(text)
    written = [out / "summary.md"]
    write_text(written[0], text)
    if page is not None:
        write_text(page, filled(page.read_text(encoding="utf-8"), tables))
        written.append(page)
    print("written:", *(f"  {path}" for path in written), sep="\n")


def filled(page: str, tables: Mapping[str, Sequence[str]]) -> str:
    """Replace the tables of these names in a page."""

    def fill(match: re.Match[str]) -> str:
        lines = tables.get(match["name"])
        return match[0] if lines is None else "\n\n".join((f"<!-- table {match['name']} -->", "\n".join(lines), END))

    return PLACE.sub(fill, page)


SEQUENCES = ("sequence score", "MultiMatch", "ScanMatch", "time delay embedding")


def _sequences(
    name: str, store: FoldStore, folds: Sequence[Fold], config: ViewingConfig
) -> dict[str, list[dict[str, float]]]:
    """Measures of drawn scanpaths and of people against the other people, on held-out pictures of the first data set.

    A drawn scanpath has the first fixation and the length of a person's, and is compared with all others' but theirs.
    """
    number = len(config.people(0))
    rows: dict[str, list[dict[str, float]]] = {name: [], PEOPLE: []}
    what = {"name": name, "fit": config.fit.plain(), "folds": config.folds, "code": modules_digest(__name__)}
    for picture in tqdm(spread(number, config.sequences), desc="sequences", unit="picture"):

        def measured(picture: int = picture) -> dict[str, Tensor]:
            fold = folds[picture % config.folds]  # the one that holds it out
            model = store.model(name, fold)
            group, place = in_first(fold, picture)
            terms = {"map": maps_of(model, group, [place])[0], CENTRE: model.centre_bias(group.size)[None]}
            paths = group.paths[place]
            start, longest = torch.stack([path[0] for path in paths]), max(map(len, paths))
            made = model.sample(terms, group.size, start, longest, torch.Generator().manual_seed(picture))
            people = [path.double().numpy() for path in paths]
            drawn = [one[: len(path)].double().numpy() for one, path in zip(made, paths, strict=True)]
            measures = (beside_others(each, people, group.size) for each in (drawn, people))
            return {row: torch.tensor([*each.values()]) for row, each in zip(rows, measures, strict=True)}

        kept = store.kept(f"{name} sequences {picture}", {**what, "picture": picture}, measured)
        for row, several in rows.items():
            several.append(dict(zip(SEQUENCES, kept[row].tolist(), strict=True)))
    return rows


def beside_others(ours: Sequence[_Array], people: Sequence[_Array], size: tuple[int, int]) -> dict[str, float]:
    """Means of the measures over pairs of a scanpath and that of another person than its own."""
    every, width = np.concatenate(people), (size[1], size[0])
    ends = np.cumsum([0, *map(len, ours), *map(len, people)])
    labels = cluster_labels(np.concatenate([*ours, every]), every, _BANDWIDTH * max(size)).tolist()
    words = [labels[start:end] for start, end in pairwise(ends)]
    pairs = [(i, j) for i in range(len(ours)) for j in range(len(people)) if i != j]
    values = np.array(
        [
            (
                sequence_score(words[i], words[len(ours) + j]),
                multimatch(ours[i], people[j], width).mean,
                scanmatch(_within(ours[i], width), _within(people[j], width), width),
                time_delay_embedding(ours[i], people[j]) / max(size),
            )
            for i, j in pairs
        ]
    )
    return dict(zip(SEQUENCES, np.nanmean(values, 0).tolist(), strict=True))


def _within(path: _Array, size: tuple[int, int]) -> _Array:
    return path.clip(0, np.array(size) - 1)


def sequences_table(drawn: Mapping[str, Sequence[Mapping[str, float]]]) -> list[str]:
    """Means over pictures of the measures of scanpaths against those of other people."""
    body = []
    for name, pictures in drawn.items():
        columns = [np.array([each[measure] for each in pictures]) for measure in SEQUENCES]
        body.append([name, *(plus_minus(float(c.mean()), float(standard_error(c)), 3) for c in columns)])
    return table([["", *SEQUENCES], *body])
