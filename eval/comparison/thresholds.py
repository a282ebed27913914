"""Looks at several score thresholds, which share one pass of the detector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.detection.detector import Detector
from semfov.detection.scores import Candidates
from semfov.eye import Eye, View
from semfov.io.ranges import Share
from semfov.runs.config import LookingConfig
from semfov.runs.looking import Looking
from semfov.runs.looks import tight
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import finish, store_folder
from semfov.runs.store import DetectionStore, cell_store
from semfov.threads import one_thread


class _Proposed(Detector):
    """A detector that selects at a threshold of its own among boxes that another detector has proposed."""

    def __init__(self, detector: Detector, threshold: float) -> None:
        super().__init__(
            detector.name,
            detector.classes,
            detector.input_size,
            background=detector.background,
            selection=replace(detector.selection, threshold=threshold),
        )
        self.candidates: Candidates | None = None

    def propose(self, canvas: Tensor) -> Candidates:
        """Return the boxes of the other detector."""
        assert self.candidates is not None
        return self.candidates


class _ThresholdEyes:
    """Eyes that differ in their score threshold alone, and share every pass of the detector.

    A pass costs far more than the selection of boxes. A look at all thresholds costs little more than one look.
    """

    def __init__(self, eye: Eye, thresholds: Sequence[float]) -> None:
        self._eye = eye
        self._proposed = [_Proposed(eye.detector, threshold) for threshold in thresholds]
        self._eyes = [Eye(eye.sensor, detector, reference=eye.reference) for detector in self._proposed]
        self.settings = [_at(eye.settings(), threshold) for threshold in thresholds]

    def open(self, image: Tensor) -> View:
        """Open an image `(1, 3, H, W)`."""
        return self._eye.open(image)

    def look(self, view: View, fixation: Tensor) -> list[Detections]:
        """Look from one fixation `(1, 2)`; returns detections at each threshold, batches of one without padding."""
        canvas = self._eye.foveated(view, fixation)
        candidates = self._eye.detector.propose(canvas)
        looks = []
        for detector, eye in zip(self._proposed, self._eyes, strict=True):
            detector.candidates = candidates
            looks.append(tight(eye.detect(view, fixation, canvas)))
        return looks


@dataclass(frozen=True)
class ThresholdLooksConfig(LookingConfig):
    """Look at scenes from every cell, and store the looks for each of several score thresholds.

    Args:
        detector: the detector; `thresholds` replace its threshold.
        belief: the belief; its columns and rows are the cells.
        out: folder in which finished scenes are noted.
        store: must be true.
        thresholds: the score thresholds.
    """

    thresholds: tuple[Share, ...] = (0.02, 0.1, 0.25, 0.5)


class _ThresholdLooking(Looking):
    """Looks at scenes from every cell, which are stored for each of several thresholds.

    A run with one of these thresholds finds its looks stored, as if it had taken them itself.
    """

    config: ThresholdLooksConfig

    def __init__(self, config: ThresholdLooksConfig) -> None:
        super().__init__(config)
        self.eyes = _ThresholdEyes(self.eye, config.thresholds)
        folder, belief = store_folder(config.cache) / "looks", config.belief
        size, components = (belief.columns, belief.rows), len(self.scenes.classes) + 1
        self.stores = [cell_store(folder, settings, *size, components) for settings in self.eyes.settings]

    def depends_on(self) -> dict[str, Any]:
        """List the eye, the cells and the thresholds."""
        return {**super().depends_on(), "thresholds": self.config.thresholds}

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Look at a scene from every cell, and store the looks that are missing; there are no records."""
        digest, grid = self.digest(index), self.grid(index)
        missing = [number for number, store in enumerate(self.stores) if not _holds(store, digest, len(grid))]
        if missing:
            with one_thread(), torch.inference_mode():
                image = self.scenes[index].image[None]
                view, centres = self.eyes.open(image), grid.centres.to(image)
                looks = [self.eyes.look(view, centre[None]) for centre in centres]
            for number in missing:
                self.stores[number].save(
                    digest, {cell: by_threshold[number] for cell, by_threshold in enumerate(looks)}
                )
        return [], {}


def _holds(store: DetectionStore, digest: str, cells: int) -> bool:
    """Whether a store holds the looks at a scene from all cells."""
    looks = store.load(digest)
    return all(cell in looks for cell in range(cells))


def _at(settings: dict[str, Any], threshold: float) -> dict[str, Any]:
    """Return settings of an eye, with another threshold."""
    detector = settings["detector"]
    selection = {**detector["selection"], "threshold": threshold}
    return {**settings, "detector": {**detector, "selection": selection}}


def look_at_thresholds(config: ThresholdLooksConfig) -> None:
    """Take the looks of all scenes that are not stored yet."""
    finish(_ThresholdLooking(config), "looking")
