"""Training the map of all classes on the looks of whole explorations."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief import MapEvidence
from semfov.belief.grid import Grid
from semfov.belief.observers import LearnedMap, MapBelief
from semfov.episode import Step, rollout
from semfov.errors import check
from semfov.experiments.settings import Count, Range, Share
from semfov.experiments.summary import table
from semfov.gaze.acquisition import CloserLook
from semfov.gaze.choice import Exploratory
from semfov.metrics.calibration import calibration_error
from semfov.metrics.exploration import answers_of
from semfov.training.descent import descend
from semfov.training.evidence_examples import LookingRun
from semfov.training.frame import Fit, FitOnLooksConfig, fit_and_write, split
from semfov.training.map_examples import MapExampleLooks, MapExamples, make_map_examples
from semfov.training.outputs import training_of

JUDGED = (1, 2, 3, 5, 10, 15)
"""Looks after which a map is judged."""


@dataclass(frozen=True)
class FitMapConfig(FitOnLooksConfig):
    """Train the map of all classes.

    Args:
        classes: classes of a photograph to learn from: those that it holds and those that score highest.
        others: how many of them are drawn from all the rest.
        gain_steps: steps in which it is learned what a look will bring.
    """

    classes: Annotated[int, Range(2, 10_000)] = 12
    others: Count = 3
    looks: Annotated[int, Range(2, 10_000)] = 12
    astray: Share = 0.5
    steps: Count = 1000
    gain_steps: Count = 200
    batch: Count = 12
    out: Path = Path("runs/fit_map")


def fit_map(config: FitMapConfig) -> None:
    """Look from every cell, train, judge on held-out photographs, and write everything."""
    check(config.others < config.classes, "others", f"from 1 to {config.classes - 1}", config.others)
    fit_and_write(config, fit_map_evidence)


def fit_map_evidence(config: FitMapConfig, run: LookingRun) -> Fit[MapEvidence]:
    """The model, from a run that has looked."""
    examples = make_map_examples(run, config.classes, config.others, config.seed)
    held_out = split(examples.scene, config.holdout)
    grid = Grid(config.columns, config.rows, (config.columns, config.rows))
    metadata = {**run.eye.settings(), **training_of(config, run.scenes)}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = MapEvidence(components=len(run.scenes.classes) + 1, metadata=metadata)
    with torch.no_grad():
        model.prior.copy_(frequencies(run, config.holdout))
    train(config, model, examples[~held_out], grid)
    train_gain(config, model, examples[~held_out], grid)
    judged = judge(config, model.eval(), examples[held_out], grid)
    counts = int((~held_out).sum()), int(held_out.sum())
    return Fit(model, judged, *counts, report(judged, *counts))


def frequencies(run: LookingRun, holdout: int) -> Tensor:
    """How often a cell holds each class in the photographs to learn from, `(K+1,)`: its log odds, scaled to unit size.

    Args:
        run: of the photographs.
        holdout: every n-th one is left out.
    """
    components, cells = len(run.scenes.classes) + 1, 0
    count = torch.zeros(components)
    for index in range(len(run.scenes)):
        if index % holdout:
            grid = run.grid(index)
            count += answers_of(run.scenes.annotation(index), grid, components).sum(0)
            cells += len(grid)
    return ((count + 1) / (cells + 2)).logit() / 4 + 1


def train(config: FitMapConfig, model: MapEvidence, examples: MapExamples, grid: Grid) -> None:
    """Train on explorations that go by the model, with fixations astray among them."""
    generator = torch.Generator().manual_seed(config.seed)

    def loss_of(_: int) -> Tensor:
        chosen = examples[torch.randint(len(examples), (config.batch,), generator=generator)]
        counted = torch.randint(2, config.looks + 1, (2,), generator=generator).tolist()
        loss = chosen.score.new_zeros(())
        for step in explorations(model, chosen, grid, max(counted), config.astray, generator):
            if step.shift + 1 in (1, *counted):
                loss = loss + objective(step, chosen)
        return loss

    descend(model.parameters(), loss_of, config.steps, config.rate)


def explorations(
    model: MapEvidence, examples: MapExamples, grid: Grid, looks: int, astray: float, generator: torch.Generator
) -> Iterator[Step]:
    """An exploration of every example from a start at random."""
    count = len(examples)
    start = torch.randint(len(grid), (count,), generator=generator)
    choice = Exploratory(lambda _, episodes: torch.rand(len(episodes), len(grid), generator=generator), astray)
    observer = LearnedMap(model, together=True)
    return rollout(MapExampleLooks(examples, grid), observer, CloserLook(grid), start, choice, most=looks)


def objective(step: Step, examples: MapExamples) -> Tensor:
    """Cross-entropy of every class, and of none, in every cell: summed over classes, those drawn for all they stand."""
    belief = step.belief
    assert isinstance(belief, MapBelief)
    weight = torch.cat([torch.ones_like(examples.stands_for[:, :1]), examples.stands_for], 1)
    answers = examples.answers.to(belief.probabilities)
    each = F.binary_cross_entropy_with_logits(belief.probabilities.logit(eps=1e-7), answers, reduction="none")
    return (each.mean(1) * weight).sum(-1).mean()


def train_gain(config: FitMapConfig, model: MapEvidence, examples: MapExamples, grid: Grid) -> None:
    """Train what a look is expected to bring, by least squares on what looks have brought in each cell."""
    generator = torch.Generator().manual_seed(config.seed + 1)

    def loss_of(_: int) -> Tensor:
        chosen = examples[torch.randint(len(examples), (config.batch,), generator=generator)]
        before: Step | None = None
        loss = chosen.score.new_zeros(())
        with torch.no_grad():
            steps = list(explorations(model, chosen, grid, config.looks, config.astray, generator))
        for step in steps:
            if before is not None:
                known = before.belief
                assert isinstance(known, MapBelief)
                brought = right(step, chosen.answers) - right(before, chosen.answers)
                distance = chosen.distance[torch.arange(len(chosen)), step.cell][:, None]
                expected = model.gain(known.probabilities, known.closest, known.looks, distance)[:, 0]
                loss = loss + (expected - brought).square().mean() * 100
            before = step
        return loss

    title = "learning what looks bring"
    descend(model.worth.parameters(), loss_of, config.gain_steps, config.rate, clip=None, title=title)


def right(step: Step, answers: Tensor) -> Tensor:
    """Cells whose most probable answer is right, `(B, X·Y)`, 1 or 0."""
    belief = step.belief
    assert isinstance(belief, MapBelief)
    best = belief.probabilities.argmax(-1, keepdim=True)
    return answers.gather(-1, best)[..., 0].to(belief.closest)


@torch.no_grad()
def judge(config: FitMapConfig, model: MapEvidence, examples: MapExamples, grid: Grid) -> list[dict[str, float]]:
    """How well the model does on held-out explorations after some looks."""
    generator = torch.Generator().manual_seed(config.seed)
    judged = []
    answers = examples.answers
    some = ~answers[..., 0]
    before: tuple[Tensor, Tensor] | None = None
    for step in explorations(model, examples, grid, max(JUDGED), 0.0, generator):
        belief = step.belief
        assert isinstance(belief, MapBelief)
        p, now = belief.probabilities, right(step, answers)
        named = answers[..., 1:].gather(-1, p[..., 1:].argmax(-1, keepdim=True))[..., 0]
        gained = (0.0, 0.0)
        if before is not None:
            distance = examples.distance[torch.arange(len(examples)), step.cell][:, None]
            known, was = before
            gained = float(known.sum(-1).mean()), float((now - was).sum(-1).mean())
        if step.shift + 1 in JUDGED:
            judged.append(
                {
                    "looks": step.shift + 1,
                    "all": float(now.double().mean()),
                    "objects": float(now[some].double().mean()),
                    "objects_without_background": float(named[some].double().mean()),
                    "nll": float(F.binary_cross_entropy(p.double(), answers.double())),
                    "ece": float(calibration_error(p.flatten(), answers.flatten())),
                    "ece_background": float(calibration_error(p[..., 0].flatten(), answers[..., 0].flatten())),
                    "expected": gained[0],
                    "brought": gained[1],
                }
            )
        distance = examples.distance[torch.arange(len(examples)), step.next_cell][:, None]
        before = model.gain(p, belief.closest, belief.looks, distance)[:, 0], now
    return judged


def report(judged: list[dict[str, float]], trained: int, held_out: int) -> str:
    """How the model does, as Markdown."""
    head = [
        "looks",
        "cells right, %",
        "with objects, %",
        "without background, %",
        "NLL",
        "ECE",
        "ECE, background",
        "expected of the last look, cells",
        "brought by it",
    ]
    rows = [
        [
            str(int(row["looks"])),
            *(f"{100 * row[name]:.1f}" for name in ("all", "objects", "objects_without_background")),
            *(f"{row[name]:.4f}" for name in ("nll", "ece", "ece_background")),
            *(f"{row[name]:.2f}" for name in ("expected", "brought")),
        ]
        for row in judged
    ]
    return "\n".join(
        [
            f"Trained on {trained} photographs, judged on {held_out} that were held out, in explorations by the closer "
            "look: share of the cells whose most probable answer is right, background among the answers; of the cells "
            "with objects, background an answer or not; negative log likelihood and expected calibration error of the "
            "probabilities of the classes at hand and of background; and how many cells more the last look was "
            "expected to name right, and did.",
            "",
            *table([head, *rows]),
            "",
        ]
    )
