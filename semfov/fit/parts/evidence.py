"""The target evidence of a detector with the thresholds of decisions, compared with raw scores."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import ClassVar

import torch

from semfov.belief.grid import Grid
from semfov.belief.observers import Semantic, Target
from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.decision import decide
from semfov.episode import Step
from semfov.errors import DataError
from semfov.fit.comparison import Difference, Rule, by_detection, decisions, search_curves
from semfov.fit.detector_report import curves_figure, in_words, mean_percent, percent_of, section
from semfov.fit.evidence import FitSearchConfig, fit_evidence, judge_evidence
from semfov.fit.evidence import evidence_report as judged_report
from semfov.fit.evidence_examples import make_examples
from semfov.fit.parts.base import MAP_SHIFTS, PartFit, PartResult, strategy
from semfov.gaze.policies import NonPredictive
from semfov.strategy import Strategy
from semfov.viz.style import save_figure

_ABSENT = 1000
"""Thresholds are chosen on about this many searches for absent classes, at most 20 in a photograph."""
SUREST, SUREST_OF_FEW = 0.99, 0.9
"""Upper limit of the threshold for reporting a target as found. The second value is for few expected false alarms.

If the threshold were higher than any search reaches, nothing would ever be found. With few searches, a single false
alarm could push it that high.
"""


class EvidenceFit(PartFit):
    """Train the target evidence, and choose its thresholds."""

    name: ClassVar[str] = "evidence"

    @property
    def settings(self) -> FitSearchConfig:
        """The settings of the training."""
        return self.config.evidence(self.inputs.components - 1)

    @property
    def tasks(self) -> dict[str, float]:
        """The tasks and their seconds."""
        judged = len(self.inputs.judged)
        return {
            "describing looks": 0.05 * len(self.run.scenes),
            "training": 0.1 * self.settings.steps,
            "searching": judged,
            "deciding": judged,
        }

    def choose_thresholds(self, model: TargetEvidence) -> Thresholds:
        """Choose the thresholds of decisions on the held-out photographs."""
        config, inputs = self.settings, self.inputs
        grid = Grid(config.columns, config.rows, (config.columns, config.rows))
        # More searches for absent classes give a more precise share of false alarms, and there are many such classes.
        each = max(config.classes, min(20, _ABSENT // len(inputs.held_out)))
        area, scenes = config.max_target_area, inputs.held_out
        wide = make_examples(self.run, config.classes, area, config.seed, absent=each, scenes=scenes)
        expected = config.false_alarms * int((~wide.goal.any(-1)).sum())
        surest = SUREST_OF_FEW if expected < 10 else SUREST
        return judge_evidence(replace(config, surest=surest), model, wide, grid)[1]

    def fit(self) -> PartResult:
        """Train, and compare searches and their decisions with those of raw scores."""
        config, run, inputs = self.settings, self.run, self.inputs
        fit = fit_evidence(config, run)
        fit.model.thresholds = thresholds = self.choose_thresholds(fit.model)
        learned = strategy(Target(fit.model), NonPredictive())
        ways = {
            "fitted": learned,
            "raw": strategy(Semantic(inputs.components), NonPredictive()),
            "fused": strategy(inputs.semantic, NonPredictive()),
        }
        protocol, judged = inputs.protocol, inputs.judged
        curves = search_curves(run, judged, ways, protocol, config.max_target_area)
        if not len(curves["raw"]):
            raise DataError("data: none of the held-out photographs contains a class to search for; give more of them")
        at = min(MAP_SHIFTS, protocol.shifts)
        gain = Difference.of(curves["fitted"][:, at], curves["raw"][:, at])
        why = (
            f"{100 * curves['fitted'][:, at].mean():.1f} % of the targets are found in {at} gaze shifts, "
            f"{100 * curves['raw'][:, at].mean():.1f} % with raw scores; {in_words(gain, 'points gained', 100)}"
        )
        rules: dict[str, tuple[Strategy, Rule]] = {
            "fitted": (learned, partial(_by_thresholds, thresholds=thresholds)),
            "raw": (ways["raw"], by_detection),
        }
        decided = decisions(run, judged, rules, protocol, config.classes, config.max_target_area)
        shifts = (1, at, protocol.shifts)
        rows = [["belief", *(f"CP@{n}" for n in shifts)]]
        rows += [[name, *(mean_percent(curve[:, n]) for n in shifts)] for name, curve in curves.items()]
        outcomes = [["belief", "found, present, %", "found, absent, %", "undecided, %", "looks"]]
        outcomes += [
            [name, percent_of(d.found), percent_of(d.false_alarms), percent_of(d.undecided), f"{d.looks:.1f}"]
            for name, d in decided.items()
        ]
        report = "\n".join(
            [
                section(
                    f"Targets found after n gaze shifts, in %, on {len(curves['raw'])} held-out photographs with "
                    f"{protocol.starts} starting points for each target. `raw` fuses the raw scores; `fused` uses the "
                    "exponent chosen under Tempering.",
                    rows,
                ),
                section(
                    f"Decisions of {decided['fitted'].searches} searches for present and for absent classes. A target "
                    f"counts as found from a probability of {thresholds.confirm:.2f} on, and a search gives up when no "
                    f"cell has a probability of {thresholds.give_up:.2f} or more. These thresholds were chosen on the "
                    "same photographs. With raw scores, a score of 0.5 in the fixated cell counts as found, and no "
                    "search gives up.",
                    outcomes,
                ),
                judged_report(fit.judged, thresholds, fit.trained, fit.held_out),
            ]
        )
        save_figure(curves_figure(curves, "search"), self.config.out / "search.png")
        return PartResult(self.write(fit.model, gain.better, why), report, ["search.png"])


def _by_thresholds(step: Step, target: int, grid: Grid, *, thresholds: Thresholds) -> torch.Tensor:
    return decide(step, target, thresholds)
