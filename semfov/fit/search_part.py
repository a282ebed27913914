"""The part of a model folder that guides searches: an observation model fitted to them, compared with raw scores."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from semfov.belief.observers import Semantic, SemanticSearch
from semfov.data.scene import legal_targets
from semfov.episode import StoredLooks
from semfov.errors import DataError
from semfov.fit.detector_report import Difference, curves_figure, curves_table, section
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.presence import thresholds_of_searches
from semfov.fit.search import FitSearchConfig, fit_search, search_photographs
from semfov.fit.thresholds import SUREST, SUREST_OF_FEW
from semfov.gaze.policies import Policy
from semfov.metrics.episodes import FloatArray, cumulative_performance
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds
from semfov.runs.progress import track
from semfov.runs.protocols import Trial, episodes_of, run_episodes
from semfov.runs.seeds import noise_for
from semfov.strategy import Strategy
from semfov.viz.style import save_figure

_ABSENT = 1000  # thresholds are chosen on about this many searches for absent classes
_MOST_ABSENT = 20  # and at most so many of them in a photograph
_FEW_ALARMS = 10  # with fewer expected false alarms, one of them would push the threshold up


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
        }

    def fit(self) -> PartResult:
        """Fit, and compare searches with those of raw scores."""
        # Held-out photographs choose the thresholds, and judge.
        fitted = fit_search(self._start(), self.settings, self.run, hold_out=True)
        model = fitted.model
        presence = model.presence
        assert presence is not None
        presence.thresholds = self._thresholds(model, presence)
        strategies = self._strategies(model)
        curves = self._curves(strategies)
        if not len(curves["raw"]):
            raise DataError("data: none of the held-out photographs contains a class to search for; give more of them")
        gain, why = self._compare(curves)
        report = "\n".join([self._report_on_curves(curves), fitted.report])
        save_figure(curves_figure(curves), self.config.out / "search.png")
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
        """Make the strategies that are compared: with the fitted model, and with raw scores."""
        strategies = {
            "fitted": Strategy(SemanticSearch(model), Policy("non-predictive")),
            "raw": Strategy(Semantic(self.inputs.components), Policy("non-predictive")),
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
            if episodes:
                for name, curve in self._search(index, episodes, strategies).items():
                    curves[name].append(curve)
        return {name: np.array(rows).reshape(-1, protocol.shifts + 1) for name, rows in curves.items()}

    @torch.inference_mode()
    def _search(
        self, index: int, episodes: Sequence[Trial], strategies: Mapping[str, Strategy]
    ) -> dict[str, FloatArray]:
        """Search a photograph by all strategies; returns cumulative performances `(shifts+1,)`."""
        run = self.run
        protocol = self.inputs.protocol
        grid = run.grid(index)
        scene = run.scenes.ids[index]
        looks = StoredLooks(run.detections(index), grid, torch.tensor([episode.cue for episode in episodes]))
        # All strategies break ties in the same way, so that their difference is paired.
        noises = [noise_for(protocol, len(grid), scene, trial.target, trial.repetition) for trial in episodes]
        noise = torch.stack(noises)  # (B, shifts + 1, X·Y)
        curves = {}
        for name, strategy in strategies.items():
            ends = run_episodes(episodes, strategy, looks, noise, shifts=protocol.shifts, batch=protocol.batch)
            found_at = np.array([shift for _, shift in ends])
            curves[name] = cumulative_performance(found_at, protocol.shifts)
        return curves

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

    def _report_on_curves(self, curves: Mapping[str, FloatArray]) -> str:
        """Write the section about the searches."""
        protocol = self.inputs.protocol
        shifts = (1, self.inputs.compared_at, protocol.shifts)
        return section(
            f"Targets found after n gaze shifts, in %, on {len(curves['raw'])} held-out photographs with "
            f"{protocol.starts} starting points for each target. `raw` fuses the raw scores.",
            curves_table(["belief", *(f"CP@{n}" for n in shifts)], curves, shifts),
        )
