"""The part of a model folder for large pictures: evidence by magnification, fitted on mosaics of the photographs."""

from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Any

import numpy as np
import torch

from semfov.data.mosaics import Mosaics
from semfov.fit.detector_report import Difference, curves_table, mean_percent, section
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.windows import MosaicFit
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.metrics.episodes import FloatArray
from semfov.runs.config import SensorConfig
from semfov.runs.window_looking import found_in
from semfov.runs.zoom_store import StoredWindowLooks
from semfov.threads import one_thread
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

    settings: FitMosaicsConfig | dict[str, str]

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        why = self._why_left_out()
        if why is not None:
            self.settings = {"left out": why}
            self.tasks = {}
            return
        self.settings = self.mosaics(len(self.run.scenes))
        self.tasks = _tasks(self.settings)

    def _why_left_out(self) -> str | None:
        """Return the reason why the part is not fitted; None if it is."""
        photographs = len(self.run.scenes)
        held_out = len(self.inputs.held_out)
        if not self.config.windows:
            return "not fitted, since the setting `windows` is false"
        if held_out < _ENOUGH:
            return (
                f"not fitted, since mosaics need at least {_ENOUGH} held-out photographs, and {held_out} of the "
                f"{photographs} photographs are held out"
            )
        return None

    def mosaics(self, photographs: int) -> FitMosaicsConfig:
        """Return the settings for so many photographs; each to learn from is in about four mosaics, unless many are."""
        held_out = -(-photographs // (self.config.holdout or 5))
        training = min(photographs - held_out, _FOR_MOSAICS)
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
            tile=max(16, round(self._tile_width())),
            steps=self.config.window_steps,
            survey_steps=self.config.window_steps,
        )

    def _tile_width(self) -> float:
        """Compute the width of the slot of a photograph in a mosaic, in which photographs are not enlarged."""
        sizes = [self.run.scenes.annotation(index).size for index in range(len(self.run.scenes))]
        usual = median(max(width, height * 4 / 3) for width, height in sizes)
        return min(usual, _OF_INPUT * self.run.eye.detector.input_size[0])

    def fit(self) -> PartResult:
        """Fit, and compare the objects found with those of slices in the order of the overview's scores."""
        if isinstance(self.settings, dict):
            return self.left_out(self.settings["left out"])
        with one_thread():
            fit = MosaicFit(self.settings, WindowEye(self.run.eye.detector).eval().requires_grad_(False))
            model, lines = fit.fit()
            mosaics = fit.mosaics["judged"]
            opened = fit.opened("judged")
            curves = {
                "fitted": _photograph_recalls(mosaics, opened, model),
                "raw": _photograph_recalls(mosaics, opened, None),
            }
        gain, why = _compare(curves)
        part = self.write("windows", model, gain.better, why)
        return PartResult(part, "\n".join([_report_on_curves(curves, mosaics), *lines]))


def _tasks(config: FitMosaicsConfig) -> dict[str, float]:
    """List the tasks of the fit by the titles of their progress bars, with an estimate of their seconds."""
    searched = {"searched": config.searched, "judged": config.judged}
    explored = searched | config.some_explored
    looked = config.mosaics + config.crowded + config.judged + 4 * config.far
    return {
        "looking": 60 * _LOOK * looked,
        "learning the expected number of objects": 0.2 * config.steps,
        "learning the survey": 0.4 * config.survey_steps,
        **{f"searching, {kind}": 4 * count for kind, count in searched.items()},
        "looking closely": 4 * config.judged,
        "looking at photographs": 5 * _LOOK * config.photographs,
        "searching photographs": 20 * _LOOK * config.photographs,
        **{f"exploring, {kind}": 2 * count for kind, count in explored.items()},
    }


def _compare(curves: Mapping[str, FloatArray]) -> tuple[Difference, str]:
    """Compare the mean recall over passes with that of slices; the difference, and the sentence about it."""
    gain = Difference.of(curves["fitted"].mean(1), curves["raw"].mean(1))
    passes = _RECALL_PASSES[-1]
    return gain, (
        f"{100 * curves['fitted'][:, passes - 1].mean():.1f} % of the objects are found in {passes} passes, "
        f"{100 * curves['raw'][:, passes - 1].mean():.1f} % in slices in the order of raw scores; on average over the "
        f"passes {gain.in_words('points gained', 100)}"
    )


def _report_on_curves(curves: Mapping[str, FloatArray], mosaics: Mosaics) -> str:
    """Write the section about the objects found."""
    head = ["looks", *(f"after {passes} passes" for passes in _RECALL_PASSES)]
    rows = curves_table(head, curves, [passes - 1 for passes in _RECALL_PASSES])
    means = ["mean", *(mean_percent(curve.mean(1)) for curve in curves.values())]
    return section(
        f"Objects found in {len(mosaics)} mosaics of {len(mosaics.tiles(0))} held-out photographs, in % of the "
        f"objects of each photograph, and the mean over 1 to {_RECALL_PASSES[-1]} passes. `raw` looks at slices in "
        "the order of the sums of the overview's raw scores, as the agent does without this part.",
        [[*row, mean] for row, mean in zip(rows, means, strict=True)],
    )


@torch.inference_mode()
def _photograph_recalls(
    mosaics: Mosaics, opened: Sequence[StoredWindowLooks], model: GlimpseEvidence | None
) -> FloatArray:
    """Compute the recall in each photograph of mosaics after each pass, `(P, 16)`; without a model by slices."""
    passes = _RECALL_PASSES[-1]
    hits = np.zeros((len(mosaics.scenes), passes))
    objects = np.zeros(len(mosaics.scenes))
    for index, source in enumerate(opened):
        annotation = mosaics.annotation(index)
        # The photograph of each object of the mosaic.
        photographs = [tile.scene for tile in mosaics.tiles(index)]
        counts = [len(mosaics.scenes.annotation(photograph).boxes) for photograph in photographs]
        photograph_of_object = np.repeat(photographs, counts)
        # `+=` would count one object for each photograph, however many it has.
        np.add.at(objects, photograph_of_object, 1)
        history: list[WindowLook] = []
        steps = _steps(source, model)
        for number in range(passes):
            # When no window is left, recall stays the same.
            step = next(steps, None)
            if step is not None:
                history.append(step.look)
            np.add.at(hits[:, number], photograph_of_object, found_in(history, annotation).numpy())
        source.save()
    is_shown = objects > 0
    return hits[is_shown] / objects[is_shown, None]


def _steps(source: StoredWindowLooks, model: GlimpseEvidence | None) -> Iterator[WindowStep[Any]]:
    """Look for all objects of a mosaic by a model, or without one at slices in the order of raw scores."""
    if model is None:
        return look_by_look(source, ranked(usual_slices(source.lattice)), None)
    return find_everything(source, model)
