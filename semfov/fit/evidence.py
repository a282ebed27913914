"""Train the target evidence on the looks of whole searches."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.belief.look_features import highest_score, look_features
from semfov.belief.observers.target import Target, TargetBelief, TargetLook
from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.data.scene import Scenes
from semfov.decision import place_known
from semfov.episode import Step
from semfov.errors import DataError
from semfov.fit.examples import Examples, example_episodes
from semfov.fit.looking import Looking
from semfov.fit.protocols import choose_classes, numbers_drawn
from semfov.fit.settings import FitOnLooksConfig
from semfov.fit.thresholds import choose_thresholds
from semfov.fit.training import Fit, descend, split, training_of
from semfov.gaze.acquisition import TargetPosterior
from semfov.io.ranges import Count, Positive, Share, Weight
from semfov.metrics.calibration import calibration_error
from semfov.metrics.episodes import area_under_roc
from semfov.runs.progress import track
from semfov.runs.tables import table

_JUDGED = (1, 5, 15)  # numbers of looks after which a belief is evaluated
_EPSILON = 1e-7  # keeps the log odds of certain beliefs finite


@dataclass(frozen=True)
class FitSearchConfig(FitOnLooksConfig):
    """Train the evidence for a target.

    Args:
        classes: maximum number of present classes to learn from in each photograph.
        absent: maximum number of absent classes to learn from in each photograph (None: as many as present ones).
        max_target_area: classes that cover a larger share of the image are not searched for.
        landing: weight of the loss term for landing on the target with the next fixation.
        presence: weight of the loss term for predicting whether the target is in the photograph.
        selected: weight of the loss term for two selected cells: the next to fixate, and the most probable fixated one.
        false_alarms: maximum share of absent targets that may be reported as found; it determines the threshold.
        surest: upper limit of that threshold, even if more false alarms result.
        lost: maximum share of the targets that may be missed because their cell is not certain enough, and maximum
            further share that may be missed because the search gives up.
    """

    classes: Count = 2
    absent: Count | None = None
    max_target_area: Positive = 0.2
    landing: Weight = 1.0
    presence: Weight = 0.5
    selected: Weight = 1.0
    false_alarms: Share = 0.015
    surest: Share = 1.0
    lost: Share = 0.02
    out: Path = Path("runs/fit_search")


@dataclass(frozen=True)
class TargetExamples(Examples):
    """One example for each pair of photograph and class, present or not.

    Features are `(E, X·Y, X·Y, F)`: what a look from each cell tells about each cell.

    Attributes:
        goal: `(E, X·Y)` boolean, the cells that objects of the class overlap.
    """

    looks = TargetLook

    goal: Tensor


def make_examples(run: Looking, config: FitSearchConfig, scenes: Sequence[int] | None = None) -> TargetExamples:
    """Make examples from photographs for present and for absent classes.

    Args:
        run: the photographs and their stored looks.
        config: how classes are drawn.
        scenes: numbers of the photographs; None: all.

    Returns:
        The examples.

    Raises:
        DataError: no photograph has a class that may be searched for.
    """
    title = "describing looks" if scenes is None else "describing others"
    # A row is the fields of one example.
    rows = []
    for index in track(range(len(run.scenes)) if scenes is None else scenes, title, "scene"):
        rows += _examples_of_scene(run, config, index)
    if not rows:
        raise DataError("data: no photograph has a class that may be searched for; raise max_target_area")
    return TargetExamples(*(torch.stack(column) for column in zip(*rows, strict=True)))


def _examples_of_scene(run: Looking, config: FitSearchConfig, index: int) -> list[tuple[Tensor, ...]]:
    """Make the examples of one photograph, each as the fields of `TargetExamples` without a batch dimension."""
    annotation = run.scenes.annotation(index)
    grid = run.grid(index)
    targets = choose_classes(
        run.scenes, index, annotation, config.classes, config.max_target_area, config.seed, config.absent
    )
    if not targets:
        return []
    covered = grid.footprint(annotation.boxes)
    detections = run.detections(index)
    rows: list[tuple[Tensor, ...]] = []
    for target in targets:
        goal = covered[annotation.labels == target].any(0)
        if goal.all():  # every fixation would find it
            continue
        with torch.inference_mode():
            # In half precision, since the features of all pairs of cells fill the memory.
            features = look_features(detections, grid.centres, grid, target).half()
        score = highest_score(detections, target)
        rows.append((features, score, grid.cell_distance, torch.tensor(index), torch.tensor(target), goal))
    return rows


def fit_evidence(config: FitSearchConfig, run: Looking) -> Fit[TargetEvidence]:
    """Train the target evidence, evaluate it on held-out photographs, and choose its thresholds there.

    Args:
        config: settings of examples, training and thresholds.
        run: the photographs and their stored looks.

    Returns:
        The model with its report.

    Raises:
        DataError: the photographs have no class to search for, or too few to hold some out.
    """
    examples = make_examples(run, config)
    held_out = split(examples.scene, config.holdout)
    # Only numbers of cells matter from here on: photographs of all sizes share one grid of one pixel a cell.
    grid = Grid(*config.cells, config.cells)
    metadata = {**run.eye.settings(), **training_of(config, run.scenes)}
    model = _train_evidence(config, examples[~held_out], grid, metadata, len(run.scenes.classes) + 1)
    model.shares = search_shares(run.scenes, config)
    judged, model.thresholds = judge_evidence(config, model, examples[held_out], grid)
    trained = int((~held_out).sum())
    report = _evidence_report(judged, model.thresholds, trained, int(held_out.sum()))
    return Fit(model, judged, trained, int(held_out.sum()), report)


def search_shares(scenes: Scenes, config: FitSearchConfig) -> Tensor:
    """Compute the share of the searches for each class whose target is there.

    Half a search for and against is added.

    Args:
        scenes: the photographs.
        config: how classes are drawn.

    Returns:
        The shares, `(K,)`.
    """
    there, missing = numbers_drawn(scenes, config.classes, config.max_target_area, config.absent)
    return ((there + 0.5) / (there + missing + 1)).float()


def _train_evidence(
    config: FitSearchConfig, examples: TargetExamples, grid: Grid, metadata: dict[str, object], components: int
) -> TargetEvidence:
    """Train the model on searches that it makes itself. Some of their fixations are random."""
    generator = torch.Generator().manual_seed(config.seed)
    # The weights begin the same, and the caller's random numbers stay as they are.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = TargetEvidence(components=components, metadata=metadata)

    def loss_of(number: int) -> Tensor:
        batch = examples[torch.randint(len(examples), (config.batch,), generator=generator)]
        # At first the model has learned nothing, so its own choice of fixations would be no better than random ones.
        astray = 1.0 if number < config.steps // 20 else config.astray * (number % 2)
        # The first look and two random ones stand for all.
        counted = (1, *torch.randint(2, config.looks + 1, (2,), generator=generator).tolist())
        observer = Target(model, together=True)
        # Every example has its own class, so that the policy's class, 1, is only a name.
        loss = batch.score.new_zeros(())
        for step in example_episodes(batch, observer, TargetPosterior(1), grid, config.looks, astray, generator):
            if step.shift + 1 in counted:
                loss = loss + evidence_objective(config, step, batch.goal)
        return loss

    descend(model.parameters(), loss_of, config.steps, config.rate)
    return model.eval()


def evidence_objective(config: FitSearchConfig, step: Step, goal: Tensor) -> Tensor:
    r"""Compute the training loss after a look.

    .. math:: \sum_x \mathrm{BCE}(P(t \in x)) / 25 + w_g \sum_{x \in \{a, b\}} \mathrm{BCE}(P(t \in x))
              + w_p \, \mathrm{BCE}(P(t)) - w_l \ln \frac{\sum_{x \in \text{goal}} o(x)}{\sum_x o(x)},
              \qquad o = p / (1 - p)

    for 100 cells. The last term is the log probability that a fixation drawn by the odds o lands on the target.

    Args:
        config: weights of the terms.
        step: a look of E searches, with the belief after it.
        goal: `(E, X·Y)` boolean, the cells that hold the target.

    Returns:
        A scalar.
    """
    belief = step.belief
    assert isinstance(belief, TargetBelief)
    log_odds = belief.present.logit(eps=_EPSILON)
    present = goal.any(-1).to(belief.anywhere)
    # 4 times the mean over cells is the sum over 100 cells divided by 25.
    loss = 4 * F.binary_cross_entropy_with_logits(log_odds, goal.to(log_odds))
    loss = loss + config.presence * F.binary_cross_entropy(belief.anywhere, present)
    # The next cell, and the most probable fixated one, are selected by their probability, which is biased by that.
    most_probable = log_odds.detach().masked_fill(~step.visited, -torch.inf).argmax(-1)
    for cell in (step.next_cell, most_probable):
        holds = goal.gather(-1, cell[:, None]).to(log_odds)
        loss = loss + config.selected * F.binary_cross_entropy_with_logits(log_odds.gather(-1, cell[:, None]), holds)
    # A real search ends when it fixates the target, so there is no next fixation to learn.
    going = goal.any(-1) & ~(goal & step.visited).any(-1)
    if going.any():
        following = belief.following.logit(eps=_EPSILON)[going].masked_fill(step.visited[going], -torch.inf)
        landing = following.masked_fill(~goal[going], -torch.inf).logsumexp(-1) - following.logsumexp(-1)
        loss = loss - config.landing * landing.mean()
    return loss


@torch.no_grad()
def judge_evidence(
    config: FitSearchConfig, model: TargetEvidence, examples: TargetExamples, grid: Grid
) -> tuple[list[dict[str, float]], Thresholds]:
    """Evaluate the model on held-out searches, and choose its thresholds.

    Args:
        config: seed and length of the searches, and bounds of the thresholds.
        model: the target evidence.
        examples: held-out photographs and classes.
        grid: the cells.

    Returns:
        The measures after each number of looks in `_JUDGED`, and the thresholds.
    """
    generator = torch.Generator().manual_seed(config.seed)
    looks = max(*_JUDGED, config.looks)
    present, anywhere, following, visited = [], [], [], []  # one tensor for each look
    observer = Target(model, together=True)
    for step in example_episodes(examples, observer, TargetPosterior(1), grid, looks, 0.0, generator):
        assert isinstance(step.belief, TargetBelief)
        present.append(step.belief.present)
        anywhere.append(step.belief.anywhere)
        following.append(step.belief.following.masked_fill(step.visited, 0).amax(-1))
        visited.append(step.visited)
    judged = [
        {"looks": number, **_measures(present[number - 1], anywhere[number - 1], visited[number - 1], examples.goal)}
        for number in _JUDGED
        if number <= len(present)
    ]
    cells = torch.stack(present)
    fixated = torch.stack(visited)
    place = cells.masked_fill(~fixated, 0).amax(-1) * place_known(cells, fixated)
    there = examples.goal.any(-1)
    return judged, choose_thresholds(config, torch.stack(anywhere), place, torch.stack(following), there)


def _measures(cells: Tensor, anywhere: Tensor, visited: Tensor, goal: Tensor) -> dict[str, float]:
    """Measure the probabilities of E searches after a look; anywhere `(E,)`, the others `(E, X·Y)`."""
    there = goal.any(-1)
    return {
        "found": float((visited & goal).any(-1)[there].double().mean()),
        "cells_nll": float(F.binary_cross_entropy(cells.double(), goal.double())),
        "cells_ece": float(calibration_error(cells.flatten(), goal.flatten())),
        "visited_ece": float(calibration_error(cells[visited], goal[visited])),
        "presence_area": area_under_roc(anywhere, there),
        "presence_ece": float(calibration_error(anywhere, there)),
    }


def _evidence_report(judged: list[dict[str, float]], thresholds: Thresholds, trained: int, held_out: int) -> str:
    """Report the evaluation and the thresholds as Markdown."""
    measures = {
        "NLL of cells": "cells_nll",
        "ECE of cells": "cells_ece",
        "ECE, fixated": "visited_ece",
        "area under ROC": "presence_area",
        "ECE, presence": "presence_ece",
    }
    rows = [["looks", "gaze on target, %", *measures]]
    for row in judged:
        figures = (f"{row[name]:.4f}" for name in measures.values())
        rows.append([str(int(row["looks"])), f"{100 * row['found']:.1f}", *figures])
    return "\n".join(
        [
            f"Trained on {trained} pairs of photograph and class, and evaluated on {held_out} pairs from held-out "
            "photographs. In about half of the pairs the class is absent. The searches follow the model. The table "
            "shows how often the gaze has reached the target; negative log likelihood (NLL) and expected calibration "
            "error (ECE) of the probability of the target in each cell; the ECE for fixated cells alone; and how well "
            "the probability of presence separates present from absent classes.",
            "",
            *table(rows),
            "",
            f"Thresholds: the target counts as found if the probability of its presence is at least "
            f"{thresholds.confirm:.3f} and that of a fixated cell at least {thresholds.place:.2f}. The search gives up "
            f"if no other cell has a probability of at least {thresholds.stop_below:.2f}.",
            "",
        ]
    )
