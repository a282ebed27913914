"""Visual search: all policies in one scene, from the photograph to the records."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from eval.comparison.looking import ComparedLooking
from eval.comparison.settings import ComparedConfig
from semfov.episode import StoredLooks
from semfov.episode.stopwatch import Stopwatch
from semfov.gaze.acquisition.base import Task
from semfov.io.ranges import Whole
from semfov.runs.config import PolicyConfig
from semfov.runs.presets import AGENT
from semfov.runs.protocols import Trial, episodes_of, run_episodes
from semfov.runs.results import ResultRecord
from semfov.runs.seeds import noise_for


@dataclass(frozen=True)
class SearchConfig(ComparedConfig):
    """Visual search: find a target class by moving a fovea, and count the gaze shifts that this takes.

    Args:
        policies: policies to compare, each a preset by name or a mapping of settings such as `{policy: non-predictive,
            scores: calibrated, tempering: 0.25}` (`PolicyConfig`). Presets: `recommended` (non-predictive-learned),
            `published` (predictive-calibrated), `random`, `vocus2`, `itti-koch`, `people`; and `non-predictive` (also
            called `maximum-a-posteriori`), `foveal-hit`, `place-information`, `entropy-limit`, `ideal-observer`,
            `predictive` or `neighbourhood`, each followed by `-raw` or `-calibrated`, or but for the last two by
            `-learned`, the belief of the agent.
        out: folder for tables, figures, per-episode records and the manifest.
        scanpaths: number of episodes to draw as figures.
    """

    policies: tuple[str | PolicyConfig, ...] = (
        "random",
        "non-predictive-raw",
        "predictive-raw",
        "non-predictive-calibrated",
        "predictive-calibrated",
        AGENT,
    )
    out: Path = Path("runs/search")
    scanpaths: Whole = 3


class SearchRun(ComparedLooking):
    """Visual search."""

    task: Task = "search"
    config: SearchConfig

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Run all searches of a scene with all policies; returns records, and the seconds that each stage took."""
        config, protocol = self.config, self.config.protocol
        episodes = episodes_of(self.scenes, index, config.belief.columns, config.belief.rows, protocol)
        watch = Stopwatch()
        records: list[ResultRecord] = []
        detections = self.detections(index)
        grid = self.grid(index)
        watch.lap("look")
        if not episodes:
            return records, watch.seconds
        scene = self.scenes.ids[index]
        looks = StoredLooks(detections, grid, torch.tensor([episode.cue for episode in episodes]))
        noise = torch.stack(
            [noise_for(protocol, len(grid), scene, episode.target, episode.repetition) for episode in episodes]
        )
        for name in self.policies:
            candidate = self.candidate(name, index)
            watch.lap("saliency")
            with torch.inference_mode():
                outcomes = run_episodes(episodes, candidate, looks, noise, shifts=protocol.shifts, batch=protocol.batch)
            watch.lap(name)
            records += [self._record(name, *pair) for pair in zip(episodes, outcomes, strict=True)]
        return records, watch.seconds

    def _record(self, policy: str, episode: Trial, outcome: tuple[list[int], int]) -> ResultRecord:
        return {
            "policy": policy,
            **episode._asdict(),
            "scene": self.scenes.ids[episode.scene],
            "target_name": self.scenes.classes[episode.target - 1],
            "cells": outcome[0],
            "found_at": outcome[1],
        }
