"""Visual search: all policies in one scene, from the photograph to the records."""

from __future__ import annotations

import torch

from eval.search.config import SearchConfig
from semfov.episode import Stopwatch
from semfov.gaze.policies import Task
from semfov.runs.policy_looking import PolicyLooking
from semfov.runs.results import ResultRecord
from semfov.runs.search_protocol import Episode, EpisodeOutcome, episodes_of, looks_of, run_episodes, tie_noise


class SearchRun(PolicyLooking):
    """Visual search."""

    task: Task = "search"
    config: SearchConfig

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Run all searches of a scene with all policies; returns records, and the seconds that each stage took."""
        config, protocol = self.config, self.config.protocol
        episodes = episodes_of(self.scenes, index, config.belief.columns, config.belief.rows, protocol)
        watch = Stopwatch()
        records: list[ResultRecord] = []
        detections, grid = self.detections(index), self.grid(index)
        watch.lap("look")
        if not episodes:
            return records, watch.seconds
        looks = looks_of(episodes, detections, grid)
        noise = torch.stack([tie_noise(self.scenes, episode, len(grid), protocol) for episode in episodes])
        for name in self.policies:
            candidate = self.candidate(name, index)
            watch.lap("saliency")
            with torch.inference_mode():
                outcomes = run_episodes(episodes, candidate, looks, noise, shifts=protocol.shifts, batch=protocol.batch)
            watch.lap(name)
            records += [self._record(name, *pair) for pair in zip(episodes, outcomes, strict=True)]
        return records, watch.seconds

    def _record(self, policy: str, episode: Episode, outcome: EpisodeOutcome) -> ResultRecord:
        return {
            "policy": policy,
            **vars(episode),
            "scene": self.scenes.ids[episode.scene],
            "target_name": self.scenes.classes[episode.target - 1],
            "cells": list(outcome.cells),
            "found_at": outcome.found_at,
        }
