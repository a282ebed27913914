"""The observation model of a detector, compared with raw scores."""

from __future__ import annotations

from typing import ClassVar

import torch

from semfov.errors import DataError
from semfov.fit.comparison import Difference
from semfov.fit.detector_report import in_words, section
from semfov.fit.misses import count_misses
from semfov.fit.observation import FitObservationConfig, fit_model, statistics_of
from semfov.fit.parts.base import PartFit, PartResult
from semfov.metrics.calibration import calibration, surprisal
from semfov.observation.foveal import FovealObservationModel
from semfov.runs.samples import whole_photograph
from semfov.viz.style import save_figure


class ObservationFit(PartFit):
    """Fit the observation model with its miss rates."""

    name: ClassVar[str] = "observation"

    @property
    def settings(self) -> FitObservationConfig:
        """The settings of the observation model."""
        return self.config.observation

    @property
    def tasks(self) -> dict[str, float]:
        """The tasks and their seconds."""
        return {"fitting": 1 + 0.1 * len(self.run.scenes)}

    def fit(self) -> PartResult:
        """Fit the model, and compare its posteriors of the true class with those of raw scores."""
        config, run, samples = self.settings, self.run, self.inputs.samples
        held_out = samples.scene % config.holdout == 0
        judged = samples[held_out]
        if not len(judged) or len(judged) == len(samples):
            raise DataError(
                f"data: expected detections both in the training and in the held-out photographs, got {len(samples)} "
                "detections in all; give more photographs"
            )
        model = fit_model(config, run, statistics_of(config, run, [samples[~held_out]]), samples[~held_out])
        fitted_on = {index for index in range(len(run.scenes)) if index % config.holdout}
        cells = whole_photograph(self.config.columns, self.config.rows)
        misses = count_misses(run.scenes, samples, fitted_on, model.edges, cells)
        model.miss_rate = misses.rates().to(model.edges)
        raw = FovealObservationModel.identity(run.scenes.classes, config.edges).eval()
        with torch.inference_mode():
            posteriors = {
                name: m.calibrate(judged.scores, judged.distance) for name, m in (("raw", raw), ("fitted", model))
            }
        cost = {name: surprisal(p.double().gather(1, judged.labels[:, None])[:, 0]) for name, p in posteriors.items()}
        photographs = judged.scene.unique().tolist()
        means = {
            name: torch.stack([each[judged.scene == scene].mean() for scene in photographs]).numpy()
            for name, each in cost.items()
        }
        gain = Difference.of(means["raw"], means["fitted"])
        figures = {name: calibration(p, judged.labels) for name, p in posteriors.items()}
        rows = [["scores", "NLL", "Brier", "ECE", "accuracy"]]
        rows += [
            [name, f"{f.nll:.3f}", f"{f.brier:.3f}", f"{f.ece:.3f}", f"{f.accuracy:.3f}"] for name, f in figures.items()
        ]
        why = (
            f"negative log likelihood of the true class {figures['fitted'].nll:.3f}, with raw scores "
            f"{figures['raw'].nll:.3f}; {in_words(gain, 'nats gained')}"
        )
        from semfov.viz import plot_reliability

        figure = plot_reliability({name: (p, judged.labels) for name, p in posteriors.items()})
        save_figure(figure, self.config.out / "reliability.png")
        report = section(
            f"Predicted probability of the true class of a detection: fitted on {len(samples) - len(judged)} "
            f"detections, evaluated on {len(judged)} detections in {len(photographs)} held-out photographs.",
            rows,
        )
        return PartResult(self.write(model, gain.better, why), report, ["reliability.png"])
