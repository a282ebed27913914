"""Train the map of all classes on the looks of whole explorations."""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, ClassVar

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief import Grid, MapEvidence
from semfov.belief.look_features import class_features, highest_score
from semfov.belief.observers import LearnedMap
from semfov.belief.observers.learned_map import MapBelief, MapLook
from semfov.episode import Step
from semfov.errors import DataError
from semfov.fit.examples import Examples, example_episodes
from semfov.fit.looking import Looking
from semfov.fit.settings import FitOnLooksConfig
from semfov.fit.training import Fit, descend, split, training_of
from semfov.gaze.acquisition import CloserLook
from semfov.io.ranges import Count, Range
from semfov.metrics.calibration import calibration_error
from semfov.metrics.episodes import answers_of
from semfov.runs.progress import track
from semfov.runs.seeds import generator_for
from semfov.runs.tables import table

_JUDGED = (1, 2, 3, 5, 10, 15)  # numbers of looks after which a map is evaluated
_CELLS_AT_ONCE = 10  # cells whose looks are described together: a bound on memory


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
class MapExamples(Examples):
    """One example for each photograph, with T of its classes.

    Features are `(E, X·Y, T, X·Y, F)`: what a look from each cell tells about each class in each cell.

    Attributes:
        answers: `(E, X·Y, T+1)` boolean, whether a cell holds nothing, and each class.
        stands_for: `(E, T)`, number of classes that each class represents: 1, or more for those drawn at random.
    """

    looks = MapLook
    more = ("stands_for",)

    answers: Tensor
    stands_for: Tensor


def _make_map_examples(run: Looking, config: FitMapConfig) -> MapExamples:
    """Make examples from all photographs with objects."""
    rows = [
        _example_of_scene(run, config, index)
        for index in track(range(len(run.scenes)), "describing looks", "scene")
        if len(run.scenes.annotation(index).labels)
    ]
    if not rows:
        raise DataError("data: none of the photographs contains an object; raise data.limit or give other photographs")
    return MapExamples(*(torch.stack(column) for column in zip(*rows, strict=True)))


def _example_of_scene(run: Looking, config: FitMapConfig, index: int) -> tuple[Tensor, ...]:
    """Make the example of one photograph: the fields of `MapExamples` without a batch dimension."""
    annotation = run.scenes.annotation(index)
    grid = run.grid(index)
    detections = run.detections(index)
    components = len(run.scenes.classes) + 1
    score = highest_score(detections, torch.arange(1, components))
    generator = generator_for("others", config.seed, run.scenes.ids[index])
    targets, stands_for = _choose_targets(config, score, annotation.labels, generator)
    with torch.inference_mode():
        features = [
            class_features(detections[cells], grid.centres[cells], grid, targets).half()
            for cells in torch.arange(len(grid)).split(_CELLS_AT_ONCE)
        ]
    held = answers_of(annotation, grid, components)
    answers = torch.cat([~held.any(-1, keepdim=True), held[:, targets]], -1)
    return (
        torch.cat(features),
        score[:, targets - 1],
        grid.cell_distance,
        torch.tensor(index),
        targets,
        answers,
        stands_for,
    )


def _choose_targets(
    config: FitMapConfig, score: Tensor, labels: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Choose the classes of an example: present ones, then those with high scores, and a few of the others at random.

    Shapes: score `(X·Y, K)`, labels `(M,)` → classes `(T,)` and how many classes each represents `(T,)`.
    """
    leading = config.classes - config.others
    classes = torch.arange(1, score.shape[-1] + 1)
    held = torch.isin(classes, labels)
    order = (score.amax(0) + 2 * held).argsort(descending=True)  # scores are at most 1
    remaining = order[leading:]
    drawn = torch.randperm(len(remaining), generator=generator)[: config.others]
    chosen = torch.cat([order[:leading], remaining[drawn]])
    stands_for = torch.ones(len(chosen))
    # Those drawn represent all that were not, so that the loss is that of all classes.
    stands_for[leading:] = len(remaining) / max(len(drawn), 1)
    return classes[chosen], stands_for


def fit_map_evidence(config: FitMapConfig, run: Looking) -> Fit[MapEvidence]:
    """Train the map of all classes, and evaluate it on held-out photographs.

    Args:
        config: settings of examples and training.
        run: the photographs and their stored looks.

    Returns:
        The model with its report.

    Raises:
        DataError: no photograph has an object, or they are too few to hold some out.
    """
    examples = _make_map_examples(run, config)
    held_out = split(examples.scene, config.holdout)
    # Only numbers of cells matter from here on: photographs of all sizes share one grid of one pixel a cell.
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
    trained = int((~held_out).sum())
    report = _map_report(judged, trained, int(held_out.sum()))
    return Fit(model, judged, trained, int(held_out.sum()), report)


def _frequencies(run: Looking, holdout: int) -> Tensor:
    """Count how often a cell contains each class in the training photographs; → `(K+1,)`."""
    components = len(run.scenes.classes) + 1
    cells = 0
    count = torch.zeros(components)
    for index in range(len(run.scenes)):
        if index % holdout:
            grid = run.grid(index)
            count += answers_of(run.scenes.annotation(index), grid, components).sum(0)
            cells += len(grid)
    # Log odds of -4, those of a class in one of about fifty cells, become an input of 0.
    return ((count + 1) / (cells + 2)).logit() / 4 + 1


def _train_map(config: FitMapConfig, model: MapEvidence, examples: MapExamples, grid: Grid) -> None:
    """Train on explorations that follow the model. Some of their fixations are random."""
    generator = torch.Generator().manual_seed(config.seed)

    def loss_of(_: int) -> Tensor:
        batch = examples[torch.randint(len(examples), (config.batch,), generator=generator)]
        # The first look and two random ones stand for all.
        counted = (1, *torch.randint(2, config.looks + 1, (2,), generator=generator).tolist())
        observer = LearnedMap(model, together=True)
        loss = batch.score.new_zeros(())
        for step in example_episodes(batch, observer, CloserLook(grid), grid, max(counted), config.astray, generator):
            if step.shift + 1 in counted:
                loss = loss + map_objective(step, batch)
        return loss

    descend(model.parameters(), loss_of, config.steps, config.rate)


def map_objective(step: Step, examples: MapExamples) -> Tensor:
    """Compute the cross-entropy of every class and background: a mean over cells, a sum over the classes represented.

    Args:
        step: a look of E explorations, with the belief after it.
        examples: their examples.

    Returns:
        A scalar.
    """
    belief = step.belief
    assert isinstance(belief, MapBelief)
    of_background = torch.ones_like(examples.stands_for[:, :1])
    weight = torch.cat([of_background, examples.stands_for], 1)
    answers = examples.answers.to(belief.probabilities)
    log_odds = belief.probabilities.logit(eps=1e-7)
    entropy = F.binary_cross_entropy_with_logits(log_odds, answers, reduction="none")
    return (entropy.mean(1) * weight).sum(-1).mean()


def _train_gain(config: FitMapConfig, model: MapEvidence, examples: MapExamples, grid: Grid) -> None:
    """Train by least squares what a look brings in a cell: 1 if its answer gets right, -1 if it gets wrong."""
    generator = torch.Generator().manual_seed(config.seed + 1)

    def loss_of(_: int) -> Tensor:
        batch = examples[torch.randint(len(examples), (config.batch,), generator=generator)]
        observer = LearnedMap(model, together=True)
        loss = batch.score.new_zeros(())
        with torch.no_grad():
            steps = list(
                example_episodes(batch, observer, CloserLook(grid), grid, config.looks, config.astray, generator)
            )
        for before, step in pairwise(steps):
            gain = _right(step, batch.answers) - _right(before, batch.answers)
            expected = _gain(model, before, batch, step.cell)
            loss = loss + (expected - gain).square().mean() * 100
        return loss

    title = "learning the gain of looks"
    descend(model.worth.parameters(), loss_of, config.gain_steps, config.rate, clip=None, title=title)


def _gain(model: MapEvidence, step: Step, examples: MapExamples, cell: Tensor) -> Tensor:
    """Compute the gain of looks from cells `(B,)` that the model expects after a look, `(B, X·Y)`."""
    belief = step.belief
    assert isinstance(belief, MapBelief)
    distance = examples.distance[torch.arange(len(examples)), cell][:, None]
    return model.gain(belief.probabilities, belief.closest, belief.looks, distance)[:, 0]


def _right(step: Step, answers: Tensor) -> Tensor:
    """Return 1 for cells whose most probable answer is right and 0 for the others, `(B, X·Y)`."""
    belief = step.belief
    assert isinstance(belief, MapBelief)
    best = belief.probabilities.argmax(-1, keepdim=True)
    return answers.gather(-1, best)[..., 0].to(belief.closest)


@torch.no_grad()
def _judge_map(config: FitMapConfig, model: MapEvidence, examples: MapExamples, grid: Grid) -> list[dict[str, float]]:
    """Evaluate the model on held-out explorations, after each number of looks in `_JUDGED`."""
    generator = torch.Generator().manual_seed(config.seed)
    observer = LearnedMap(model, together=True)
    expected = right_before = torch.zeros(())
    judged = []
    for step in example_episodes(examples, observer, CloserLook(grid), grid, max(_JUDGED), 0.0, generator):
        assert isinstance(step.belief, MapBelief)
        right = _right(step, examples.answers)
        if step.shift + 1 in _JUDGED:
            # Before the first look, no gain is expected.
            is_first = step.shift == 0
            judged.append(
                {
                    "looks": step.shift + 1,
                    **_measures(step.belief.probabilities, right, examples.answers),
                    "expected": 0.0 if is_first else float(expected.sum(-1).mean()),
                    "brought": 0.0 if is_first else float((right - right_before).sum(-1).mean()),
                }
            )
        expected = _gain(model, step, examples, step.next_cell)
        right_before = right
    return judged


def _measures(probabilities: Tensor, right: Tensor, answers: Tensor) -> dict[str, float]:
    """Measure the maps of E explorations after a look; right `(E, X·Y)`, the others `(E, X·Y, T+1)`."""
    holds_object = ~answers[..., 0]
    best_class = probabilities[..., 1:].argmax(-1, keepdim=True)
    class_right = answers[..., 1:].gather(-1, best_class)[..., 0]
    return {
        "all": float(right.double().mean()),
        "objects": float(right[holds_object].double().mean()),
        "objects_without_background": float(class_right[holds_object].double().mean()),
        "nll": float(F.binary_cross_entropy(probabilities.double(), answers.double())),
        "ece": float(calibration_error(probabilities.flatten(), answers.flatten())),
        "ece_background": float(calibration_error(probabilities[..., 0].flatten(), answers[..., 0].flatten())),
    }


def _map_report(judged: list[dict[str, float]], trained: int, held_out: int) -> str:
    """Report the evaluation as Markdown."""
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
