"""Replays recorded episodes, with the detections and the belief at each fixation."""

from dataclasses import replace

import torch

from eval.comparison.looking import ComparedLooking
from eval.comparison.model_folder import if_shipped
from semfov.belief.observers import Observer, Semantic, SemanticMap, SemanticSearch
from semfov.episode import StoredLooks, rollout
from semfov.gaze.choice import Given
from semfov.paths import Scanpath
from semfov.paths.trace import Trace
from semfov.runs.results import ResultRecord
from semfov.runs.setup import make_map


def replay(run: ComparedLooking, index: int, record: ResultRecord) -> Scanpath:
    """Replay a recorded episode.

    The learned belief of searches is no map of all classes, which is then maintained beside it: that of the recommended
    agent or, if no model is shipped for the eye, one by Kaplan's rule from tempered scores.
    """
    grid = run.grid(index)
    candidate = run.candidate(record["policy"], index)
    cue = record.get("cue")
    cells = torch.tensor([record["cells"]])
    looks = StoredLooks(run.detections(index), grid, None if cue is None else torch.tensor([cue]))
    steps = rollout(
        looks,
        candidate.observer,
        lambda _, cell: candidate.acquisition(cue, grid, cell),
        cells[:, 0],
        Given(cells),
        most=cells.shape[1],
    )
    beside: Observer | None = None
    if isinstance(candidate.observer, SemanticSearch):
        model = if_shipped(make_map, run.config.belief.map_model, run.eye)
        beside = Semantic(len(run.scenes.classes) + 1, tempering=0.5) if model is None else SemanticMap(model)
    with torch.no_grad():
        trace = Trace(grid, ("background", *run.scenes.classes), cue, beside)
        for step in steps:
            # The time to read the store is not the duration of the episode.
            trace.add(replace(step, seconds={}))
        scanpath = trace.scanpath()
    return replace(scanpath, target=record.get("target"), found=record.get("found_at", -1) >= 0)
