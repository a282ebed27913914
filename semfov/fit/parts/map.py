"""The learned map of a detector, compared with raw scores and random gaze."""

from __future__ import annotations

from typing import ClassVar

from semfov.belief.observers import LearnedMap, Semantic
from semfov.errors import DataError, InputError
from semfov.fit.comparison import Difference, explore_curves
from semfov.fit.detector_report import curves_figure, in_words, mean_percent, section
from semfov.fit.map import FitMapConfig, fit_map_evidence
from semfov.fit.parts.base import MAP_SHIFTS, PartFit, PartResult, strategy
from semfov.gaze.policies import Closer, Random
from semfov.viz.style import save_figure


class MapFit(PartFit):
    """Train the map of all classes."""

    name: ClassVar[str] = "map"

    @property
    def settings(self) -> FitMapConfig:
        """The settings of the training."""
        return self.config.map

    @property
    def tasks(self) -> dict[str, float]:
        """The tasks and their seconds."""
        return {
            "describing looks": 0.05 * len(self.run.scenes),
            "training": 0.25 * self.settings.steps,
            "learning the gain of looks": 0.1 * self.settings.gain_steps,
            "exploring": len(self.inputs.judged),
        }

    def fit(self) -> PartResult:
        """Train, and compare explorations with those of raw scores and random gaze."""
        inputs, run = self.inputs, self.run
        if inputs.components < 3:
            raise InputError("detector: a map of all classes needs at least 2 classes, got a detector with 1 class")
        fit = fit_map_evidence(self.settings, run)
        fovea = self.config.sensor.fovea
        ways = {
            "fitted": strategy(LearnedMap(fit.model), Closer(fovea)),
            "raw": strategy(Semantic(inputs.components), Random()),
            "fused": strategy(inputs.semantic, Closer(fovea)),
        }
        protocol = inputs.protocol
        curves = explore_curves(run, inputs.judged, ways, protocol)
        at = min(MAP_SHIFTS, protocol.shifts)
        every, objects = curves["all"], curves["objects"]
        if not len(objects["raw"]):
            raise DataError("data: none of the held-out photographs contains an object; give more photographs")
        gain = Difference.of(objects["fitted"][:, at], objects["raw"][:, at])
        # A map that answers background everywhere is right for most cells, and one that never answers background may
        # be right for all objects. Therefore both measures are compared.
        loss = Difference.of(every["raw"][:, at], every["fitted"][:, at])
        why = (
            f"{100 * objects['fitted'][:, at].mean():.1f} % of the cells with objects are classified correctly after "
            f"{at} gaze shifts, {100 * objects['raw'][:, at].mean():.1f} % with raw scores and random gaze; "
            f"{in_words(gain, 'points gained', 100)}; of all cells {100 * every['fitted'][:, at].mean():.1f} and "
            f"{100 * every['raw'][:, at].mean():.1f} %"
        )
        sections = []
        for what, words in (("objects", "cells with objects, the published success rate"), ("all", "all cells")):
            rows = [["map", *(f"after {n}" for n in (1, at, protocol.shifts))]]
            rows += [
                [name, *(mean_percent(curve[:, n]) for n in (1, at, protocol.shifts))]
                for name, curve in curves[what].items()
            ]
            sections.append(section(f"Classified correctly after n gaze shifts, in % of {words}:", rows))
        head = (
            f"On {len(objects['raw'])} held-out photographs. `raw` fuses raw scores with random gaze; `fused` uses the "
            "exponent chosen under Tempering, with the gaze policy of the fitted map. The answer for a cell may be "
            "background.\n"
        )
        save_figure(curves_figure(objects, "exploration"), self.config.out / "explore.png")
        part = self.write(fit.model, gain.better and not loss.better, why)
        return PartResult(part, "\n".join([head, *sections, fit.report]), ["explore.png"])
