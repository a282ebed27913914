"""The part of a model folder for large pictures: evidence by magnification, fitted on mosaics of the photographs."""

from collections.abc import Iterator, Sequence
from statistics import median
from typing import Any

import numpy as np
import torch

from semfov.data.mosaics import Mosaics
from semfov.fit.detector_report import Difference, mean_percent, section
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.photographs import fit_photographs
from semfov.fit.verification import mean_of
from semfov.fit.windows import MosaicFit
from semfov.fit.windows_evidence import judge_windows
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.io.manifest import Part
from semfov.metrics.episodes import FloatArray
from semfov.runs.config import SensorConfig
from semfov.runs.looks import one_thread
from semfov.runs.setup import make_scenes
from semfov.runs.window_looking import found_in
from semfov.runs.zoom_store import StoredWindowLooks
from semfov.zoom import GlimpseEvidence, WindowEye
from semfov.zoom.episode import WindowStep, find_everything, look_by_look
from semfov.zoom.looks import WindowLook
from semfov.zoom.slices import ranked, usual_slices

_ENOUGH = 16  # smallest number of held-out photographs, with which a mosaic shows none of them twice
_RECALL_PASSES = (4, 8, 16)  # passes of the detector after which recall is reported
_OF_INPUT = 1.15
"""Largest width of a photograph in a mosaic, in widths of the detector's input: as in the fits of shipped models."""
_FOR_MOSAICS = 360  # the number of mosaics grows up to this number of photographs to learn from
_ALONE = 120  # largest number of photographs that are searched by themselves
_LOOK = 0.04  # estimate of the seconds of a pass of the detector


class WindowsFit(PartFit):
    """Fit evidence by magnification on mosaics of the photographs, with its decisions."""

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        photographs, held_out = len(self.run.scenes), len(inputs.held_out)
        why = None
        if not self.config.windows:
            why = "not fitted, since the setting `windows` is false"
        elif held_out < _ENOUGH:
            why = (
                f"not fitted, since mosaics need at least {_ENOUGH} held-out photographs, and {held_out} of the "
                f"{photographs} photographs are held out"
            )
        self.settings: FitMosaicsConfig | dict[str, str]
        if why is not None:
            self.settings, self.tasks = {"left out": why}, {}
            return
        self.settings = config = self.mosaics(photographs)
        sets = {"searched": config.searched, "judged": config.judged}
        self.tasks = {
            "looking": 60 * _LOOK * (config.mosaics + config.crowded + config.judged + 4 * config.far),
            "learning what closer looks show": 0.1 * config.steps,
            "learning the expected number of objects": 0.2 * config.steps,
            "learning the survey": 0.4 * config.survey_steps,
            **{f"searching, {kind}": 4 * count for kind, count in sets.items()},
            "fitting decisions": 0.01 * config.judging,
            "looking closely": 4 * config.searched,
            "looking closely at held-out pictures": 4 * config.judged,
            "looking at photographs": 25 * _LOOK * config.photographs,
            **{f"exploring, {kind}": 2 * count for kind, count in (sets | config.some_explored).items()},
        }

    def mosaics(self, photographs: int) -> FitMosaicsConfig:
        """Return the settings for so many photographs; each to learn from is in about four mosaics, unless many are."""
        own, held_out = self.config, -(-photographs // (self.config.holdout or 5))
        training = min(photographs - held_out, _FOR_MOSAICS)
        # The photographs are not enlarged.
        sizes = [self.run.scenes.annotation(index).size for index in range(len(self.run.scenes))]
        width = min(
            median(max(width, height * 4 / 3) for width, height in sizes),
            _OF_INPUT * self.run.eye.detector.input_size[0],
        )
        return self.inputs.settings(
            FitMosaicsConfig,
            sensor=SensorConfig(),
            mosaics=max(1, training // 5),
            far=max(1, training // 60),
            crowded=max(1, training // 10),
            judged=max(8, min(held_out // 3, 30)),
            searched=max(8, training // 12),
            sought=3,
            passes=16,
            photographs=min(photographs, _ALONE),
            tile=max(16, round(width)),
            steps=own.window_steps,
            survey_steps=own.window_steps,
        )

    def fit(self) -> PartResult:
        """Fit, and compare the objects found with those of slices in the order of the overview's scores."""
        config = self.settings
        if isinstance(config, dict):
            why = config["left out"]
            return PartResult(Part(None, None, False, why), f"{why.capitalize()}.")
        with one_thread():
            fit = MosaicFit(config, WindowEye(self.run.eye.detector).eval().requires_grad_(False))
            model, figures = _fit_mosaics(fit)
            judged, opened = fit.mosaics["judged"], fit.opened("judged")
            ways = {"fitted": model, "raw": None}
            curves = {name: _photograph_recalls(judged, opened, way) for name, way in ways.items()}
        gain = Difference.of(curves["fitted"].mean(1), curves["raw"].mean(1))
        at = _RECALL_PASSES[-1] - 1
        why = (
            f"{100 * curves['fitted'][:, at].mean():.1f} % of the objects are found in {_RECALL_PASSES[-1]} passes, "
            f"{100 * curves['raw'][:, at].mean():.1f} % in slices in the order of raw scores; on average over the "
            f"passes {gain.in_words('points gained', 100)}"
        )
        rows = [["looks", *(f"after {n} passes" for n in _RECALL_PASSES), "mean"]]
        rows += [
            [name, *(mean_percent(curve[:, n - 1]) for n in _RECALL_PASSES), mean_percent(curve.mean(1))]
            for name, curve in curves.items()
        ]
        text = section(
            f"Objects found in {len(judged)} mosaics of {len(judged.tiles(0))} held-out photographs, in % of the "
            f"objects of each photograph, and the mean over 1 to {_RECALL_PASSES[-1]} passes. `raw` looks at slices in "
            "the order of the sums of the overview's raw scores, as the agent does without this part.",
            rows,
        )
        return PartResult(self.write("windows", model, gain.better, why), "\n".join([text, figures]))


def _fit_mosaics(fit: MosaicFit) -> tuple[GlimpseEvidence, str]:
    """Look at the mosaics, and fit the evidence, its decisions, closer looks and expected numbers."""
    examples = fit.look(("near", "far", "crowded", "judged"))
    model = fit.closer(examples)
    fit.survey(model, examples)
    lines = [judge_windows(model, examples["judged"])[0], *fit.decisions(model)]
    shipped = [
        GlimpseEvidence.from_pretrained(file.stem) for file in sorted(GlimpseEvidence.shipped.glob("*.safetensors"))
    ]
    lines += fit.verification(model, mean_of([each.verification for each in shipped if each.verification is not None]))
    lines += fit.certainty(model)
    alone = [each.photograph.verification for each in shipped if each.photograph is not None]
    scenes = make_scenes(fit.config.data, fit.eye.detector.classes)
    lines += ["Photographs:", "", fit_photographs(model, scenes, fit.eye, fit.config, mean_of(alone))]
    return model, "\n".join(lines)


@torch.inference_mode()
def _photograph_recalls(
    mosaics: Mosaics, opened: Sequence[StoredWindowLooks], model: GlimpseEvidence | None
) -> FloatArray:
    """Recall in each photograph of mosaics after each pass, `(P, 16)`; without a model by slices, as by an agent."""
    hits, there = np.zeros((len(mosaics.scenes), _RECALL_PASSES[-1])), np.zeros(len(mosaics.scenes))
    for index, source in enumerate(opened):
        tiles, annotation = mosaics.tiles(index), mosaics.annotation(index)
        photograph = np.repeat(
            [tile.scene for tile in tiles], [len(mosaics.scenes.annotation(tile.scene).boxes) for tile in tiles]
        )
        np.add.at(there, photograph, 1)
        history: list[WindowLook] = []
        steps: Iterator[WindowStep[Any]] = look_by_look(source, ranked(usual_slices(source.lattice)), None)
        if model is not None:
            steps = find_everything(source, model)
        for number in range(_RECALL_PASSES[-1]):
            step = next(steps, None)
            if step is not None:
                history.append(step.look)
            np.add.at(hits[:, number], photograph, found_in(history, annotation).numpy())
        source.save()
    return hits[there > 0] / there[there > 0, None]
