"""Train the target evidence on the looks of whole searches, and compare it with raw scores."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.grid import Grid
from semfov.belief.look_features import highest_score, look_features
from semfov.belief.observers import Semantic
from semfov.belief.observers.target import Target, TargetBelief, TargetLook
from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.data.scene import Scenes, legal_targets
from semfov.decision import OUTCOMES, confirms, decide, place_known
from semfov.episode import Step, StoredLooks
from semfov.errors import DataError
from semfov.fit.detector_report import Difference, curves_figure, mean_percent, section
from semfov.fit.examples import Examples, example_episodes
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.settings import FitOnLooksConfig
from semfov.fit.training import Fit, descend, split, training_of
from semfov.gaze.acquisition import TargetPosterior
from semfov.gaze.policies import Policy
from semfov.metrics.calibration import calibration_error
from semfov.metrics.episodes import FloatArray, area_under_roc, cumulative_performance
from semfov.runs.looking import Looking
from semfov.runs.progress import track
from semfov.runs.protocols import (
    choose_classes,
    choose_searches,
    episodes_of,
    numbers_drawn,
    run_episodes,
    search_steps,
)
from semfov.runs.seeds import noise_for
from semfov.runs.settings import Count, Positive, Share, Weight
from semfov.runs.tables import mean_or_dash, share, table
from semfov.strategy import Strategy
from semfov.viz.style import save_figure

_JUDGED = (1, 5, 15)  # numbers of looks after which a belief is evaluated
_ABSENT = 1000  # thresholds are chosen on about this many searches for absent classes, at most 20 in a photograph
SUREST, SUREST_OF_FEW = 0.99, 0.9
"""Upper limit of the threshold for found targets, and that for few searches, in which one false alarm pushes it up."""


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
class _TargetExamples(Examples):
    """One for each pair of photograph and class, present or not; features `(E, X·Y, X·Y, F)`, goal `(E, X·Y)`."""

    looks = TargetLook

    goal: Tensor


def _make_examples(run: Looking, config: FitSearchConfig, scenes: Sequence[int] | None = None) -> _TargetExamples:
    """Make examples from photographs for present and for absent classes."""
    rows, drawn = [], (config.classes, config.max_target_area, config.seed, config.absent)
    those, title = (range(len(run.scenes)), "describing looks") if scenes is None else (scenes, "describing others")
    for index in track(those, title, "scene"):
        annotation, grid = run.scenes.annotation(index), run.grid(index)
        covered = grid.footprint(annotation.boxes)
        chosen = choose_classes(run.scenes, index, annotation, *drawn)
        detections = run.detections(index) if chosen else None
        for target in chosen:
            assert detections is not None
            goal = covered[annotation.labels == target].any(0)
            if goal.all():
                continue
            with torch.inference_mode():
                features = look_features(detections, grid.centres, grid, target).half()
            score, where = highest_score(detections, target), torch.tensor(index)
            rows.append((features, score, grid.cell_distance, where, torch.tensor(target), goal))
    if not rows:
        raise DataError("data: no photograph has a class that may be searched for; raise max_target_area")
    return _TargetExamples(*(torch.stack(column) for column in zip(*rows, strict=True)))


def fit_evidence(config: FitSearchConfig, run: Looking) -> Fit[TargetEvidence]:
    examples = _make_examples(run, config)
    held_out = split(examples.scene, config.holdout)
    grid = Grid(*config.cells, config.cells)
    metadata = {**run.eye.settings(), **training_of(config, run.scenes)}
    model = _train_evidence(config, examples[~held_out], grid, metadata, len(run.scenes.classes) + 1)
    model.shares = search_shares(run.scenes, config)
    judged, model.thresholds = _judge_evidence(config, model, examples[held_out], grid)
    counts = int((~held_out).sum()), int(held_out.sum())
    return Fit(model, judged, *counts, _evidence_report(judged, model.thresholds, *counts))


def search_shares(scenes: Scenes, config: FitSearchConfig) -> Tensor:
    """Share of the searches for each class whose target is there, `(K,)`, half a search for and against added."""
    there, missing = numbers_drawn(scenes, config.classes, config.max_target_area, config.absent)
    return ((there + 0.5) / (there + missing + 1)).float()


def _train_evidence(
    config: FitSearchConfig, examples: _TargetExamples, grid: Grid, metadata: dict[str, object], components: int
) -> TargetEvidence:
    """Train the model on searches that it makes itself. Some of their fixations are random."""
    generator = torch.Generator().manual_seed(config.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = TargetEvidence(components=components, metadata=metadata)

    def loss_of(number: int) -> Tensor:
        chosen = examples[torch.randint(len(examples), (config.batch,), generator=generator)]
        # At first the model has learned nothing, so its own choice of fixations would be no better than random ones.
        astray = 1.0 if number < config.steps // 20 else config.astray * (number % 2)
        counted = torch.randint(2, config.looks + 1, (2,), generator=generator).tolist()
        loss = chosen.score.new_zeros(())
        learned, policy = Target(model, together=True), TargetPosterior(1)
        for step in example_episodes(chosen, learned, policy, grid, config.looks, astray, generator):
            if step.shift + 1 in (1, *counted):
                loss = loss + evidence_objective(config, step, chosen.goal)
        return loss

    descend(model.parameters(), loss_of, config.steps, config.rate)
    return model.eval()


def evidence_objective(config: FitSearchConfig, step: Step, goal: Tensor) -> Tensor:
    r"""The training loss after a look; goal `(E, X·Y)`.

    .. math:: \sum_x \mathrm{BCE}(P(t \in x)) / 25 + w_g \sum_{x \in \{a, b\}} \mathrm{BCE}(P(t \in x))
              + w_p \, \mathrm{BCE}(P(t)) - w_l \ln \frac{\sum_{x \in \text{goal}} o(x)}{\sum_x o(x)},
              \qquad o = p / (1 - p)

    for 100 cells. The last term is the log probability that a fixation drawn by the odds o lands on the target.
    """
    belief = step.belief
    assert isinstance(belief, TargetBelief)
    cells, present = belief.present.logit(eps=1e-7), goal.any(-1).to(belief.anywhere)
    loss = 4 * F.binary_cross_entropy_with_logits(cells, goal.to(cells))
    loss = loss + config.presence * F.binary_cross_entropy(belief.anywhere, present)
    # The next cell, and the most probable fixated one, are selected by their probability, which is biased by that.
    named = cells.detach().masked_fill(~step.visited, -torch.inf).argmax(-1)
    for chosen in (step.next_cell, named):
        there = goal.gather(-1, chosen[:, None]).to(cells)
        loss = loss + config.selected * F.binary_cross_entropy_with_logits(cells.gather(-1, chosen[:, None]), there)
    # A real search ends when it fixates the target, so there is no next fixation to learn.
    some = goal.any(-1) & ~(goal & step.visited).any(-1)
    if some.any():
        odds = belief.following.logit(eps=1e-7)[some].masked_fill(step.visited[some], -torch.inf)
        landing = odds.masked_fill(~goal[some], -torch.inf).logsumexp(-1) - odds.logsumexp(-1)
        loss = loss - config.landing * landing.mean()
    return loss


@torch.no_grad()
def _judge_evidence(
    config: FitSearchConfig, model: TargetEvidence, examples: _TargetExamples, grid: Grid
) -> tuple[list[dict[str, float]], Thresholds]:
    """Evaluate the model on held-out searches, after each number of looks in `_JUDGED`, and choose its thresholds."""
    generator = torch.Generator().manual_seed(config.seed)
    looks = max(*_JUDGED, config.looks)
    goal, visited, present, anywhere, following = examples.goal, [], [], [], []
    learned, policy = Target(model, together=True), TargetPosterior(1)
    for step in example_episodes(examples, learned, policy, grid, looks, 0.0, generator):
        assert isinstance(step.belief, TargetBelief)
        present.append(step.belief.present)
        anywhere.append(step.belief.anywhere)
        following.append(step.belief.following.masked_fill(step.visited, 0).amax(-1))
        visited.append(step.visited)
    there = goal.any(-1)
    judged = []
    for number in (each for each in _JUDGED if each <= len(present)):
        cells, image, fixated = present[number - 1], anywhere[number - 1], visited[number - 1]
        judged.append(
            {
                "looks": number,
                "found": float((fixated & goal).any(-1)[there].double().mean()),
                "cells_nll": float(F.binary_cross_entropy(cells.double(), goal.double())),
                "cells_ece": float(calibration_error(cells.flatten(), goal.flatten())),
                "visited_ece": float(calibration_error(cells[fixated], goal[fixated])),
                "presence_area": area_under_roc(image, there),
                "presence_ece": float(calibration_error(image, there)),
            }
        )
    cells, fixated = torch.stack(present), torch.stack(visited)
    place = cells.masked_fill(~fixated, 0).amax(-1) * place_known(cells, fixated)
    return judged, choose_thresholds(config, torch.stack(anywhere), place, torch.stack(following), there)


def choose_thresholds(config: Any, anywhere: Tensor, place: Tensor, left: Tensor, there: Tensor) -> Thresholds:
    """Choose thresholds with few false alarms and few missed targets; probabilities `(n, E)`, there `(E,)`."""
    number = torch.arange(len(anywhere))[:, None]

    def found(chosen: Thresholds) -> Tensor:
        """Which searches report the target as found, `(E,)`."""
        sure = (anywhere >= chosen.confirm) & (place > 0) & (place >= chosen.place)
        first = torch.where(sure, number, len(sure)).amin(0)
        return sure.any(0) & ~((left < chosen.give_up) & (number < first)).any(0)

    def hits(chosen: Thresholds) -> int:
        return int(found(chosen)[there].sum())

    def confirming(least: float) -> Thresholds:
        """The lowest `confirm` with few enough false alarms, for a `place`."""
        confirm = 1.0
        for candidate in torch.arange(0.99, 0.49, -0.01).tolist():
            if float(found(Thresholds(candidate, 0.0, least))[~there].double().mean()) > config.false_alarms:
                break
            confirm = candidate
        return Thresholds(min(confirm, config.surest), 0.0, least)

    lost = config.lost * int(there.sum())
    anyhow = confirming(0.0)
    # The highest `place` that misses few of the targets found without one, and then the highest `give_up` likewise.
    pairs = (confirming(least) for least in torch.arange(0.95, 0.04, -0.05).tolist())
    chosen = next((pair for pair in pairs if hits(anyhow) - hits(pair) <= lost), anyhow)
    for give_up in (0.3, 0.25, 0.2, 0.15, 0.1, 0.07, 0.05, 0.03, 0.02, 0.01, 0.007, 0.005, 0.003, 0.002, 0.001):
        if hits(chosen) - hits(chosen.changed(give_up=give_up)) <= lost:
            return chosen.changed(give_up=give_up)
    return chosen


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
            f"if no other cell has a probability of at least {thresholds.give_up:.2f}.",
            "",
        ]
    )


_Rule = Callable[..., Tensor]
"""Decides after a `step` which searches for a `target` end: numbers of their outcomes, 0 for those that go on."""


class EvidenceFit(PartFit):
    """Train the target evidence, and choose its thresholds."""

    settings: FitSearchConfig

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        self.settings = inputs.settings(FitSearchConfig, absent=inputs.absent)
        judged = len(inputs.judged)
        self.tasks = {
            "describing looks": 0.05 * len(self.run.scenes),
            "training": 0.1 * self.settings.steps,
            "describing others": 0.05 * len(self.inputs.held_out),
            "searching": judged,
            "deciding": judged,
        }

    def _curves(self, ways: Mapping[str, Strategy]) -> dict[str, FloatArray]:
        """Cumulative performance of strategies on every photograph with a target, `(P, shifts+1)`."""
        run, protocol = self.run, self.inputs.protocol
        curves: dict[str, list[FloatArray]] = {name: [] for name in ways}
        for index in track(self.inputs.judged, "searching", "scene"):
            targets = legal_targets(run.scenes.annotation(index), self.settings.max_target_area)
            episodes = episodes_of(run.scenes, index, *run.cells, protocol, targets)
            if not episodes:
                continue
            grid, name_of = run.grid(index), run.scenes.ids[index]
            looks = StoredLooks(run.detections(index), grid, torch.tensor([episode.cue for episode in episodes]))
            noise = torch.stack(
                [noise_for(protocol, len(grid), name_of, each.target, each.repetition) for each in episodes]
            )
            for name, way in ways.items():
                with torch.inference_mode():
                    ends = run_episodes(episodes, way, looks, noise, shifts=protocol.shifts, batch=protocol.batch)
                shifts = np.array([found_at for _, found_at in ends])
                curves[name].append(cumulative_performance(shifts, protocol.shifts))
        return {name: np.array(each).reshape(-1, protocol.shifts + 1) for name, each in curves.items()}

    def _decisions(self, ways: Mapping[str, tuple[Strategy, _Rule]]) -> tuple[list[list[str]], int]:
        """Rows of a table of the decisions of strategies, and the number of searches."""
        run, config, protocol = self.run, self.settings, self.inputs.protocol
        results: dict[str, list[tuple[bool, str, int]]] = {name: [] for name in ways}
        drawn = config.classes, config.max_target_area, config.classes
        for index in track(self.inputs.judged, "deciding", "scene"):
            annotation, grid = run.scenes.annotation(index), run.grid(index)
            searches = choose_searches(run.scenes, index, grid, protocol, *drawn)
            detections = run.detections(index) if searches else None
            for search in searches:
                assert detections is not None
                looks = StoredLooks(detections, grid, torch.tensor([search.target]))
                there = bool((annotation.labels == search.target).any())
                for name, (way, rule) in ways.items():
                    ends = partial(rule, target=search.target, grid=grid)
                    with torch.inference_mode():
                        steps = search_steps(looks, way, search.target, search.start, search.noise, ends)
                        outcome = OUTCOMES[int(ends(steps[-1]))]
                    results[name].append((there, outcome, len(steps)))
        rows = [["belief", "found, present, %", "found, absent, %", "undecided, %", "looks"]]
        for name, ended in results.items():
            found = ([each == "found" for there, each, _ in ended if there == present] for present in (True, False))
            shares = [share(sum(each), len(each)) for each in found]
            undecided = share(sum(each == "undecided" for _, each, _ in ended), len(ended))
            rows.append([name, *shares, undecided, mean_or_dash([looks for *_, looks in ended])])
        return rows, len(results["fitted"])

    def fit(self) -> PartResult:
        """Train, and compare searches and their decisions with those of raw scores."""
        config, inputs, fit = self.settings, self.inputs, fit_evidence(self.settings, self.run)
        # Thresholds are chosen with many absent classes, for a precise share of alarms.
        absent = max(config.classes, min(20, _ABSENT // len(inputs.held_out)))
        wide = _make_examples(self.run, replace(config, absent=absent), inputs.held_out)
        expected = config.false_alarms * int((~wide.goal.any(-1)).sum())
        bounds = replace(config, surest=SUREST_OF_FEW if expected < 10 else SUREST)
        thresholds = _judge_evidence(bounds, fit.model, wide, Grid(*config.cells, config.cells))[1]
        fit.model.thresholds = thresholds
        learned = Strategy(Target(fit.model), Policy("non-predictive"))
        ways = {
            "fitted": learned,
            "raw": Strategy(Semantic(inputs.components), Policy("non-predictive")),
            "fused": Strategy(inputs.semantic, Policy("non-predictive")),
        }
        for way in ways.values():
            way.eval().requires_grad_(False)
        protocol, curves = inputs.protocol, self._curves(ways)
        if not len(curves["raw"]):
            raise DataError("data: none of the held-out photographs contains a class to search for; give more of them")
        at = inputs.compared_at
        gain = Difference.of(curves["fitted"][:, at], curves["raw"][:, at])
        why = (
            f"{100 * curves['fitted'][:, at].mean():.1f} % of the targets are found in {at} gaze shifts, "
            f"{100 * curves['raw'][:, at].mean():.1f} % with raw scores; {gain.in_words('points gained', 100)}"
        )
        rules: dict[str, tuple[Strategy, _Rule]] = {
            "fitted": (learned, lambda step, target, grid: decide(step, target, thresholds)),
            # Agents without fitted models find the target by a detection with score 0.5 in the fixated cell.
            "raw": (
                ways["raw"],
                lambda step, target, grid: confirms(step.detections, grid, step.cell, target, 0.5).long(),
            ),
        }
        outcomes, searched = self._decisions(rules)
        shifts = (1, at, protocol.shifts)
        rows = [["belief", *(f"CP@{n}" for n in shifts)]]
        rows += [[name, *(mean_percent(curve[:, n]) for n in shifts)] for name, curve in curves.items()]
        report = "\n".join(
            [
                section(
                    f"Targets found after n gaze shifts, in %, on {len(curves['raw'])} held-out photographs with "
                    f"{protocol.starts} starting points for each target. `raw` fuses the raw scores; `fused` uses the "
                    "exponent chosen under Tempering.",
                    rows,
                ),
                section(
                    f"Decisions of {searched} searches for present and for absent classes. A target "
                    f"counts as found from a probability of {thresholds.confirm:.2f} on, and a search gives up when no "
                    f"cell has a probability of {thresholds.give_up:.2f} or more. These thresholds were chosen on the "
                    "same photographs. With raw scores, a score of 0.5 in the fixated cell counts as found, and no "
                    "search gives up.",
                    outcomes,
                ),
                _evidence_report(fit.judged, thresholds, fit.trained, fit.held_out),
            ]
        )
        save_figure(curves_figure(curves, "search"), self.config.out / "search.png")
        return PartResult(self.write("evidence", fit.model, gain.better, why), report, ["search.png"])
