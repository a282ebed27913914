"""Experiments with pictures larger than the detector's input: recall and first hits against detector passes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

from eval.comparison.records import own_settings
from eval.comparison.telling import class_frequencies
from eval.zoom.decisions import decide_all
from eval.zoom.objects import AFTER, RASTER, SEMFOV, expected_of, merged, object_record, suppressed, sure_boxes
from eval.zoom.observed import ObservedRates, make_zoom_observation
from eval.zoom.orders import adaptive_slices, in_order, oracle, quad_tree, shuffled, sparse
from semfov.agents.episode import Goal
from semfov.agents.window_episode import WindowEpisode, WindowTask
from semfov.data.classes import class_index
from semfov.data.mosaics import Mosaics
from semfov.data.scene import Annotation
from semfov.detection.objects import SCORE_THRESHOLD
from semfov.episode.stopwatch import Stopwatch
from semfov.errors import check
from semfov.io.ranges import Count, Range, Whole
from semfov.observation.matching import right_boxes
from semfov.paths import ZoomPath
from semfov.runs.protocols import choose_classes
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import SceneRun
from semfov.runs.window_looking import (
    TileSize,
    WindowLooking,
    WindowLookingConfig,
    found_in,
)
from semfov.zoom.decision import CLOSER
from semfov.zoom.episode import WindowStep, find_everything, look_by_look, look_for
from semfov.zoom.hints import DETECTION_SCORE
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook, WindowLooks, half_steps
from semfov.zoom.objects import merge
from semfov.zoom.slices import ranked, slices, usual_slices

_Measure = Literal["objects", "recall", "hit", "decision"]


@dataclass(frozen=True)
class ZoomConfig(WindowLookingConfig):
    """Large pictures: recall against detector passes, passes to the first confirmed hit, and decisions.

    Args:
        target: class whose objects are to be found (None: objects of any class).
        slice: side in pixels of the slices of a large picture; a mosaic's slices are its photographs, and those of a
            photograph are four that overlap.
        overlap: overlap of neighbouring slices, as a share of their side.
        sparse: sparse slices are those in which the overview has a score of at least this.
        passes: largest number of detector passes.
        measures: what to measure: the `objects` that are returned; `recall` after each pass; passes to the first `hit`,
            in mosaics, for classes that a slice shows; the `decision` at the end of a search.
        sought: largest number of classes that a picture holds, and of classes that it does not hold, to search for
            until a decision (with `target`, only that class is searched for).
        closer: largest number of closer looks of a search; by default as many as there are passes for, as in the agent.
        observation: observation model by magnification to compare with, by name or file (None: the one shipped for
            the detector, if there is one).
        folds: with 2 or more, photographs are judged in so many parts, each with evidence for photographs that was
            fitted to the others, in one process.
        seed: random seed of mosaics and random orders.
        out: folder for tables, records and figures.
    """

    target: str | None = None
    slice: TileSize = 640
    overlap: Annotated[float, Range(0, 0.9)] = 0.2
    sparse: Annotated[float, Range(0, 1)] = 0.02
    passes: Annotated[int, Range(2, 100_000)] = 24
    measures: tuple[_Measure, ...] = ("objects", "recall", "hit", "decision")
    sought: Count = 4
    closer: Annotated[int, Range(0, 100)] = CLOSER
    observation: str | None = None
    folds: Whole = 0
    out: Path = Path("runs/zoom")

    def __post_init__(self) -> None:
        """Check that only photographs as they are have folds."""
        super().__post_init__()
        fits = self.folds == 0 or (self.folds > 1 and not self.mosaics)
        check(fits, "folds", "0, or 2 or more with mosaics 0", self.folds)

    @property
    def step(self) -> int:
        """Distance in pixels between neighbouring slices."""
        return max(1, int(self.slice * (1 - self.overlap)))


class ZoomRun(WindowLooking, SceneRun):
    """Ways of looking at large pictures; every process builds its own run from the settings."""

    config: ZoomConfig

    def __init__(self, config: ZoomConfig) -> None:
        super().__init__(config)
        self.observation = make_zoom_observation(config.observation, self.eye)
        names = self.eye.detector.classes
        self.target = None if config.target is None else class_index(config.target, names, "target")

    def depends_on(self) -> dict[str, Any]:
        """List the eye, its models and the settings."""
        models = [self.evidence, self.observation]
        settings = own_settings(self.config, "model", "observation")
        return {"eye": self.eye.settings(), "models": models, "settings": settings}

    def slices(self, index: int, lattice: Lattice) -> list[Window]:
        """Return the slices of a scene: the photographs of a mosaic, or squares of a picture, in a photograph four."""
        if isinstance(self.scenes, Mosaics):
            boxes = [tile.slot for tile in self.scenes.tiles(index)]
            return [Window.around(lattice, (float(x1), float(y1), float(x2), float(y2))) for x1, y1, x2, y2 in boxes]
        if lattice.levels == 1:
            return usual_slices(lattice)
        return slices(lattice, self.config.slice, self.config.step)

    @cached_property
    def numbers(self) -> list[int]:
        """Numbers of passes after which objects are compared."""
        return sorted({number for number in AFTER if number < self.config.passes} | {self.config.passes})

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Measure all ways of looking at a scene; returns records, and the seconds that each stage took."""
        watch = Stopwatch()
        source = self.looks_at(index)
        records: list[ResultRecord] = []
        measures = self.config.measures
        if {"objects", "recall"} & {*measures}:
            records += self._finding(index, source)
        watch.lap("recall")
        if self.config.mosaics and "hit" in measures:
            records += self._first_hits(index, source)
        watch.lap("first hit")
        if "decision" in measures:
            records += self._decisions(index, source)
        watch.lap("decision")
        source.save()
        return records, watch.seconds

    def _finding(self, index: int, source: WindowLooks) -> Iterator[ResultRecord]:
        """Look for all objects in every way, and compare the objects and the recall of the ways."""
        looks = self._by_slices(index, source)
        looks[SEMFOV], paths = self._by_semfov(source)
        if "objects" in self.config.measures:
            yield from self._objects(index, looks, paths)
        if "recall" in self.config.measures:
            looks |= self._references_of_recall(index, source)
            for name, of_way in looks.items():
                yield self._recall(name, index, of_way)
                if name in (RASTER, SEMFOV):
                    yield self._recall(f"{name}, cut boxes dropped", index, [*map(without_cut, of_way)])

    def _first_looks(self, steps: Iterator[WindowStep[Any]]) -> list[WindowLook]:
        """Take as many looks as there are passes for."""
        return [step.look for step in islice(steps, self.config.passes)]

    def _by_slices(self, index: int, source: WindowLooks) -> dict[str, list[WindowLook]]:
        """Look at slices in the orders whose objects are compared with the agent's."""
        cut = self.slices(index, source.lattice)
        targets = () if self.target is None else (self.target,)
        orders = {RASTER: in_order(cut), "slices, ranked by the overview": ranked(cut, targets)}
        if source.lattice.levels > 1:
            orders |= {
                "slices, sparse": sparse(cut, targets, self.config.sparse),
                "slices as in ASAHI": in_order(adaptive_slices(source.lattice)),
                "quad-tree, best first": quad_tree(source.lattice, self.target, most=False),
            }
        return {name: self._first_looks(look_by_look(source, order, None)) for name, order in orders.items()}

    def _by_semfov(self, source: WindowLooks) -> tuple[list[WindowLook], dict[int, ZoomPath]]:
        """Look with the agent.

        Args:
            source: the looks at the picture.

        Returns:
            Its looks, and its records after the `numbers` of passes; an agent that ends early has the last one there.
        """
        targets = () if self.target is None else (self.target,)
        goal = Goal.of(("background", *self.scenes.classes), None, targets)
        episode = WindowEpisode(WindowTask(goal, self.evidence, min_gain=0.0), source)
        paths: dict[int, ZoomPath] = {}
        while episode.passes < self.config.passes and episode.look() is not None:
            if episode.passes in self.numbers:
                paths[episode.passes] = episode.record()
        for number in self.numbers:
            if number not in paths:
                paths[number] = episode.record()
        return [look.shown for look in episode.looks], paths

    def _references_of_recall(self, index: int, source: WindowLooks) -> dict[str, list[WindowLook]]:
        """Look in the ways of which only the recall is compared."""
        config = self.config
        cut = self.slices(index, source.lattice)
        annotation = self.annotation(index)
        looks: dict[str, Iterator[WindowStep[Any]]] = {
            "slices, random": look_by_look(source, shuffled(cut, [config.seed, index]), None),
            "semfov, four at a time": find_everything(source, self.evidence, self.target, batch=4),
        }
        if self.observation is not None:
            observed = ObservedRates(self.observation, source.lattice, foresight=self.evidence.foresight)
            looks["by the observation model"] = find_everything(source, observed, self.target)

        def finds(look: WindowLook) -> Tensor:
            return found_in([look], annotation, self.target)

        windows = [*half_steps(source.lattice)][1:]  # the first one is the overview
        best_first = oracle(source, [*windows, *cut], finds, config.passes)
        looks["oracle"] = look_by_look(source, best_first, None)
        return {name: self._first_looks(steps) for name, steps in looks.items()}

    def _decisions(self, index: int, source: WindowLooks) -> list[ResultRecord]:
        """Search for classes that are present and for classes that are absent."""
        config = self.config
        annotation = self.scenes.annotation(index)
        if self.target is not None:
            targets = [self.target]
        else:
            targets = choose_classes(self.scenes, index, annotation, config.sought, 1.0, config.seed)
        names = ("background", *self.scenes.classes)
        cut = self.slices(index, source.lattice)
        limits = {"passes": config.passes, "closer": config.closer}
        records = decide_all(source, self.evidence, names, targets, annotation, cut, **limits)
        frequencies = self.frequencies[index]
        return [
            record | {"scene": self.scenes.ids[index], "frequency": float(frequencies[names.index(record["target"])])}
            for record in records
        ]

    @cached_property
    def frequencies(self) -> list[Tensor]:
        """The share of the other scenes that hold each class, by index of the scene."""
        return class_frequencies(self.scenes)

    def annotation(self, index: int) -> Annotation:
        """Return the objects to be found: of the target class, or all."""
        annotation = self.scenes.annotation(index)
        if self.target is None:
            return annotation
        return annotation.take(annotation.labels == self.target)

    def _objects(
        self, index: int, seen: Mapping[str, list[WindowLook]], paths: Mapping[int, ZoomPath]
    ) -> Iterator[ResultRecord]:
        """Compare the objects of slices and of the agent with the annotated ones, and with those of a plain pass."""
        annotation = self.annotation(index)
        with torch.inference_mode():
            plain = sure_boxes(self.eye.detector(self.scenes[index].image[None]), self.target)
        ways = {
            name: {number: merged(looks[:number], self.target) for number in self.numbers}
            for name, looks in seen.items()
        }
        ways[f"{RASTER}, plain suppression"] = {
            number: suppressed(seen[RASTER][:number], self.target) for number in self.numbers
        }
        ways[f"{SEMFOV}, scores of the detector"] = ways[SEMFOV]
        ways[SEMFOV] = {number: expected_of(path) for number, path in paths.items()}
        for way, returned in ways.items():
            yield object_record(way, returned, annotation, plain) | {"scene": self.scenes.ids[index]}

    def _recall(self, name: str, index: int, looks: list[WindowLook]) -> ResultRecord:
        annotation = self.annotation(index)
        counts = [int(found_in(looks[: n + 1], annotation, self.target).sum()) for n in range(len(looks))]
        objects = merge(looks, self.target, score=DETECTION_SCORE)
        return {
            "measure": "recall",
            "way": name,
            "scene": self.scenes.ids[index],
            "objects": len(annotation.boxes),
            "found": counts,
            "boxes": len(objects),
            "right": int((right_boxes(objects, annotation) > 0).sum()),
            "windows": [list(look.window.fixation) for look in looks],
        }

    def _first_hits(self, index: int, source: WindowLooks) -> list[ResultRecord]:
        """Count passes until a class that a slice shows is first seen at a slice's magnification or a higher one."""
        cut = self.slices(index, source.lattice)
        presence = torch.stack([look.show for look in source.see(cut)]) >= SCORE_THRESHOLD
        closest = min(window.level for window in cut)
        limit = len(cut) + 1
        records: list[ResultRecord] = []
        for target in (presence.any(0).nonzero()[:, 0] + 1).tolist():
            orders = {
                "slices, raster": in_order(cut),
                "slices, random": shuffled(cut, [self.config.seed, index, target]),
                "slices, ranked by the overview": ranked(cut, [target], most=True),
                "quad-tree, best first": quad_tree(source.lattice, target, most=True),
            }
            ways: dict[str, Iterator[WindowStep[Any]]] = {}
            for name, order in orders.items():
                ways[name] = look_by_look(source, order, None)
            ways[SEMFOV] = look_for(source, self.evidence, target)
            for name, steps in ways.items():
                hit = _passes_to_hit((step.look for step in islice(steps, limit)), target, closest)
                records.append(
                    {
                        "measure": "first hit",
                        "way": name,
                        "scene": self.scenes.ids[index],
                        "target": self.scenes.classes[target - 1],
                        "passes": limit if hit is None else hit,
                        "hit": hit is not None,
                    }
                )
        return records


def _passes_to_hit(looks: Iterable[WindowLook], target: int, level: int) -> int | None:
    """Count the looks until one of a level or a closer one shows the target; None if none does."""
    for passes, look in enumerate(looks, 1):
        if look.window.level >= level and float(look.show[target - 1]) >= SCORE_THRESHOLD:
            return passes
    return None


def without_cut(look: WindowLook) -> WindowLook:
    """Return a look without the boxes that are cut by the border of its window."""
    whole = ~look.cut
    return replace(look, detections=look.detections.take(whole), cut=look.cut[whole])
