"""Fuzz the whole chain to the next fixation with detectors that return invalid or unusual candidates."""

import numpy as np
import torch
from hypothesis import strategies as st
from torch import Tensor

from benchmarks.fuzz.runner import attempt, choose, draw_rng, failed, outcome
from semfov import ActivePerception, Eye, FovealObservationModel, Foveation, Scanpath, observers, policies
from semfov.detection import Candidates, Detector, Selection

CLASSES = ("cat", "cup", "person")
BOXES = ("ordinary", "outside", "inverted", "pointlike", "infinite", "NaN")
SCORES = ("ordinary", "zero", "certain", "tiny", "NaN", "negative", "above one")


class Odd(Detector):
    """A detector that returns given candidates for every canvas."""

    def __init__(self, candidates: Candidates, selection: Selection) -> None:
        super().__init__("odd", CLASSES, (32, 32), selection=selection)
        self.candidates = candidates

    def propose(self, canvas: Tensor) -> Candidates:
        """Return the given candidates."""
        return self.candidates


def detectors(data: st.DataObject) -> str:
    """`ActivePerception.search`: finite beliefs, and cells in the grid that are never repeated; or an error."""
    rng = draw_rng(data)
    count = choose(data, (0, 1, 3, 40, 10_000), "count")
    boxes, scores = choose(data, BOXES, "boxes"), choose(data, SCORES, "scores")
    with_objectness = data.draw(st.booleans(), label="objectness")
    candidates = draw_candidates(rng, count, boxes, scores, with_objectness)
    selection = Selection(threshold=choose(data, (0.02, 0.0, 1.0), "threshold"), limit=choose(data, (100, 1), "limit"))
    detector = Odd(candidates, selection)
    model = None
    if data.draw(st.booleans(), label="calibrated"):
        model = FovealObservationModel.identity(CLASSES, [0.2, 0.4]).eval().requires_grad_(False)
    policy = policies.named_policy(choose(data, ("non-predictive", "random"), "policy"), "search")
    width, height = data.draw(st.integers(1, 40), label="width"), data.draw(st.integers(1, 40), label="height")
    columns, rows = data.draw(st.integers(1, 6), label="columns"), data.draw(st.integers(1, 6), label="rows")
    observer = observers.Semantic(len(CLASSES) + 1, model)
    eye = Eye(Foveation(10.0), detector, reference=64.0)
    agent = ActivePerception(eye, (observer, policy), (observer, policies.Random()), grid=(columns, rows))
    image = torch.from_numpy(rng.random((3, height, width), dtype=np.float32))
    result = attempt(lambda: agent.search(image, "cup", shifts=3, confirm=1.0))
    if failed(result):
        assert boxes in ("NaN", "infinite") or scores in ("NaN", "negative", "above one"), result
        return outcome(result)
    check(result, selection, (width, height), columns * rows)
    return "result"


def check(path: object, selection: Selection, size: tuple[int, int], cells: int) -> None:
    """Check everything that is documented of a scanpath."""
    assert isinstance(path, Scanpath)
    probabilities = path.probabilities
    assert bool(torch.isfinite(probabilities).all())
    assert bool((probabilities >= 0).all())
    assert bool((probabilities.sum(-1) - 1).abs().max() < 1e-5)
    visited = path.cells.tolist()
    assert len(set(visited)) == len(visited) == min(4, cells)
    assert all(0 <= cell < cells for cell in visited)
    for look in path.detections:
        boxes, scores = look.boxes[look.mask], look.scores[look.mask]
        assert len(boxes) <= selection.limit
        assert bool(((boxes >= 0) & (boxes <= torch.tensor([size] * 2).flatten())).all())
        assert bool((boxes[:, 2:] > boxes[:, :2]).all())
        assert bool((scores >= 0).all())
        torch.testing.assert_close(scores.sum(-1), torch.ones(len(scores)))
        confidence = scores[:, 1:].amax(-1)
        assert bool((confidence.diff() <= 0).all())


def draw_candidates(rng: np.random.Generator, count: int, boxes: str, scores: str, with_objectness: bool) -> Candidates:
    """Candidates, of which some have boxes or scores of the given unusual kinds."""
    corner, extent = rng.uniform(0, 28, (count, 2)), rng.uniform(1, 20, (count, 2))
    edges = np.concatenate([corner, corner + extent], -1)
    classes = rng.random((count, len(CLASSES)))
    objectness = rng.random(count)
    odd = rng.random(count) < choose_share(rng)
    if boxes == "outside":
        edges[odd] += 1000.0
    elif boxes == "inverted":
        edges[odd] = edges[odd][:, [2, 3, 0, 1]]
    elif boxes == "pointlike":
        edges[odd, 2:] = edges[odd, :2]
    elif boxes == "infinite":
        edges[odd] = np.array([-np.inf, -np.inf, np.inf, np.inf])
    elif boxes == "NaN":
        edges[odd, rng.integers(4)] = np.nan
    values = {"zero": 0.0, "certain": 1.0, "tiny": 1e-45, "NaN": np.nan, "negative": -0.5, "above one": 1.5}
    if scores in values:
        classes[odd] = values[scores]
        objectness[odd] = values[scores]
    tensors = [torch.from_numpy(array).float() for array in (edges, classes, objectness)]
    return Candidates(tensors[0][None], tensors[1][None], tensors[2][None] if with_objectness else None)


def choose_share(rng: np.random.Generator) -> float:
    """A random share of candidates to make unusual."""
    return float(rng.choice([0.1, 0.5, 1.0]))
