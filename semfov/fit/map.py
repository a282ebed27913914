"""Train the map of all classes on the looks of whole explorations, and compare it with raw scores."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief import Grid, MapEvidence
from semfov.belief.look_features import class_features, highest_score
from semfov.belief.observers import LearnedMap, Semantic
from semfov.belief.observers.learned_map import MapBelief, MapLook
from semfov.episode import Step, StoredLooks
from semfov.errors import DataError, InputError
from semfov.fit.detector_report import Difference, curves_figure, mean_percent, section
from semfov.fit.examples import Examples, example_episodes
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.settings import FitOnLooksConfig
from semfov.fit.training import Fit, descend, split, training_of
from semfov.gaze.acquisition import CloserLook
from semfov.gaze.policies import Policy
from semfov.metrics.calibration import calibration_error
from semfov.metrics.episodes import FloatArray, answers_of
from semfov.runs.looking import Looking
from semfov.runs.progress import track
from semfov.runs.protocols import explorations_of, run_explorations
from semfov.runs.seeds import generator_for, noise_for
from semfov.runs.settings import Count, Range
from semfov.runs.tables import table
from semfov.strategy import Strategy
from semfov.viz.style import save_figure

_JUDGED = (1, 2, 3, 5, 10, 15)  # numbers of looks after which a map is evaluated
_MEASURED = {"objects": "right", "all": "right_everywhere"}
"""Cells of which strategies are compared, with the name of the numbers of right ones."""


@dataclass(frozen=True)
class FitMapConfig(FitOnLooksConfig):
    """Train the map of all classes.

    Args:
        classes: number of classes to learn from in each photograph. The present classes and those with the highest
            scores come first.
        others: how many of these classes are drawn at random from the remaining ones.
        gain_steps: number of training steps for predicting the gain of a look.
    """

    astray: ClassVar[float] = 0.5

    classes: Annotated[int, Range(2, 10_000)] = 12
    others: Count = 3
    looks: Annotated[int, Range(2, 10_000)] = 12
    steps: Count = 1000
    gain_steps: Count = 200
    batch: Count = 12
    out: Path = Path("runs/fit_map")


@dataclass(frozen=True)
class _MapExamples(Examples):
    """One for each photograph, with T classes; features `(E, X·Y, T, X·Y, F)`, answers `(E, X·Y, T+1)`."""

    looks, more = MapLook, ("stands_for",)

    answers: Tensor
    stands_for: Tensor


def _make_map_examples(run: Looking, config: FitMapConfig) -> _MapExamples:
    """Make examples from all photographs with objects: of present classes, of high scores, and of a few others."""
    rows, components, others, own = [], len(run.scenes.classes) + 1, config.others, config.classes - config.others
    for index in track(range(len(run.scenes)), "describing looks", "scene"):
        annotation, grid = run.scenes.annotation(index), run.grid(index)
        if not len(annotation.labels):
            continue
        detections = run.detections(index)
        every = torch.arange(1, components)
        score = highest_score(detections, every)
        held = torch.isin(every, annotation.labels)
        order = (score.amax(0) + 2 * held).argsort(descending=True)
        rest, generator = order[own:], generator_for("others", config.seed, run.scenes.ids[index])
        drawn = torch.randperm(len(rest), generator=generator)[:others]
        chosen = torch.cat([order[:own], rest[drawn]])
        stands_for = torch.ones(len(chosen))
        stands_for[own:] = len(rest) / max(len(drawn), 1)
        with torch.inference_mode():
            features = torch.cat(
                [
                    class_features(detections[place], grid.centres[place], grid, every[chosen]).half()
                    for place in torch.arange(len(grid)).split(10)
                ]
            )
        answers = answers_of(annotation, grid, components)
        answers = torch.cat([~answers.any(-1, keepdim=True), answers[:, every[chosen]]], -1)
        where = grid.cell_distance, torch.tensor(index), every[chosen]
        rows.append((features, score[:, chosen], *where, answers, stands_for))
    if not rows:
        raise DataError("data: none of the photographs contains an object; raise data.limit or give other photographs")
    return _MapExamples(*(torch.stack(column) for column in zip(*rows, strict=True)))


def fit_map_evidence(config: FitMapConfig, run: Looking) -> Fit[MapEvidence]:
    examples = _make_map_examples(run, config)
    held_out = split(examples.scene, config.holdout)
    grid = Grid(*config.cells, config.cells)
    metadata = {**run.eye.settings(), **training_of(config, run.scenes)}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = MapEvidence(components=len(run.scenes.classes) + 1, metadata=metadata)
    with torch.no_grad():
        model.prior.copy_(_frequencies(run, config.holdout))
    _train_map(config, model, examples[~held_out], grid)
    _train_gain(config, model, examples[~held_out], grid)
    judged = _judge_map(config, model.eval(), examples[held_out], grid)
    counts = int((~held_out).sum()), int(held_out.sum())
    return Fit(model, judged, *counts, _map_report(judged, *counts))


def _frequencies(run: Looking, holdout: int) -> Tensor:
    """Count how often a cell contains each class in the training photographs; → `(K+1,)`."""
    components, cells = len(run.scenes.classes) + 1, 0
    count = torch.zeros(components)
    for index in range(len(run.scenes)):
        if index % holdout:
            grid = run.grid(index)
            count += answers_of(run.scenes.annotation(index), grid, components).sum(0)
            cells += len(grid)
    return ((count + 1) / (cells + 2)).logit() / 4 + 1


def _train_map(config: FitMapConfig, model: MapEvidence, examples: _MapExamples, grid: Grid) -> None:
    """Train on explorations that follow the model. Some of their fixations are random."""
    generator = torch.Generator().manual_seed(config.seed)

    def loss_of(_: int) -> Tensor:
        chosen = examples[torch.randint(len(examples), (config.batch,), generator=generator)]
        counted = torch.randint(2, config.looks + 1, (2,), generator=generator).tolist()
        loss = chosen.score.new_zeros(())
        learned, policy = LearnedMap(model, together=True), CloserLook(grid)
        for step in example_episodes(chosen, learned, policy, grid, max(counted), config.astray, generator):
            if step.shift + 1 in (1, *counted):
                loss = loss + map_objective(step, chosen)
        return loss

    descend(model.parameters(), loss_of, config.steps, config.rate)


def map_objective(step: Step, examples: _MapExamples) -> Tensor:
    """The cross-entropy of every class and background: a mean over cells, and a sum over the classes represented."""
    belief = step.belief
    assert isinstance(belief, MapBelief)
    weight = torch.cat([torch.ones_like(examples.stands_for[:, :1]), examples.stands_for], 1)
    answers = examples.answers.to(belief.probabilities)
    each = F.binary_cross_entropy_with_logits(belief.probabilities.logit(eps=1e-7), answers, reduction="none")
    return (each.mean(1) * weight).sum(-1).mean()


def _train_gain(config: FitMapConfig, model: MapEvidence, examples: _MapExamples, grid: Grid) -> None:
    """Train by least squares what a look brings in a cell: 1 if its answer gets right, -1 if it gets wrong."""
    generator = torch.Generator().manual_seed(config.seed + 1)

    def loss_of(_: int) -> Tensor:
        chosen = examples[torch.randint(len(examples), (config.batch,), generator=generator)]
        loss = chosen.score.new_zeros(())
        learned, policy = LearnedMap(model, together=True), CloserLook(grid)
        with torch.no_grad():
            steps = [*example_episodes(chosen, learned, policy, grid, config.looks, config.astray, generator)]
        for before, step in pairwise(steps):
            brought = _right(step, chosen.answers) - _right(before, chosen.answers)
            loss = loss + (_gain(model, before, chosen, step.cell) - brought).square().mean() * 100
        return loss

    title = "learning the gain of looks"
    descend(model.worth.parameters(), loss_of, config.gain_steps, config.rate, clip=None, title=title)


def _gain(model: MapEvidence, step: Step, examples: _MapExamples, cell: Tensor) -> Tensor:
    """The gain of looks from cells `(B,)` that the model expects after a look, `(B, X·Y)`."""
    belief, distance = step.belief, examples.distance[torch.arange(len(examples)), cell][:, None]
    assert isinstance(belief, MapBelief)
    return model.gain(belief.probabilities, belief.closest, belief.looks, distance)[:, 0]


def _right(step: Step, answers: Tensor) -> Tensor:
    """Return 1 for cells whose most probable answer is right and 0 for the others, `(B, X·Y)`."""
    belief = step.belief
    assert isinstance(belief, MapBelief)
    best = belief.probabilities.argmax(-1, keepdim=True)
    return answers.gather(-1, best)[..., 0].to(belief.closest)


@torch.no_grad()
def _judge_map(config: FitMapConfig, model: MapEvidence, examples: _MapExamples, grid: Grid) -> list[dict[str, float]]:
    """Evaluate the model on held-out explorations, after each number of looks in `_JUDGED`."""
    generator, judged, answers = torch.Generator().manual_seed(config.seed), [], examples.answers
    some = ~answers[..., 0]
    expected = was = torch.zeros(())
    learned, policy = LearnedMap(model, together=True), CloserLook(grid)
    for step in example_episodes(examples, learned, policy, grid, max(_JUDGED), 0.0, generator):
        belief = step.belief
        assert isinstance(belief, MapBelief)
        p, now = belief.probabilities, _right(step, answers)
        named = answers[..., 1:].gather(-1, p[..., 1:].argmax(-1, keepdim=True))[..., 0]
        if step.shift + 1 in _JUDGED:
            judged.append(
                {
                    "looks": step.shift + 1,
                    "all": float(now.double().mean()),
                    "objects": float(now[some].double().mean()),
                    "objects_without_background": float(named[some].double().mean()),
                    "nll": float(F.binary_cross_entropy(p.double(), answers.double())),
                    "ece": float(calibration_error(p.flatten(), answers.flatten())),
                    "ece_background": float(calibration_error(p[..., 0].flatten(), answers[..., 0].flatten())),
                    "expected": float(expected.sum(-1).mean()) if step.shift else 0.0,
                    "brought": float((now - was).sum(-1).mean()) if step.shift else 0.0,
                }
            )
        expected, was = _gain(model, step, examples, step.next_cell), now
    return judged


def _map_report(judged: list[dict[str, float]], trained: int, held_out: int) -> str:
    shares = {
        "cells right, %": "all",
        "with objects, %": "objects",
        "without background, %": "objects_without_background",
    }
    measures = {"NLL": "nll", "ECE": "ece", "ECE, background": "ece_background"}
    gains = {"expected gain, cells": "expected", "gain, cells": "brought"}
    rows = [["looks", *shares, *measures, *gains]]
    for row in judged:
        figures = [f"{100 * row[name]:.1f}" for name in shares.values()]
        figures += [f"{row[name]:.4f}" for name in measures.values()]
        figures += [f"{row[name]:.2f}" for name in gains.values()]
        rows.append([str(int(row["looks"])), *figures])
    return "\n".join(
        [
            f"Trained on {trained} photographs and evaluated on {held_out} held-out photographs, in explorations with "
            "the policy of the closer look. The first three measures are the share of cells whose most probable answer "
            "is right: over all cells; over cells with objects; and over cells with objects when background is not "
            "allowed as an answer. Then follow the negative log likelihood (NLL) and the expected calibration error "
            "(ECE) of the probabilities of the example's classes and of background. The last two columns show how many "
            "more cells were expected to be right after the last look, and how many more were right.",
            "",
            *table(rows),
            "",
        ]
    )


class MapFit(PartFit):
    """Train the map of all classes."""

    settings: FitMapConfig

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        steps = self.config.map_steps or 1000
        self.settings = inputs.settings(FitMapConfig, steps=steps, gain_steps=max(1, steps // 5))
        self.tasks = {
            "describing looks": 0.05 * len(self.run.scenes),
            "training": 0.25 * self.settings.steps,
            "learning the gain of looks": 0.1 * self.settings.gain_steps,
            "exploring": len(self.inputs.judged),
        }

    def _curves(self, ways: Mapping[str, Strategy]) -> dict[str, dict[str, FloatArray]]:
        """Share of the cells, with `objects` and of `all`, that strategies classify correctly, `(P, shifts+1)`."""
        run, protocol = self.run, self.inputs.protocol
        curves: dict[str, dict[str, list[FloatArray]]] = {what: {name: [] for name in ways} for what in _MEASURED}
        for index in track(self.inputs.judged, "exploring", "scene"):
            grid = run.grid(index)
            answers = answers_of(run.scenes.annotation(index), grid, self.inputs.components)
            if not answers.any():
                continue
            looks = StoredLooks(run.detections(index), grid)
            episodes = explorations_of(run.scenes, index, len(grid), protocol)
            noise = torch.stack(
                [noise_for(protocol, len(grid), run.scenes.ids[index], None, each.repetition) for each in episodes]
            )
            cells = {"objects": int(answers.any(-1).sum()), "all": len(grid)}
            for name, way in ways.items():
                with torch.inference_mode():
                    progress = run_explorations(
                        episodes, way, looks, answers, noise, shifts=protocol.shifts, batch=protocol.batch
                    )
                for what, counted in _MEASURED.items():
                    rates = [np.asarray(counts[counted]) / cells[what] for _, counts in progress]
                    curves[what][name].append(np.mean(rates, axis=0))
        return {
            what: {name: np.array(each).reshape(-1, protocol.shifts + 1) for name, each in of_ways.items()}
            for what, of_ways in curves.items()
        }

    def fit(self) -> PartResult:
        """Train, and compare explorations with those of raw scores and random gaze."""
        inputs, run = self.inputs, self.run
        if inputs.components < 3:
            raise InputError("detector: a map of all classes needs at least 2 classes, got a detector with 1 class")
        fit = fit_map_evidence(self.settings, run)
        fovea = self.config.sensor.fovea
        ways = {
            "fitted": Strategy(LearnedMap(fit.model), Policy("closer-look", fovea=fovea)),
            "raw": Strategy(Semantic(inputs.components), Policy("random")),
            "fused": Strategy(inputs.semantic, Policy("closer-look", fovea=fovea)),
        }
        for way in ways.values():
            way.eval().requires_grad_(False)
        protocol, at, curves = inputs.protocol, inputs.compared_at, self._curves(ways)
        every, objects = curves["all"], curves["objects"]
        if not len(objects["raw"]):
            raise DataError("data: none of the held-out photographs contains an object; give more photographs")
        gain = Difference.of(objects["fitted"][:, at], objects["raw"][:, at])
        # A map that answers background everywhere is right for most cells, and one that never answers background may
        # be right for all objects. Therefore both measures are compared.
        loss = Difference.of(every["raw"][:, at], every["fitted"][:, at])
        why = (
            f"{100 * objects['fitted'][:, at].mean():.1f} % of the cells with objects are classified correctly after "
            f"{at} gaze shifts, {100 * objects['raw'][:, at].mean():.1f} % with raw scores and random gaze; "
            f"{gain.in_words('points gained', 100)}; of all cells {100 * every['fitted'][:, at].mean():.1f} and "
            f"{100 * every['raw'][:, at].mean():.1f} %"
        )
        sections, after = [], (1, at, protocol.shifts)
        for what, words in (("objects", "cells with objects, the published success rate"), ("all", "all cells")):
            rows = [["map", *(f"after {n}" for n in after)]]
            rows += [[name, *(mean_percent(curve[:, n]) for n in after)] for name, curve in curves[what].items()]
            sections.append(section(f"Classified correctly after n gaze shifts, in % of {words}:", rows))
        head = (
            f"On {len(objects['raw'])} held-out photographs. `raw` fuses raw scores with random gaze; `fused` uses the "
            "exponent chosen under Tempering, with the gaze policy of the fitted map. The answer for a cell may be "
            "background.\n"
        )
        save_figure(curves_figure(objects, "exploration"), self.config.out / "explore.png")
        part = self.write("map", fit.model, gain.better and not loss.better, why)
        return PartResult(part, "\n".join([head, *sections, fit.report]), ["explore.png"])
