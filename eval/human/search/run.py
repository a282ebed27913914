"""Searches of policies on the screens that people searched, with the same first fixation, cells and stop."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch

from eval.comparison.looking import ComparedLooking
from eval.comparison.settings import ComparedConfig
from eval.human.search.screens import Screens
from eval.human.search.trials import goal_rectangle, read_searches
from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.data.scene import Scenes
from semfov.detection.load import check_detector
from semfov.episode import StoredLooks
from semfov.episode.stopwatch import Stopwatch
from semfov.gaze.acquisition.base import Task
from semfov.io.ranges import Count, Positive, Range
from semfov.runs.config import BeliefConfig, PolicyConfig, ProtocolConfig
from semfov.runs.presets import AGENT
from semfov.runs.protocols import Trial, run_episodes
from semfov.runs.results import ResultRecord
from semfov.runs.seeds import noise_for
from semfov.runs.settings import Settings


@dataclass(frozen=True)
class ScreenConfig(Settings):
    """The screen on which people saw the pictures, with each picture letterboxed on it.

    Args:
        width: width in pixels.
        height: height in pixels.
        degrees: width in degrees of visual angle (COCO-Search18: 54).
        start: `(x, y)` in pixels, the first fixation (default: the mean of people's first fixations in COCO-Search18).
    """

    width: Count = 1680
    height: Count = 1050
    degrees: Positive = 54.0
    start: tuple[Positive, Positive] = (816.0, 509.0)


@dataclass(frozen=True)
class PeopleSearchConfig(ComparedConfig):
    """Comparison of people, models and policies that search for the same targets in the same pictures.

    Args:
        people: scanpaths of people: a folder with one JSON file per person (format of Ruarte et al.), or a table
            (`.csv`).
        files: scanpaths of models, each a JSON file in the same format or a table; the file's name is the name of the
            model in the results.
        pictures: folders in which the pictures are looked for; policies search in the pictures that are found.
        screen: the screen.
        sensor: the foveal sensor; it sees the whole screen.
        belief: the belief, on a grid over the screen; the default of 32 × 24 cells is the grid of the models' files.
        protocol: the protocol; a search has failed after `shifts` gaze shifts, and `seed` draws the random baselines.
        policies: policies to compare (`python -m eval.search --help`).
        bandwidth: bandwidth, in screen pixels, of the clusters of fixations that make up the letters of a sequence.
        bootstrap: number of bootstrap samples of the pictures for the standard errors of TFP-AUC.
        out: folder for tables, figures and the manifest.
        cache: folder for the stored detections from every cell (None: the user's cache).
        store: keep detections on disk.
    """

    unused = ("data", "models")
    people: Path = Path("human_scanpaths")
    files: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()
    screen: ScreenConfig = field(default_factory=ScreenConfig)
    belief: BeliefConfig = field(default_factory=lambda: BeliefConfig(columns=32, rows=24))
    protocol: ProtocolConfig = field(default_factory=lambda: ProtocolConfig(shifts=9))
    policies: tuple[str | PolicyConfig, ...] = ("non-predictive-raw", "predictive-calibrated", AGENT)
    bandwidth: Positive = 100.0
    bootstrap: Annotated[int, Range(2, 10_000)] = 200
    out: Path = Path("runs/human_search")


class PeopleSearchRun(ComparedLooking):
    """Searches for the targets of people, one screen after the other."""

    task: Task = "search"
    config: PeopleSearchConfig

    def check_sources(self) -> None:
        """Check that the detector exists; pictures are looked for after people's files have been read."""
        check_detector(self.config.detector.name)

    def open_scenes(self) -> Scenes:
        """Return the screens whose pictures are found."""
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
        episode = Trial(index, target, target, 0, start, goal, True)
        looks = StoredLooks(detections, grid, torch.tensor([target]))
        noise = noise_for(protocol, len(grid), self.scenes.ids[index], target, 0)[None]
        records: list[ResultRecord] = []
        for policy in self.policies:
            candidate = self.candidate(policy, index)
            with torch.inference_mode():
                ((cells, found_at),) = run_episodes(
                    [episode], candidate, looks, noise, shifts=protocol.shifts, batch=protocol.batch
                )
            watch.lap(policy)
            path = {"cells": cells, "found_at": found_at}
            records.append({"policy": policy, "scene": name, "target_name": search.target, **path})
        return records, watch.seconds

    def searches(self, records: list[ResultRecord]) -> dict[str, list[Fixations]]:
        """Return the policies' scanpaths in pixels of the screen, by policy."""
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
