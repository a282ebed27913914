"""Calibration of beliefs: how well each cell's probability of the target agrees with where the target is.

All beliefs are updated with the looks of the same searches.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from eval.calibration.sums import AddedSums
from eval.comparison.looking import ComparedLooking
from eval.comparison.model_folder import if_shipped
from eval.decide.run import detected_on_landing, landing
from eval.search.run import SearchConfig
from semfov.belief.observers import Observer, SemanticMap, SemanticSearch
from semfov.episode import Step, rollout
from semfov.episode.stopwatch import Stopwatch
from semfov.gaze.acquisition import AcquisitionFunction, Uniform
from semfov.gaze.acquisition.base import Task
from semfov.gaze.choice import Choice, Given, Greedy, drawn_from
from semfov.gaze.policies import Policy
from semfov.runs.config import PolicyConfig
from semfov.runs.looking import CellLooks
from semfov.runs.presets import label
from semfov.runs.protocols import DrawnSearch, choose_searches
from semfov.runs.results import ResultRecord
from semfov.runs.setup import make_map, make_searching

COUNTS = (1, 5, 15)
"""Numbers of looks after which beliefs are evaluated."""

BANDS = (0.14, 0.24, 0.34)
"""Edges between bands of eccentricity, as fractions of the image's longer side.

In photographs of usual proportions no two centres of 10 × 10 cells lie exactly this far apart, so that rounding does
not decide which band a cell belongs to.
"""

FIXATED, FARTHEST = "fixated", f"{BANDS[-1]:.2f} - …"
CELL_GROUPS = (FIXATED, *(f"{low:.2f} - {high:.2f}" for low, high in pairwise((0, *BANDS))), FARTHEST)
"""Groups of cells: the fixated cells, then all others by their distance from the closest fixation."""

_ALL_CLASSES = {
    "raw": PolicyConfig("non-predictive"),
    "calibrated": PolicyConfig("non-predictive", "calibrated"),
    "tempered": PolicyConfig("non-predictive", tempering=0.5),
}
"""Beliefs fused by Kaplan's rule: from raw scores, from calibrated scores, and from raw scores tempered by 0.5."""

LEARNED, MAP = "learned", "semantic map"


class BeliefCalibrationRun(ComparedLooking):
    """Two searches in every scene, for a present class and for an absent class, that do not stop at the target.

    The learned belief guides the gaze, as in the agent. Where no model of searches is shipped, the tempered belief
    guides it. All beliefs are updated with the same looks.
    """

    task: Task = "search"
    config: SearchConfig

    def __init__(self, config: SearchConfig) -> None:
        super().__init__(replace(config, policies=tuple(_ALL_CLASSES.values())))
        self.left_out: dict[str, str] = {}
        belief = self.config.belief
        leave_out = self.left_out.__setitem__
        of_search = if_shipped(make_searching, belief.search_model, self.eye, partial(leave_out, LEARNED))
        of_map = if_shipped(make_map, belief.map_model, self.eye, partial(leave_out, MAP))
        self.models = self.models._replace(search=of_search, map=of_map)
        self.observers: dict[str, Observer] = {
            name: self.strategies[label(choice, self.task)].observer for name, choice in _ALL_CLASSES.items()
        }
        if of_search is not None:
            self.observers[LEARNED] = SemanticSearch(of_search)
        if of_map is not None:
            self.observers[MAP] = SemanticMap(of_map)

    def depends_on(self) -> dict[str, Any]:
        """List what searches depend on, and how calibration is measured."""
        return {**super().depends_on(), "belief calibration": [COUNTS, BANDS, AddedSums.EDGES.tolist()]}

    @property
    def guide(self) -> str:
        """Name of the belief that guides the gaze."""
        return LEARNED if LEARNED in self.observers else "tempered"

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Run both searches of a scene; returns their records, and the seconds that each stage took."""
        watch = Stopwatch()
        grid = self.grid(index)
        largest_area = self.config.data.max_target_area or 1.0
        searches = choose_searches(self.scenes, index, grid, self.config.protocol, 1, largest_area)
        if not searches:
            return [], watch.seconds
        detections = self.detections(index)
        watch.lap("look")
        records: list[ResultRecord] = []
        for search in searches:
            with torch.inference_mode():
                looks = CellLooks(lambda cell: detections[cell : cell + 1], grid, detections.scores, search.target)
                beliefs = self._search(search, looks)
            common = {"scene": self.scenes.ids[index], "target": search.target, "present": search.present}
            records.append({**common, **beliefs})
        watch.lap("believe")
        return records, watch.seconds

    def _search(self, search: DrawnSearch, looks: CellLooks) -> ResultRecord:
        """Search by the guide, and update all beliefs with its looks."""
        target = search.target
        goal = search.goal
        most = min(self.config.protocol.shifts + 1, COUNTS[-1])

        def walk(name: str, acquisition: AcquisitionFunction, choice: Choice) -> list[Step]:
            return list(rollout(looks, self.observers[name], acquisition, search.start, choice, most=most))

        most_probable = Policy("non-predictive")(target, looks.grid)
        guided = walk(self.guide, most_probable, Greedy(drawn_from(search.noise)))
        path = torch.cat([step.cell for step in guided])
        beliefs: dict[str, ResultRecord] = {}
        for name in self.observers:
            # The others look along the path of the guide.
            steps = guided if name == self.guide else walk(name, Uniform(), Given(path[None]))
            sums = {str(count): _judge_cells(steps[count - 1], target, goal) for count in COUNTS if count <= len(steps)}
            beliefs[name] = {"looks": sums, "landing": landing([step.belief for step in steps], path, goal, target)}
        return {"seen": detected_on_landing(guided, path, goal, target, looks.grid), "beliefs": beliefs}


def _judge_cells(step: Step, target: int, goal: Tensor) -> ResultRecord:
    """Compute sums over the cells of a search after a step, by group of cells.

    Shapes: goal `(X·Y,)`.
    """
    belief = step.belief
    band = 1 + torch.bucketize(belief.closest[0].double(), torch.tensor(BANDS, dtype=torch.float64))
    group = band.masked_fill(step.visited[0], 0)  # fixated cells are group 0
    probability = belief.probability(target)[0]
    sums = {}
    for number, name in enumerate(CELL_GROUPS):
        inside = group == number
        if inside.any():
            sums[name] = AddedSums.of(probability[inside], goal[inside]).record()
    return sums
