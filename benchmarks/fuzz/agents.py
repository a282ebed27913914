"""Fuzz an agent with invalid or unusual detectors, pictures and arguments, and the settings of commands."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import numpy as np
import torch
from torch import Tensor

from benchmarks.fuzz.runner import Case, Draw
from semfov import ActivePerception, Eye, FovealObservationModel, Foveation, Scanpath, observers, policies
from semfov.detection import Candidates, Detector, Selection
from semfov.io.ranges import Range
from semfov.runs import config as settings

CLASSES = ("cat", "cup", "person")
BOXES = ("ordinary", "outside", "inverted", "pointlike", "infinite", "NaN")
SCORES = {"ordinary": None, "zero": 0.0, "certain": 1.0, "tiny": 1e-45, "NaN": math.nan, "negative": -0.5,
          "above one": 1.5}  # fmt: skip
PICTURES = ("ordinary", "ordinary", "ordinary", "bytes", "255 times", "negative", "NaN", "infinite", "float64", "half")
NUMBERS: list[Any] = [
    -(10**12), -2, -1, 0, 1, 2, 3, 7, 11, 12, 50, 10_000, 10_001, 2**31, 2**63 - 1, 2**63, 10**30,
    -0.5, 0.0, 0.25, 0.999, 1.0, 1.5, 1e-300, 1e300, math.nan, math.inf, -math.inf, True, False, [], "3", {},
]  # fmt: skip


class Fixed(Detector):
    """A detector that returns the same candidates for every canvas."""

    def __init__(self, candidates: Candidates, selection: Selection) -> None:
        super().__init__("fixed", CLASSES, (32, 32), selection=selection)
        self.candidates = candidates

    def propose(self, canvas: Tensor) -> Candidates:
        """Return the given candidates."""
        return self.candidates


def agent_with(
    detector: Detector, grid: tuple[int, int], model: FovealObservationModel | None, policy: policies.Policy
) -> ActivePerception:
    """Return an agent that searches by `policy` and explores at random."""
    observer = observers.Semantic(len(CLASSES) + 1, model)
    eye = Eye(Foveation(10.0), detector, reference=64.0)
    return ActivePerception(eye, (observer, policy), (observer, policies.Policy("random")), grid=grid)


def detectors(draw: Draw, _: Path) -> Case:
    """`ActivePerception.search`, with any candidates: finite beliefs, and cells in the grid that never repeat."""
    boxes, scores = draw.choose(BOXES, "boxes"), draw.choose(SCORES, "scores")
    candidates = draw_candidates(draw, draw.choose((0, 1, 3, 40, 10_000), "count"), boxes, scores)
    selection = Selection(threshold=draw.choose((0.02, 0.0, 1.0), "threshold"), limit=draw.choose((100, 1), "limit"))
    model = None
    if draw.flag("calibrated"):
        model = FovealObservationModel.identity(CLASSES, [0.2, 0.4]).eval().requires_grad_(False)
    policy = policies.Policy(draw.choose(("non-predictive", "random"), "policy"))
    width, height = draw.integer(1, 40, "width"), draw.integer(1, 40, "height")
    grid = draw.integer(1, 6, "columns"), draw.integer(1, 6, "rows")
    agent = agent_with(Fixed(candidates, selection), grid, model, policy)
    image = torch.from_numpy(draw.rng.random((3, height, width), dtype=np.float32))

    def check(path: Scanpath) -> None:
        assert bool(torch.isfinite(path.probabilities).all())
        assert bool((path.probabilities >= 0).all())
        assert bool((path.probabilities.sum(-1) - 1).abs().max() < 1e-5)
        visited, cells = path.cells.tolist(), math.prod(grid)
        assert len(set(visited)) == len(visited) == min(4, cells)
        assert all(0 <= cell < cells for cell in visited)
        for look in path.detections:
            kept, found = look.boxes[look.mask], look.scores[look.mask]
            assert len(kept) <= selection.limit
            assert bool(((kept >= 0) & (kept <= torch.tensor([width, height] * 2))).all())
            assert bool((kept[:, 2:] > kept[:, :2]).all())
            assert bool((found >= 0).all())
            torch.testing.assert_close(found.sum(-1), torch.ones(len(found)))
            assert bool((found[:, 1:].amax(-1).diff() <= 0).all())

    return Case(
        lambda: agent.search(image, "cup", shifts=3, confirm=1.0),
        check,
        may=boxes in ("NaN", "infinite") or scores in ("NaN", "negative", "above one"),
        must=False,
    )


def draw_candidates(draw: Draw, count: int, boxes: str, scores: str) -> Candidates:
    """Candidates, of which a random share has boxes or scores of the given kinds."""
    rng = draw.rng
    corner, extent = rng.uniform(0, 28, (count, 2)), rng.uniform(1, 20, (count, 2))
    edges = np.concatenate([corner, corner + extent], -1)
    classes, objectness = rng.random((count, len(CLASSES))), rng.random(count)
    odd = rng.random(count) < rng.choice([0.1, 0.5, 1.0])
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
    if (value := SCORES[scores]) is not None:
        classes[odd] = objectness[odd] = value
    tensors = [torch.from_numpy(array).float()[None] for array in (edges, classes, objectness)]
    return Candidates(tensors[0], tensors[1], tensors[2] if draw.flag("objectness") else None)


def agent_arguments(draw: Draw, _: Path) -> Case:
    """`search` and `explore`: a scanpath on the grid if all values are valid, else `InputError` that names one."""
    kind = draw.choose(PICTURES, "image")
    image = picture(kind, draw.rng)
    arguments: dict[str, Any] = {}
    wrong = set() if kind in ("ordinary", "bytes", "float64", "half") else {"picture"}
    for name, (low, high) in {"shifts": (0, 10_000), "seed": (0, 2**63 - 1), "start": (0, 11)}.items():
        if draw.flag(f"give {name}"):
            arguments[name] = value = draw.choose(NUMBERS, name)
            if not (isinstance(value, int) and not isinstance(value, bool) and low <= value <= high):
                wrong.add(name)
    seen = Candidates(torch.tensor([[[4.0, 4, 20, 20]]]), torch.tensor([[[0.1, 0.9, 0.1]]]), None)
    agent = agent_with(Fixed(seen, Selection()), (4, 3), None, policies.Policy("non-predictive"))
    seek = draw.flag("search")

    def check(path: Scanpath) -> None:
        assert 1 <= len(path.cells) <= min(arguments.get("shifts", 30 if seek else 20), 11) + 1
        assert bool(((path.cells >= 0) & (path.cells < 12)).all())

    return Case(
        lambda: agent.search(image, "cup", **arguments) if seek else agent.explore(image, **arguments),
        check,
        may=bool(wrong),
        names=wrong,
    )


def picture(kind: str, rng: np.random.Generator) -> Tensor:
    """Return a small image, or a tensor that is not a valid image."""
    image = torch.from_numpy(rng.random((3, int(rng.integers(8, 40)), int(rng.integers(8, 40))), dtype=np.float32))
    if kind in ("NaN", "infinite"):
        image[tuple(int(rng.integers(size)) for size in image.shape)] = math.nan if kind == "NaN" else math.inf
    changed = {
        "bytes": lambda: (image * 255).byte(),
        "255 times": lambda: image * 255,
        "negative": lambda: image - 0.5,
        "float64": lambda: image.double(),
        "half": lambda: image.half(),
    }
    return changed[kind]() if kind in changed else image


def settings_values(draw: Draw, _: Path) -> Case:
    """Return settings of the commands: accepted if a number is in the range of its type, else refused by name."""
    kinds = [kind for kind in vars(settings).values() if dataclasses.is_dataclass(kind) and isinstance(kind, type)]
    kind, name, base, allowed, optional = draw.choose(
        ((kind, *field) for kind in kinds for field in fields_of(kind)), "setting"
    )
    limits = (allowed.low, allowed.high, allowed.above, allowed.below)
    bounds = [bound for bound in limits if bound is not None and math.isfinite(bound)]
    edges = [bound + step for bound in bounds for step in (-1, 0, 1, 0.5)]
    value = draw.choose([*NUMBERS, *edges, *([None] if optional else [])], "value")
    values = {"policy": "random", name: value} if kind is settings.PolicyConfig else {name: value}
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    fits = number and (base is float or isinstance(value, int))
    fits = fits and allowed.low <= value <= allowed.high
    fits = fits and (allowed.above is None or value > allowed.above)
    fits = fits and (allowed.below is None or value < allowed.below)
    # Words and mappings are checked only on the command line.
    unchecked = isinstance(value, dict) or (isinstance(value, str | None) and optional)

    def check(config: object) -> None:
        assert dataclasses.is_dataclass(config)

    return Case(lambda: kind(**values), check, may=not fits, must=not fits and not unchecked, names={name})


def fields_of(kind: type[Any]) -> list[tuple[str, type, Range, bool]]:
    """Name, type and range of every number among the settings, and whether it may be None."""
    ranges = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        for option in (hint, *get_args(hint)):
            if get_origin(option) is Annotated and isinstance(get_args(option)[1], Range):
                base, allowed = get_args(option)[:2]
                ranges.append((name, base, allowed, option is not hint))
    return ranges
