"""The part of a model folder that guides explorations: a map of all classes, compared with raw scores."""

from collections.abc import Mapping

import numpy as np
import torch

from semfov.belief.map_evidence import MapEvidence
from semfov.belief.observers import LearnedMap, Semantic
from semfov.episode import StoredLooks
from semfov.errors import DataError, InputError
from semfov.fit.detector_report import Difference, curves_figure, curves_table, section
from semfov.fit.map import FitMapConfig, fit_map_evidence
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.protocols import explorations_of, run_explorations
from semfov.gaze.policies import Policy
from semfov.metrics.episodes import FloatArray, answers_of
from semfov.runs.progress import track
from semfov.runs.seeds import noise_for
from semfov.strategy import Strategy
from semfov.viz.style import save_figure

_Curves = dict[str, FloatArray]
"""Shares of right cells after each gaze shift by strategy, `(P, shifts+1)`."""

_MEASURED = {"objects": "right", "all": "right_everywhere"}
"""Cells on which strategies are compared, with the name of the numbers of right ones."""


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

    def fit(self) -> PartResult:
        """Train, and compare explorations with those of raw scores and random gaze."""
        if self.inputs.components < 3:
            raise InputError("detector: a map of all classes needs at least 2 classes, got a detector with 1 class")
        fitted = fit_map_evidence(self.settings, self.run)
        curves = self._curves(self._strategies(fitted.model))
        if not len(curves["objects"]["raw"]):
            raise DataError("data: none of the held-out photographs contains an object; give more photographs")
        used, why = self._compare(curves["objects"], curves["all"])
        save_figure(curves_figure(curves["objects"], "exploration"), self.config.out / "explore.png")
        report = "\n".join([self._report(curves), fitted.report])
        return PartResult(self.write("map", fitted.model, used, why), report, ["explore.png"])

    def _strategies(self, model: MapEvidence) -> dict[str, Strategy]:
        """Make the strategies that are compared: with the fitted map, with raw scores, and with tempered ones."""
        fovea = self.config.sensor.fovea
        strategies = {
            "fitted": Strategy(LearnedMap(model), Policy("closer-look", fovea=fovea)),
            "raw": Strategy(Semantic(self.inputs.components), Policy("random")),
            "fused": Strategy(self.inputs.semantic, Policy("closer-look", fovea=fovea)),
        }
        for strategy in strategies.values():
            strategy.eval().requires_grad_(False)
        return strategies

    def _curves(self, strategies: Mapping[str, Strategy]) -> dict[str, _Curves]:
        """Explore held-out photographs; returns the shares of right cells, of those with `objects` and of `all`."""
        run = self.run
        protocol = self.inputs.protocol
        rows: dict[str, dict[str, list[FloatArray]]] = {kind: {name: [] for name in strategies} for kind in _MEASURED}
        for index in track(self.inputs.judged, "exploring", "scene"):
            grid = run.grid(index)
            answers = answers_of(run.scenes.annotation(index), grid, self.inputs.components)
            if not answers.any():  # no share of cells with objects
                continue
            looks = StoredLooks(run.detections(index), grid)
            episodes = explorations_of(run.scenes, index, len(grid), protocol)
            # All strategies break ties in the same way, so that their difference is paired.
            noise = torch.stack(
                [
                    noise_for(protocol, len(grid), run.scenes.ids[index], None, episode.repetition)
                    for episode in episodes
                ]
            )
            cells = {"objects": int(answers.any(-1).sum()), "all": len(grid)}
            for name, strategy in strategies.items():
                with torch.inference_mode():
                    progress = run_explorations(
                        episodes, strategy, looks, answers, noise, shifts=protocol.shifts, batch=protocol.batch
                    )
                for kind, counted in _MEASURED.items():
                    shares = [np.asarray(counts[counted]) / cells[kind] for _, counts in progress]
                    rows[kind][name].append(np.mean(shares, axis=0))
        return {
            kind: {name: np.array(curve).reshape(-1, protocol.shifts + 1) for name, curve in of_kind.items()}
            for kind, of_kind in rows.items()
        }

    def _compare(self, objects: _Curves, cells: _Curves) -> tuple[bool, str]:
        """Compare the fitted map with raw scores; whether it should be used, and the sentence about it.

        A map that answers background everywhere is right for most cells, and one that never answers background may be
        right for all objects. Therefore both measures are compared.
        """
        at = self.inputs.compared_at
        gain = Difference.of(objects["fitted"][:, at], objects["raw"][:, at])
        loss = Difference.of(cells["raw"][:, at], cells["fitted"][:, at])
        return gain.better and not loss.better, (
            f"{100 * objects['fitted'][:, at].mean():.1f} % of the cells with objects are classified correctly after "
            f"{at} gaze shifts, {100 * objects['raw'][:, at].mean():.1f} % with raw scores and random gaze; "
            f"{gain.in_words('points gained', 100)}; of all cells {100 * cells['fitted'][:, at].mean():.1f} and "
            f"{100 * cells['raw'][:, at].mean():.1f} %"
        )

    def _report(self, curves: Mapping[str, _Curves]) -> str:
        """Write the section about the explorations."""
        shifts = (1, self.inputs.compared_at, self.inputs.protocol.shifts)
        head = ["map", *(f"after {n}" for n in shifts)]
        kinds = {"objects": "cells with objects, the published success rate", "all": "all cells"}
        sections = [
            section(
                f"Classified correctly after n gaze shifts, in % of {words}:", curves_table(head, curves[kind], shifts)
            )
            for kind, words in kinds.items()
        ]
        return "\n".join(
            [
                f"On {len(curves['objects']['raw'])} held-out photographs. `raw` fuses raw scores with random gaze; "
                "`fused` uses the exponent chosen under Tempering, with the gaze policy of the fitted map. The answer "
                "for a cell may be background.\n",
                *sections,
            ]
        )
