"""Experiments with pictures larger than the detector's input: recall and first hits against detector passes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

from eval.comparison.telling import class_frequencies
from eval.zoom.decisions import decide_all
from eval.zoom.objects import object_record
from eval.zoom.observed import ObservedRates, make_zoom_observation
from eval.zoom.orders import in_order, oracle, quad_tree, shuffled, sparse
from semfov.data.classes import class_index
from semfov.data.mosaics import Mosaics
from semfov.data.scene import Annotation
from semfov.detection.detections import Detections
from semfov.episode import Stopwatch
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import SceneRun
from semfov.runs.search_protocol import choose_classes
from semfov.runs.settings import Count, Range
from semfov.runs.window_looking import (
    LEAST_CONFIDENCE,
    TileSize,
    WindowLooking,
    WindowLookingConfig,
    found_in,
    right_boxes,
)
from semfov.zoom.decision import CLOSER
from semfov.zoom.episode import WindowStep, find_everything, look_by_look, look_for
from semfov.zoom.glances import Glance, Glances, Window, around, half_steps
from semfov.zoom.hints import DETECTION_SCORE
from semfov.zoom.lattice import Lattice
from semfov.zoom.objects import merge
from semfov.zoom.slices import adaptive_slices, ranked, slices

_Measure = Literal["objects", "recall", "hit", "decision"]

_COMPARED = (
    "slices, raster",
    "slices, sparse",
    "slices as in ASAHI",
    "slices, ranked by the overview",
    "quad-tree, best first",
    "semfov",
)
"""Ways of looking whose objects are compared with the annotated ones."""


@dataclass(frozen=True)
class ZoomConfig(WindowLookingConfig):
    """Large pictures: recall against detector passes, passes to the first confirmed hit, and decisions.

    Args:
        target: class whose objects are to be found (None: objects of any class).
        slice: side in pixels of the slices of a photograph; a mosaic's slices are its photographs.
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
    out: Path = Path("runs/zoom")


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
        settings = self.own_settings("model", "observation")
        return {"eye": self.eye.settings(), "models": models, "settings": settings}

    def slices(self, index: int, lattice: Lattice) -> list[Window]:
        """The slices of a scene: the photographs of a mosaic, or squares of a picture."""
        if isinstance(self.scenes, Mosaics):
            boxes = [tile.slot for tile in self.scenes.tiles(index)]
            return [around(lattice, (float(x1), float(y1), float(x2), float(y2))) for x1, y1, x2, y2 in boxes]
        return slices(lattice, self.config.slice, self.config.overlap)

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Measure all ways of looking at a scene; returns records, and the seconds that each stage took."""
        watch = Stopwatch()
        glances = self.glances(index)
        records: list[ResultRecord] = []
        measures = self.config.measures
        for name, turns in self._finding(index, glances) if {"objects", "recall"} & {*measures} else ():
            if "recall" not in measures and name not in _COMPARED:
                continue
            looks, ahead = looked(islice(turns, self.config.passes))
            if "objects" in measures:
                records += self._objects(name, index, looks, ahead)
            if "recall" not in measures:
                if name == _COMPARED[-1]:  # the oracle is dear
                    break
                continue
            records.append(self._recall(name, index, looks))
            if name in ("slices, raster", "semfov"):
                records.append(self._recall(f"{name}, cut boxes dropped", index, [*map(without_cut, looks)]))
        watch.lap("recall")
        if self.config.mosaics and "hit" in measures:
            records += self._first_hits(index, glances)
        watch.lap("first hit")
        if "decision" in measures:
            records += self._decisions(index, glances)
        watch.lap("decision")
        glances.save()
        return records, watch.seconds

    def _finding(self, index: int, glances: Glances) -> Iterator[tuple[str, Iterator[WindowStep[Any]]]]:
        """Every way of looking for all objects, with its name in tables."""
        cut, lattice = self.slices(index, glances.lattice), glances.lattice
        annotation, target = self.annotation(index), self.target
        targets = [] if target is None else [target]
        orders = {
            "slices, raster": in_order(cut),
            "slices, random": shuffled(cut, [self.config.seed, index]),
            "slices, sparse": sparse(cut, targets, self.config.sparse),
            "slices as in ASAHI": in_order(adaptive_slices(lattice)),
            "slices, ranked by the overview": ranked(cut, targets),
            "quad-tree, best first": quad_tree(lattice, target, most=False),
        }
        for name, order in orders.items():
            yield name, look_by_look(glances, order, None)
        yield "semfov", find_everything(glances, self.evidence, target)
        yield "semfov, four at a time", find_everything(glances, self.evidence, target, batch=4)
        if self.observation is not None:
            observed = ObservedRates(self.observation, glances.lattice, foresight=self.evidence.foresight)
            yield "by the observation model", find_everything(glances, observed, target)
        finds: Callable[[Glance], Tensor] = lambda glance: found_in([glance], annotation, target)  # noqa: E731
        every = [*half_steps(lattice)][1:]
        yield "oracle", look_by_look(glances, oracle(glances, [*every, *cut], finds, self.config.passes), None)

    def _decisions(self, index: int, glances: Glances) -> list[ResultRecord]:
        """Search for classes that are present and for classes that are absent."""
        config, annotation = self.config, self.scenes.annotation(index)
        targets = (
            choose_classes(self.scenes, index, annotation, config.sought, 1.0, config.seed)
            if self.target is None
            else [self.target]
        )
        names = "background", *self.scenes.classes
        cut = self.slices(index, glances.lattice)
        limits = {"passes": config.passes, "closer": config.closer}
        records = decide_all(glances, self.evidence, names, targets, annotation, cut, **limits)
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
        """The objects to be found: of the target class, or all."""
        annotation = self.scenes.annotation(index)
        if self.target is None:
            return annotation
        of_target = annotation.labels == self.target
        return Annotation(
            annotation.boxes[of_target], annotation.labels[of_target], annotation.crowd[of_target], annotation.size
        )

    def _objects(
        self, name: str, index: int, looks: list[Glance], ahead: list[tuple[tuple[float, float], float]]
    ) -> Iterator[ResultRecord]:
        """Compare the objects of semfov, with probabilities and with scores, and of slices with the annotated ones."""
        if name not in _COMPARED:
            return
        lattice = Lattice.over(self.scenes.annotation(index).size, self.eye.detector.input_size, finest=self.eye.finest)
        shared = looks, lattice, self.target, self.annotation(index), self.config.passes
        ways = (
            {name: None}
            if name != "semfov"
            else {"semfov": self.evidence.certainty, "semfov, scores of the detector": None}
        )
        for way, certainty in ways.items():
            yield object_record(way, *shared, certainty, ahead) | {"scene": self.scenes.ids[index]}

    def _recall(self, name: str, index: int, looks: list[Glance]) -> ResultRecord:
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
            "windows": [list(glance.window.fixation) for glance in looks],
        }

    def _first_hits(self, index: int, glances: Glances) -> list[ResultRecord]:
        """Count passes until a class that a slice shows is first seen at a slice's magnification or a higher one."""
        cut = self.slices(index, glances.lattice)
        presence = torch.stack([glance.show for glance in glances.see(cut)]) >= LEAST_CONFIDENCE
        closest = min(window.level for window in cut)
        limit = len(cut) + 1
        records: list[ResultRecord] = []
        for target in (presence.any(0).nonzero()[:, 0] + 1).tolist():
            orders = {
                "slices, raster": in_order(cut),
                "slices, random": shuffled(cut, [self.config.seed, index, target]),
                "slices, ranked by the overview": ranked(cut, [target], most=True),
                "quad-tree, best first": quad_tree(glances.lattice, target, most=True),
            }
            ways: dict[str, Iterator[WindowStep[Any]]] = {
                **{name: look_by_look(glances, order, None) for name, order in orders.items()},
                "semfov": look_for(glances, self.evidence, target, slices=cut),
                "semfov, free windows": look_for(glances, self.evidence, target, closest=True),
            }
            for name, turns in ways.items():
                passes, hit = 0, False
                for glance in (turn.glance for turn in islice(turns, limit)):
                    passes += 1
                    hit = glance.window.level >= closest and float(glance.show[target - 1]) >= LEAST_CONFIDENCE
                    if hit:
                        break
                records.append(
                    {
                        "measure": "first hit",
                        "way": name,
                        "scene": self.scenes.ids[index],
                        "target": self.scenes.classes[target - 1],
                        "passes": passes if hit else limit,
                        "hit": hit,
                    }
                )
        return records


def looked(turns: Iterator[WindowStep[Any]]) -> tuple[list[Glance], list[tuple[tuple[float, float], float]]]:
    """The looks of turns; and after each, with a belief, the objects that looks are expected to find, and were so far.

    Args:
        turns: the turns.

    Returns:
        The looks; and for `semfov.zoom.objects.probable_objects` what remains and what was promised, none without a
        belief.
    """
    looks: list[Glance] = []
    ahead: list[tuple[tuple[float, float], float]] = []
    promised = 0.0
    for turn in turns:
        promised += turn.worth if looks else 0.0
        looks.append(turn.glance)
        if turn.belief is not None:
            ahead.append((turn.belief.remaining(), promised))
    return looks, ahead


def without_cut(glance: Glance) -> Glance:
    """A look without the boxes that are cut by the border of its window."""
    every, whole = glance.detections, ~glance.cut
    detections = Detections(every.boxes[:, whole], every.scores[:, whole], every.mask[:, whole])
    return replace(glance, detections=detections, cut=glance.cut[whole])
