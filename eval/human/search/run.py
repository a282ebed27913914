"""Policies on the screens that people searched, with the same first fixation, the same cells and the same stop."""

from __future__ import annotations

import torch

from eval.human.search.config import PeopleSearchConfig
from eval.human.search.screens import Screens
from eval.human.search.trials import goal_rectangle, read_searches
from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.data.scene import Scenes
from semfov.detection.load import check_detector
from semfov.episode import Stopwatch
from semfov.gaze.policies import Task
from semfov.runs.policy_looking import PolicyLooking
from semfov.runs.results import ResultRecord
from semfov.runs.search_protocol import Episode, looks_of, run_episodes, tie_noise


class PeopleSearchRun(PolicyLooking):
    """Searches for the targets of people, one screen after the other."""

    task: Task = "search"
    config: PeopleSearchConfig

    def check_sources(self) -> None:
        """Check that the detector exists; pictures are looked for after people's files have been read."""
        check_detector(self.config.detector.name)

    def open_scenes(self) -> Scenes:
        """The screens whose pictures are found."""
        config = self.config
        searches = read_searches(config.people, (config.screen.width, config.screen.height))
        by_screen = {each.picture: each for each in searches}
        self.screens = Screens(config.pictures, by_screen, self.eye.detector.classes)
        return self.screens

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Run a search on a screen with each policy; returns records, and the seconds that each stage took."""
        watch, protocol, grid = Stopwatch(), self.config.protocol, self.grid(index)
        detections = self.detections(index)
        watch.lap("look")
        name = self.screens.ids[index]
        search = self.screens.searches[name]
        left, right, top, bottom = goal_rectangle(search, grid)
        goal = tuple(y * grid.columns + x for y in range(top, bottom + 1) for x in range(left, right + 1))
        start = int(grid.cell_of(torch.tensor(self.config.screen.start)))
        (target,) = self.scenes.targets(index)
        episode = Episode(index, target, target, 0, start, goal, True)
        looks = looks_of([episode], detections, grid)
        noise = tie_noise(self.scenes, episode, len(grid), protocol)[None]
        records: list[ResultRecord] = []
        for policy in self.policies:
            candidate = self.candidate(policy, index)
            with torch.inference_mode():
                (outcome,) = run_episodes(
                    [episode], candidate, looks, noise, shifts=protocol.shifts, batch=protocol.batch
                )
            watch.lap(policy)
            path = {"cells": list(outcome.cells), "found_at": outcome.found_at}
            records.append({"policy": policy, "scene": name, "target_name": search.target, **path})
        return records, watch.seconds

    def searches(self, records: list[ResultRecord]) -> dict[str, list[Fixations]]:
        """The policies' scanpaths in pixels of the screen, by policy."""
        screen = self.config.screen
        centres = Grid(self.config.belief.columns, self.config.belief.rows, (screen.width, screen.height)).centres
        scanpaths: dict[str, list[Fixations]] = {name: [] for name in self.policies}
        for record in records:
            search = self.screens.searches[record["scene"]]
            points = centres[record["cells"]].double().numpy()
            more = {"target": search.target, "box": search.box, "found": record["found_at"] >= 0}
            scanpaths[record["policy"]].append(
                Fixations(record["scene"], record["policy"], points, search.size, None, **more)
            )
        return scanpaths
