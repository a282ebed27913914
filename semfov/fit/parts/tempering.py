"""The exponent with which the scores of a detector are fused, compared with raw scores."""

from __future__ import annotations

from typing import ClassVar

import torch

from semfov.belief.observers import Semantic
from semfov.fit.comparison import Difference
from semfov.fit.detector_report import in_words, percent_of, section
from semfov.fit.parts.base import PartFit, PartResult
from semfov.fit.tempering import FitTemperingConfig, hit_rates, means_of
from semfov.io.manifest import Part


class TemperingFit(PartFit):
    """Choose whether scores are calibrated before they are fused, and with which exponent."""

    name: ClassVar[str] = "tempering"

    @property
    def settings(self) -> FitTemperingConfig:
        """The settings of the choice."""
        return self.config.tempering

    @property
    def tasks(self) -> dict[str, float]:
        """The tasks and their seconds."""
        tried = [f"{scores} {t:g}" for scores in ("raw", "calibrated") for t in self.settings.exponents]
        return dict.fromkeys(tried, 0.005 * len(self.run.scenes))

    def fit(self) -> PartResult:
        """Choose, and compare the share of next fixations that hit the target with that of raw scores."""
        config, run, inputs = self.settings, self.run, self.inputs
        ways = ["raw"] if inputs.model("observation") is None else ["raw", "calibrated"]
        baseline = Semantic(inputs.components)
        raw = hit_rates(config, run.scenes, inputs.samples, baseline, "raw")
        rates = {
            (scores, exponent): hit_rates(
                config, run.scenes, inputs.samples, inputs.fusing(scores, exponent), f"{scores} {exponent:g}"
            )
            for scores in ways
            for exponent in config.exponents
        }
        means = {way: means_of(config, each) for way, each in rates.items()}
        scores, exponent = best = max(means, key=lambda way: means[way]["fitted"])
        held_out = [index for index in raw if index % config.holdout == 0]
        chosen = rates[best]
        gain = Difference.of(
            torch.tensor([chosen[index] for index in held_out]).numpy(),
            torch.tensor([raw[index] for index in held_out]).numpy(),
        )
        before = means_of(config, raw)["held_out"]
        why = (
            f"{100 * means[best]['held_out']:.1f} % of the next fixations hit the target with {scores} scores to the "
            f"power of {exponent:g}, {100 * before:.1f} % with raw scores; {in_words(gain, 'points gained', 100)}"
        )
        rows = [
            ["scores", "exponent", "next fixations that hit, %"],
            ["raw, every cell of a box", "1", percent_of(before)],
        ]
        rows += [[way[0], f"{way[1]:g}", percent_of(mean["held_out"])] for way, mean in means.items()]
        report = section(
            f"The exponent with which scores are fused ({scores}, {exponent:g}) was chosen on the training "
            f"photographs; the table shows results on {len(held_out)} held-out photographs.",
            rows,
        )
        settings = {"scores": scores, "exponent": exponent, "footprint": config.footprint}
        return PartResult(Part(None, None, gain.better, why, settings), report)
