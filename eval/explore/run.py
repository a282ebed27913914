"""Scene exploration: all policies in one scene, from the photograph to the records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from eval.comparison.looking import ComparedLooking
from eval.comparison.settings import ComparedConfig
from eval.explore.episodes import counts_of, run_explorations
from semfov.belief.grid import Grid
from semfov.belief.observers import Semantic
from semfov.detection.detections import Detections
from semfov.episode import StoredLooks
from semfov.episode.stopwatch import Stopwatch
from semfov.gaze.acquisition.base import Task
from semfov.metrics.episodes import answers_of
from semfov.runs.config import PolicyConfig, ProtocolConfig
from semfov.runs.protocols import Exploration, explorations_of
from semfov.runs.results import ResultRecord
from semfov.runs.seeds import noise_for

FUSED, PAINTED = "one unfoveated pass, fused", "one unfoveated pass, boxes"

# Among 0.2, 0.3 and 0.4, the score that named most cells right on the fit set, with background as an answer.
_SURE = 0.2


def _sharp_maps(sharp: Detections, grid: Grid) -> Mapping[str, Tensor]:
    """Compute maps of what is where from one unfoveated pass at the whole picture.

    - fused: scores are used as likelihoods and fused by Kaplan's rule from a uniform prior, as published.
    - boxes: every cell gets the scores of the boxes that overlap it, class by class the highest; its answer is
      background where no score is higher than 0.2.

    Shapes: → `(1, X·Y, K+1)`.
    """
    observer = Semantic(sharp.scores.shape[-1])
    middle = grid.centres.to(sharp.scores).mean(0, keepdim=True)
    fused = observer(observer.start(1, grid, sharp.scores), sharp, middle, grid)
    cells = grid.footprint(sharp.boxes) & sharp.mask[..., None]
    scores = sharp.scores[..., 1:] * sharp.mask[..., None]
    scores_in_cells = cells[..., None] * scores[:, :, None]  # (1, L, X·Y, K)
    # Without a detection there is no maximum, and the sum is 0.
    highest = scores_in_cells.amax(1) if scores_in_cells.shape[1] else scores_in_cells.sum(1)
    background = torch.full_like(highest[..., :1], _SURE)
    return {FUSED: fused.class_probabilities(), PAINTED: torch.cat([background, highest], -1)}


@dataclass(frozen=True)
class ExploreConfig(ComparedConfig):
    """Scene exploration: learn what is where by moving a fovea, and count the cells whose class is right.

    Args:
        policies: policies to compare, each a preset by name or a mapping of settings such as `{policy: kl, scores:
            calibrated, memory: closest}` (`PolicyConfig`). Presets: `recommended` (closer-look-learned), `published`
            (kl-calibrated); and `random`, `kl`, `negative-entropy`, `two-peaks`, `surprise`,
            `upper-confidence-bound`, `probability-of-improvement`, `expected-accuracy`, `closer-look`,
            `vocus2`, `itti-koch` or `people`, each followed by `-raw` or `-calibrated`. With the semantic map:
            `random-learned`, `closer-look-learned`, `expected-gain-learned`, `vocus2-learned`, `itti-koch-learned` and
            `people-learned`.
        out: folder for tables, figures, per-episode records and the manifest.
    """

    task: ClassVar[Task] = "exploration"
    protocol: ProtocolConfig = field(default_factory=lambda: ProtocolConfig(shifts=20))
    policies: tuple[str | PolicyConfig, ...] = (
        "random-raw",
        "kl-raw",
        "negative-entropy-raw",
        "two-peaks-raw",
        "vocus2-raw",
        "random-calibrated",
        "kl-calibrated",
        "negative-entropy-calibrated",
        "two-peaks-calibrated",
        "vocus2-calibrated",
        "recommended",
    )
    out: Path = Path("runs/explore")


class ExploreRun(ComparedLooking):
    """Scene exploration."""

    task: Task = "exploration"
    config: ExploreConfig

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Run all explorations of a scene with all policies; returns records, and the seconds that each stage took."""
        protocol = self.config.protocol
        watch = Stopwatch()
        records: list[ResultRecord] = []
        grid = self.grid(index)
        answers = answers_of(self.scenes.annotation(index), grid, len(self.scenes.classes) + 1)
        if not answers.any():
            return records, watch.seconds
        looks = StoredLooks(self.detections(index), grid)
        watch.lap("look")
        episodes = explorations_of(self.scenes, index, len(grid), protocol)
        scene = self.scenes.ids[index]
        noise = torch.stack([noise_for(protocol, len(grid), scene, None, episode.repetition) for episode in episodes])
        for name in self.policies:
            candidate = self.candidate(name, index)
            watch.lap("saliency")
            with torch.inference_mode():
                outcomes = run_explorations(
                    episodes, candidate, looks, answers, noise, shifts=protocol.shifts, batch=protocol.batch
                )
            watch.lap(name)
            records += [self._record(name, answers, *pair) for pair in zip(episodes, outcomes, strict=True)]
        with torch.inference_mode():
            sharp = self.eye.detector(self.scenes[index].image[None])
            for name, probabilities in _sharp_maps(sharp, grid).items():
                counts = counts_of(probabilities, answers)
                # The map of one pass is the same after any number of gaze shifts, and fixates no cell.
                at_all_shifts = {count: number.tolist() * (protocol.shifts + 1) for count, number in counts.items()}
                records += [self._record(name, answers, episode, ([], at_all_shifts)) for episode in episodes]
        watch.lap("sharp look")
        return records, watch.seconds

    def _record(
        self, policy: str, answers: Tensor, episode: Exploration, progress: tuple[list[int], dict[str, list[int]]]
    ) -> ResultRecord:
        cells, counts = progress
        return {
            "policy": policy,
            "scene": self.scenes.ids[episode.scene],
            "repetition": episode.repetition,
            "start": episode.start,
            "cells": cells,
            "object_cells": int(answers.any(-1).sum()),
            "grid_cells": len(answers),
            **counts,
        }
