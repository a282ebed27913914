"""Free viewing: how well models predict where people look, on folds of pictures and people they were fitted without."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
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
_MAP = "map and centre bias"
"""Row of the scores of a map without oculomotor biases."""
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


class _Results:
    """What the tables show, by model."""

    def __init__(self) -> None:
        self.scores: dict[str, Scores] = {}
        self.splits: dict[str, Scores] = {}
        self.sequences: dict[str, list[dict[str, float]]] = {}
        self.glimpses: dict[str, Tensor] = {}

    def tables(self) -> dict[str, list[str]]:
        """Write the tables, each under its name on the page."""
        return {
            "viewing": viewing_table(self.scores),
            "viewing terms": terms_table(self.scores),
            "viewing splits": splits_table(self.splits),
            "viewing glimpses": glimpses_table(self.glimpses),
            "viewing sequences": sequences_table(self.sequences),
        }


class _Compared:
    """A model that reads the maps of a source, fitted once for each fold of the pictures.

    Args:
        config: pictures, people, and the number of folds.
        name: name of the model in the tables.
        source: gives the maps.
        fit: how the model is fitted.
        fingerprint: fingerprint of pictures and people.
    """

    def __init__(
        self,
        config: ViewingConfig,
        name: str,
        source: MapSource,
        fit: GazeFit,
        fingerprint: Sequence[str],
    ) -> None:
        self.config = config
        self.name = name
        self.source = source
        # Pictures are looked at once, and only if a fold is not stored yet.
        self.groups: Groups = cache(partial(look, config, source))
        self.store = FoldStore(config.out, {**source.what, "data": fingerprint})
        self.folds = [Fold(self.groups, number, config.folds, fit) for number in range(config.folds)]

    def scores(self) -> Scores:
        """Score the model on the held-out pictures of all folds."""
        return self.store.scores(self.name, _bar(self.folds, self.name))

    def splits(self, whole: Scores) -> dict[str, Scores]:
        """Score the model by what it was fitted to; `whole` are its scores (`scores`)."""
        without_saccades = replace(self.config.fit, saccade_epochs=0)
        count = self.config.folds
        splits = {f"{self.name}: all data sets, all people": whole}
        if len(self.config.fixations) > 1:
            folds = [StudiedFold(self.groups, number, count, without_saccades, only=0) for number in range(count)]
            scores = self.store.scores(f"{self.name} first data set", _bar(folds, "first data set"))
            splits[f"{self.name}: the first data set alone"] = scores
        by_people = _by_people(self.store, self.name, self.groups, without_saccades, count)
        splits[f"{self.name}: half of the people, scored by the others"] = by_people
        return splits

    def glimpses(self) -> dict[str, Tensor]:
        """Score the model on what a fovea has seen of some held-out pictures of the first data set."""
        pictures = spread(len(self.config.people(0)), self.config.glimpses)
        return glimpsed(self.name, self.source, self.config.pictures[0], self.store, self.folds, pictures)

    def sequences(self) -> dict[str, list[dict[str, float]]]:
        """Compare drawn scanpaths, and people, with the other people, on held-out pictures of the first data set.

        Returns:
            For the model and for people the measures `SEQUENCES` in each picture.
        """
        config = self.config
        rows: dict[str, list[dict[str, float]]] = {self.name: [], PEOPLE: []}
        what = {"name": self.name, "fit": config.fit.plain(), "folds": config.folds, "code": modules_digest(__name__)}
        pictures = spread(len(config.people(0)), config.sequences)
        for picture in tqdm(pictures, desc="sequences", unit="picture"):
            name = f"{self.name} sequences {picture}"
            stored = self.store.kept(name, {**what, "picture": picture}, partial(self._sequences_in, picture))
            for row, measures in rows.items():
                measures.append(dict(zip(SEQUENCES, stored[row].tolist(), strict=True)))
        return rows

    def _sequences_in(self, picture: int) -> dict[str, Tensor]:
        """Measure drawn scanpaths, and those of people, in one picture.

        A drawn scanpath has the first fixation and the length of a person's, and is compared with all others' but
        theirs.
        """
        fold = self.folds[picture % self.config.folds]  # the one that holds it out
        model = self.store.model(self.name, fold)
        group, place = in_first(fold, picture)
        paths = group.paths[place]
        starts = torch.stack([path[0] for path in paths])
        longest = max(map(len, paths))
        terms = {"map": maps_of(model, group, [place])[0], CENTRE: model.centre_bias(group.size)[None]}
        samples = model.sample(terms, group.size, starts, longest, torch.Generator().manual_seed(picture))
        people = [path.double().numpy() for path in paths]
        drawn = [sample[: len(path)].double().numpy() for sample, path in zip(samples, paths, strict=True)]
        of_model = beside_others(drawn, people, group.size)
        of_people = beside_others(people, people, group.size)
        return {self.name: torch.tensor([*of_model.values()]), PEOPLE: torch.tensor([*of_people.values()])}


def compare_viewing(config: ViewingConfig) -> None:
    """Fit all models to the folds of the pictures, and write the tables."""
    check(len(config.fixations) > 0, "fixations", "at least one file", "none")
    is_there = config.studied < len(config.detectors) or not config.detectors
    check(is_there, "studied", "the number of a detector", config.studied)
    prepare_worker()
    fingerprint = config.fingerprint
    results = _Results()
    for name in config.saliency:
        fit = replace(config.fit, **_OF_ONE_MAP)
        results.scores[name] = _Compared(config, name, _saliency(name), fit, fingerprint).scores()
    for number, entry in enumerate(config.detectors):
        detector = DetectorConfig(name=entry) if isinstance(entry, str) else entry
        compared = _Compared(config, detector.name, _features(detector), config.fit, fingerprint)
        results.scores[detector.name] = compared.scores()
        if number == config.studied:
            results.splits = compared.splits(results.scores[detector.name])
            if config.sequences:
                results.sequences = compared.sequences()
            if config.glimpses:
                results.glimpses = compared.glimpses()
    results.scores |= _reference_scores(config, fingerprint)
    tables = results.tables()
    text = "\n".join(["\n".join([f"## {name}", "", *lines, ""]) for name, lines in tables.items()])
    write_tables(text, tables, config.out, config.page)


def _reference_scores(config: ViewingConfig, fingerprint: Sequence[str]) -> dict[str, Scores]:
    """Score the centre bias, and people by the other people, which read no map."""
    groups: Groups = cache(partial(look, config, _blank()))
    store = FoldStore(config.out, {"data": fingerprint})
    references: dict[str, Maps] = {CENTRE: "none", PEOPLE: "other people"}
    scores = {}
    for name, maps in references.items():
        folds = [StudiedFold(groups, number, config.folds, config.fit, maps=maps) for number in range(config.folds)]
        scores[name] = store.scores(name, _bar(folds, name))
    return scores


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
    """Score half of the people on held-out pictures, with models that were fitted to the other half."""

    def half(part: int) -> list[Viewed]:
        halves = []
        for group in groups():
            subjects = {scanpath.subject for scanpaths in group.people for scanpath in scanpaths}
            halves.append(viewed_by(group, sorted(subjects, key=_in_order)[part % 2 :: 2]))
        return halves

    file = f"{name} half of the people"
    folds = []
    for number in range(count):
        fitted = cache(partial(half, number))
        folds.append(StudiedFold(fitted, number, count, fit, judges=partial(half, number + 1)))
    return store.scores(file, _bar(folds, file))


def _in_order(subject: str) -> tuple[int, str]:
    return (int(subject), "") if subject.isdecimal() else (0, subject)


def viewing_table(rows: Mapping[str, Scores]) -> list[str]:
    """Write each map with the centre bias, and with oculomotor biases too, by data set."""
    sources = sorted({source for _, source in rows[CENTRE]})
    body = [["", *_headings(sources)], [CENTRE, *_cells(rows[PEOPLE], CENTRE, sources)]]
    for name, scores in rows.items():
        # The reference of the centre bias has no map, and a row already.
        if name != CENTRE and (_MAP, sources[0]) in scores:
            body.append([name, *_cells(scores, _MAP, sources)])
    for name, scores in rows.items():
        if ("all terms", sources[0]) in scores:
            body.append([f"{name}, with oculomotor biases", *_cells(scores, "all terms", sources)])
    return table(body)


def terms_table(rows: Mapping[str, Scores]) -> list[str]:
    """Write NSS and gain on the first data set with and without each term."""
    terms = (*ROWS[False], *ROWS[True])
    head = [""]
    for term in terms:
        head += [f"{term}: NSS", f"{term}: gain"]
    body = [head]
    for name, scores in rows.items():
        if name in (CENTRE, PEOPLE):
            continue
        row = [name]
        for term in terms:
            nss, _, gain = _figures(scores, term, 0) if (term, 0) in scores else ("", "", "")
            row += [nss, gain]
        body.append(row)
    return table(body)


def splits_table(splits: Mapping[str, Scores]) -> list[str]:
    """Write the scores of the studied detector, by what its model was fitted to."""
    sources = sorted({source for scores in splits.values() for _, source in scores})
    body = [["fitted to", *_headings(sources)]]
    body += [[name, *_cells(scores, _MAP, sources)] for name, scores in splits.items()]
    return table(body)


def _headings(sources: Sequence[int]) -> list[str]:
    """Name the columns of `_cells`."""
    headings = []
    for source in sources:
        headings += [f"{figure}, {source + 1}" for figure in ("NSS", "AUC", "gain")]
    return headings


def _cells(scores: Scores, row: str, sources: Sequence[int]) -> list[str]:
    """Write the figures of a row of scores, one data set after the other."""
    cells: list[str] = []
    for source in sources:
        cells += _figures(scores, row, source)
    return cells


def _figures(scores: Scores, row: str, source: int) -> tuple[str, str, str]:
    """Write NSS, AUC and information gain over the centre bias, with standard errors over pictures."""
    nss, auc, information = scores[row, source].double().numpy().T
    information_of_centre = scores[CENTRE, source].double().numpy()[:, 2]
    return _mean(nss), _mean(auc), _mean(information - information_of_centre)


def _mean(values: _Array) -> str:
    """Write the mean over pictures with its standard error."""
    return plus_minus(float(values.mean()), float(standard_error(values)), 3)


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


def beside_others(ours: Sequence[_Array], people: Sequence[_Array], size: tuple[int, int]) -> dict[str, float]:
    """Compare scanpaths with those of other people.

    Args:
        ours: scanpath n is that of person n, or drawn with their first fixation; each `(fixations, 2)`.
        people: the scanpaths of people.
        size: `(height, width)` of the picture.

    Returns:
        The mean of each measure over the pairs of scanpath n and that of another person than n.
    """
    height, width = size
    fixations = np.concatenate(people)
    # Clusters of people's fixations are the letters of which a scanpath is a word.
    letters = cluster_labels(np.concatenate([*ours, fixations]), fixations, _BANDWIDTH * max(size)).tolist()
    ends = np.cumsum([0, *map(len, ours), *map(len, people)])
    words = [letters[start:end] for start, end in pairwise(ends)]
    words_of_people = words[len(ours) :]
    measures = []
    for number, path in enumerate(ours):
        for person, other in enumerate(people):
            if person == number:
                continue
            measures.append(
                (
                    sequence_score(words[number], words_of_people[person]),
                    multimatch(path, other, (width, height)).mean,
                    scanmatch(_within(path, (width, height)), _within(other, (width, height)), (width, height)),
                    time_delay_embedding(path, other) / max(size),
                )
            )
    return dict(zip(SEQUENCES, np.nanmean(np.array(measures), 0).tolist(), strict=True))


def _within(path: _Array, size: tuple[int, int]) -> _Array:
    return path.clip(0, np.array(size) - 1)


def sequences_table(drawn: Mapping[str, Sequence[Mapping[str, float]]]) -> list[str]:
    """Write the means over pictures of the measures of scanpaths against those of other people."""
    body = [["", *SEQUENCES]]
    for name, pictures in drawn.items():
        columns = [np.array([measures[measure] for measures in pictures]) for measure in SEQUENCES]
        body.append([name, *map(_mean, columns)])
    return table(body)
