"""Scene exploration: all policies in one scene, from the photograph to the records."""

from __future__ import annotations

import torch
from torch import Tensor

from eval.explore.config import ExploreConfig
from eval.explore.references import sharp_maps
from semfov.episode import Stopwatch, StoredLooks
from semfov.gaze.policies import Task
from semfov.metrics.exploration import answers_of
from semfov.runs.exploration_protocol import (
    Exploration,
    Progress,
    counts_of,
    explorations_of,
    explore_noise,
    run_explorations,
)
from semfov.runs.policy_looking import PolicyLooking
from semfov.runs.results import ResultRecord


class ExploreRun(PolicyLooking):
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
        noise = torch.stack([explore_noise(self.scenes, episode, len(grid), protocol) for episode in episodes])
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
            for name, probabilities in sharp_maps(sharp, grid).items():
                counts = [tuple(each.tolist()) * (protocol.shifts + 1) for each in counts_of(probabilities, answers)]
                records += [self._record(name, answers, episode, Progress((), *counts)) for episode in episodes]
        watch.lap("sharp look")
        return records, watch.seconds

    def _record(self, policy: str, answers: Tensor, episode: Exploration, progress: Progress) -> ResultRecord:
        return {
            "policy": policy,
            "scene": self.scenes.ids[episode.scene],
            "repetition": episode.repetition,
            "start": episode.start,
            "cells": list(progress.cells),
            "object_cells": int(answers.any(-1).sum()),
            "grid_cells": len(answers),
            "right": list(progress.right),
            "right_without_background": list(progress.right_without_background),
            "right_everywhere": list(progress.right_everywhere),
        }
