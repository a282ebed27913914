"""The part of a model folder that guides searches: an observation model fitted to them, compared with raw scores."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Semantic, SemanticSearch
from semfov.data.scene import legal_targets
from semfov.decision import OUTCOMES, confirms, decide
from semfov.episode import Step, StoredLooks
from semfov.errors import DataError
from semfov.fit.detector_report import Difference, curves_figure, curves_table, section
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.presence import thresholds_of_searches
from semfov.fit.protocols import choose_searches, episodes_of, run_episodes, search_steps
from semfov.fit.search import FitSearchConfig, fit_search, search_photographs, search_report
from semfov.fit.thresholds import SUREST, SUREST_OF_FEW
from semfov.gaze.policies import Policy
from semfov.metrics.episodes import FloatArray, cumulative_performance
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds
from semfov.runs.progress import track
from semfov.runs.seeds import noise_for
from semfov.runs.tables import mean_or_dash, share
from semfov.strategy import Strategy
from semfov.viz.style import save_figure

_ABSENT = 1000  # thresholds are chosen on about this many searches for absent classes
_MOST_ABSENT = 20  # and at most so many of them in a photograph
_FEW_ALARMS = 10  # with fewer expected false alarms, one of them would push the threshold up
_RAW_CONFIRM = 0.5  # score from which on agents without fitted models find the target in the fixated cell


class _Rule(Protocol):
    """What decides which searches for a target end with a step."""

    def __call__(self, step: Step, target: int, grid: Grid) -> Tensor:
        """Return the numbers of their outcomes, 0 for those that go on."""


class _Decision(NamedTuple):
    """The decision of a search: whether the class is there, the outcome, and the number of looks until then."""

    present: bool
    outcome: str
    looks: int


class SearchFit(PartFit):
    """Fit the odds of a miss and the presence, and choose thresholds."""

    settings: FitSearchConfig

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        self.settings = inputs.settings(FitSearchConfig)
        photographs = len(self.run.scenes)
        judged = len(inputs.judged)
        self.tasks = {
            "reading looks": 0.05 * photographs,
            "fitting through the belief": 0.3 * self.settings.steps,
            "searching": 0.1 * photographs,
            "looking at cells": 0.1 * photographs,
            "searching for more": 0.2 * len(inputs.held_out),
            "comparing": judged,
            "deciding": judged,
        }

    def fit(self) -> PartResult:
        """Fit, and compare searches and their decisions with those of raw scores."""
        # Held-out photographs choose the thresholds, and judge.
        fitted = fit_search(self._start(), self.settings, self.run, hold_out=True)
        model = fitted.model
        presence = model.presence
        assert presence is not None
        presence.thresholds = thresholds = self._thresholds(model, presence)
        strategies = self._strategies(model)
        curves = self._curves(strategies)
        if not len(curves["raw"]):
            raise DataError("data: none of the held-out photographs contains a class to search for; give more of them")
        gain, why = self._compare(curves)
        rules: dict[str, _Rule] = {
            "fitted": partial(_decide_by_belief, thresholds=thresholds),
            "raw": _decide_by_score,
        }
        decisions = self._decisions({name: (strategies[name], rule) for name, rule in rules.items()})
        report = "\n".join(
            [
                self._report_on_curves(curves),
                _report_on_decisions(decisions, thresholds),
                search_report(fitted.judged, presence, fitted.trained, fitted.held_out),
            ]
        )
        save_figure(curves_figure(curves, "search"), self.config.out / "search.png")
        return PartResult(self.write("search", model, gain.better, why), report, ["search.png"])

    def _start(self) -> FovealObservationModel:
        """Take the observation model of the folder; where raw scores are better, the one that leaves them unchanged."""
        fitted = self.inputs.model("observation")
        if isinstance(fitted, FovealObservationModel):
            return fitted
        return FovealObservationModel.identity(self.run.scenes.classes, self.config.sensor.level_edges())

    def _thresholds(self, model: FovealObservationModel, presence: Presence) -> Thresholds:
        """Choose thresholds on held-out photographs with many absent classes, for a precise share of alarms."""
        config = self.settings
        held_out = self.inputs.held_out
        absent = max(config.absent, min(_MOST_ABSENT, _ABSENT // len(held_out)))
        more = replace(config, absent=absent)
        searches = search_photographs(model, self.run, more, held_out, title="searching for more")
        expected_alarms = config.false_alarms * int((~searches.there).sum())
        bounds = replace(config, surest=SUREST_OF_FEW if expected_alarms < _FEW_ALARMS else SUREST)
        return thresholds_of_searches(presence, searches, bounds)

    def _strategies(self, model: FovealObservationModel) -> dict[str, Strategy]:
        """Make the strategies that are compared: with the fitted model, with raw scores, and with tempered ones."""
        strategies = {
            "fitted": Strategy(SemanticSearch(model), Policy("non-predictive")),
            "raw": Strategy(Semantic(self.inputs.components), Policy("non-predictive")),
            "fused": Strategy(self.inputs.semantic, Policy("non-predictive")),
        }
        for strategy in strategies.values():
            strategy.eval().requires_grad_(False)
        return strategies

    def _curves(self, strategies: Mapping[str, Strategy]) -> dict[str, FloatArray]:
        """Search every held-out photograph with a target; returns cumulative performances `(P, shifts+1)`."""
        run = self.run
        protocol = self.inputs.protocol
        curves: dict[str, list[FloatArray]] = {name: [] for name in strategies}
        for index in track(self.inputs.judged, "comparing", "scene"):
            targets = legal_targets(run.scenes.annotation(index), self.settings.max_target_area)
            episodes = episodes_of(run.scenes, index, *run.cells, protocol, targets)
            if not episodes:
                continue
            grid = run.grid(index)
            looks = StoredLooks(run.detections(index), grid, torch.tensor([episode.cue for episode in episodes]))
            # All strategies break ties in the same way, so that their difference is paired.
            noise = torch.stack(
                [
                    noise_for(protocol, len(grid), run.scenes.ids[index], episode.target, episode.repetition)
                    for episode in episodes
                ]
            )
            for name, strategy in strategies.items():
                with torch.inference_mode():
                    ends = run_episodes(episodes, strategy, looks, noise, shifts=protocol.shifts, batch=protocol.batch)
                found_at = np.array([shift for _, shift in ends])
                curves[name].append(cumulative_performance(found_at, protocol.shifts))
        return {name: np.array(rows).reshape(-1, protocol.shifts + 1) for name, rows in curves.items()}

    def _compare(self, curves: Mapping[str, FloatArray]) -> tuple[Difference, str]:
        """Compare the fitted model with raw scores; the difference, and the sentence about it."""
        at = self.inputs.compared_at
        fitted = curves["fitted"][:, at]
        raw = curves["raw"][:, at]
        gain = Difference.of(fitted, raw)
        return gain, (
            f"{100 * fitted.mean():.1f} % of the targets are found in {at} gaze shifts, "
            f"{100 * raw.mean():.1f} % with raw scores; {gain.in_words('points gained', 100)}"
        )

    def _decisions(self, ways: Mapping[str, tuple[Strategy, _Rule]]) -> dict[str, list[_Decision]]:
        """Search held-out photographs for present and absent classes, each with its strategy and rule."""
        run = self.run
        config = self.settings
        decisions: dict[str, list[_Decision]] = {name: [] for name in ways}
        for index in track(self.inputs.judged, "deciding", "scene"):
            grid = run.grid(index)
            searches = choose_searches(
                run.scenes, index, grid, self.inputs.protocol, config.classes, config.max_target_area, config.classes
            )
            if not searches:
                continue
            labels = run.scenes.annotation(index).labels
            detections = run.detections(index)
            for search in searches:
                looks = StoredLooks(detections, grid, torch.tensor([search.target]))
                present = bool((labels == search.target).any())
                for name, (strategy, rule) in ways.items():
                    ends = partial(rule, target=search.target, grid=grid)
                    with torch.inference_mode():
                        steps = search_steps(looks, strategy, search.target, search.start, search.noise, ends)
                        outcome = OUTCOMES[int(ends(steps[-1]))]
                    decisions[name].append(_Decision(present, outcome, len(steps)))
        return decisions

    def _report_on_curves(self, curves: Mapping[str, FloatArray]) -> str:
        """Write the section about the searches."""
        protocol = self.inputs.protocol
        shifts = (1, self.inputs.compared_at, protocol.shifts)
        return section(
            f"Targets found after n gaze shifts, in %, on {len(curves['raw'])} held-out photographs with "
            f"{protocol.starts} starting points for each target. `raw` fuses the raw scores; `fused` uses the "
            "exponent chosen under Tempering.",
            curves_table(["belief", *(f"CP@{n}" for n in shifts)], curves, shifts),
        )


def _decide_by_belief(step: Step, target: int, grid: Grid, *, thresholds: Thresholds) -> Tensor:
    """Decide by the belief of the fitted model."""
    return decide(step, target, thresholds)


def _decide_by_score(step: Step, target: int, grid: Grid) -> Tensor:
    """Decide as agents without fitted models do."""
    return confirms(step.detections, grid, step.cell, target, _RAW_CONFIRM).long()


def _report_on_decisions(decisions: Mapping[str, Sequence[_Decision]], thresholds: Thresholds) -> str:
    """Write the section about the decisions."""
    rows = [["belief", "found, present, %", "found, absent, %", "undecided, %", "looks"]]
    for name, of_belief in decisions.items():
        rows.append(
            [
                name,
                _share_found(of_belief, present=True),
                _share_found(of_belief, present=False),
                share(sum(decision.outcome == "undecided" for decision in of_belief), len(of_belief)),
                mean_or_dash([decision.looks for decision in of_belief]),
            ]
        )
    return section(
        f"Decisions of {len(decisions['fitted'])} searches for present and for absent classes. A target "
        f"counts as found from a probability of {thresholds.confirm:.2f} on, and a search gives up when no "
        f"cell has a probability of {thresholds.stop_below:.2f} or more. These thresholds were chosen on the "
        "same photographs. With raw scores, a score of 0.5 in the fixated cell counts as found, and no "
        "search gives up.",
        rows,
    )


def _share_found(decisions: Sequence[_Decision], *, present: bool) -> str:
    """Format the share of the searches for present or for absent classes that find their target."""
    found = [decision.outcome == "found" for decision in decisions if decision.present == present]
    return share(sum(found), len(found))
