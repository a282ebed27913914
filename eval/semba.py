"""The searcher of SemBA, step by step from this project's looks to those of its code: `python -m eval.semba`.

    python -m eval.semba --data.root val --data.annotations instances_val.json

A search starts in the middle of the photograph, looks through a multi-scale fovea, fuses raw scores on a grid of
32 × 20 cells, fixates the most probable cell that was not fixated before, and ends after six gaze shifts or where the
target has a probability of 0.1 in the fixated cell (Luzio, Bernardino and Moreno, 2026; the code of SemBA,
vislab-tecnico-lisboa/SemBA). Each row of the table takes over one more thing from that code, with Kaplan's rule and
with the rule of the code. To continue a stopped run, give the same command again.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from eval.bootstrap import Bootstrap
from semfov.belief.grid import Grid
from semfov.belief.observers import Observer, Semantic
from semfov.detection.detections import Detections
from semfov.episode import EpisodeLook, Looks, Step, rollout
from semfov.errors import DataError, check
from semfov.eye import Eye
from semfov.gaze.acquisition import TargetPosterior
from semfov.gaze.choice import Greedy, drawn_from
from semfov.io.files import write_text
from semfov.io.ranges import Positive, Share
from semfov.runs.command import command
from semfov.runs.config import BeliefConfig, DetectorConfig, LookingConfig, ProtocolConfig, SensorConfig
from semfov.runs.looking import CellLooks, Looking
from semfov.runs.looks import photograph_looks
from semfov.runs.progress import track
from semfov.runs.seeds import noise_for
from semfov.runs.store import RememberedLooks
from semfov.runs.tables import table
from semfov.sensor import MultiScaleFovea

_RULES = ("kaplan", "semba")
_SHIFTS = (1, 3, 6)
_Picture = Literal["shrunk", "native", "bilinear"]
"""What crops show: the picture in the size of this project, in that of SemBA, or that without averaging."""


class _Step(NamedTuple):
    """What a row of the table takes over from the code of SemBA.

    Attributes:
        name: what it takes over beside what the row before it does.
        scores: whether scores are those of the code (`_CodeLooks`).
        picture: what crops show.
        inhibition: whether the cells around those that were chosen are inhibited.
        escape: whether those around the present cell are, too, if a crop shows nothing.
    """

    name: str
    scores: bool = True
    picture: _Picture = "native"
    inhibition: bool = True
    escape: bool = True


_STEPS = (
    _Step("here", scores=False, picture="shrunk", inhibition=False, escape=False),
    _Step("scores", picture="shrunk", inhibition=False, escape=False),
    _Step("and native picture", inhibition=False, escape=False),
    _Step("and 3 × 3 inhibition", escape=False),
    _Step("and escape"),
    _Step("and bilinear crops", picture="bilinear"),
)
_LEAST = 1e-12


@dataclass(frozen=True)
class _SembaConfig(LookingConfig):
    """Search as SemBA does, with both rules of fusion; `detector.limit` boxes of a crop are fused.

    Args:
        belief: the belief; `columns`, `rows` and `prior` are used.
        protocol: the protocol; `shifts`, `ties` and `seed` are used.
        native: longer side in pixels of the pictures of SemBA (COCO-Search18).
        stop: probability of the target in the fixated cell at which a search ends.
        out: folder for the table.
        workers: ignored; the photographs are searched in this process.
        scheduler: ignored.
    """

    detector: DetectorConfig = field(default_factory=lambda: DetectorConfig(background="none", threshold=0.01))
    sensor: SensorConfig = field(default_factory=lambda: SensorConfig("multi-scale"))
    belief: BeliefConfig = field(default_factory=lambda: BeliefConfig(columns=32, rows=20, prior=1.0))
    protocol: ProtocolConfig = field(default_factory=lambda: ProtocolConfig(shifts=6))
    native: Positive = 1680.0
    stop: Share = 0.1
    out: Path = Path("runs/semba")


class _BilinearFovea(MultiScaleFovea):
    """The crops without averaging: a pixel is the picture in the middle of its square, by bilinear interpolation."""

    def look(self, state: tuple[tuple[Tensor, ...], tuple[int, int]], gaze: Tensor) -> Tensor:
        """Compute the crops `(F·L, 3, side, side)` around fixations `(F, 2)`."""
        (bordered, *_), size = state
        windows = self.windows(gaze).flatten(0, 1)
        middles = (torch.arange(self.side, device=gaze.device) + 0.5) / self.side
        points = windows[:, None, :2] + middles[:, None] * (windows[:, 2:] - windows[:, :2])[:, None]
        x, y = (2 * points / points.new_tensor(size) - 1).unbind(-1)
        where = torch.stack(torch.broadcast_tensors(x[:, None, :], y[:, :, None]), -1).to(bordered)
        image = bordered[..., 1:-1, 1:-1].expand(len(where), -1, -1, -1)
        return F.grid_sample(image, where, "bilinear", "zeros", align_corners=False)


class _CodeLooks(Looks):
    """Looks at an image `(1, 3, H, W)` as in the code of SemBA: the boxes of all crops, the best of each.

    They have a softmax over the logits of the K classes, and are not suppressed. Of the last look of each of A episodes
    it tells the cells `(A,)`, and whether a crop showed nothing, `empty` `(A,)`.
    """

    cell: Tensor
    empty: Tensor

    def __init__(self, eye: Eye, image: Tensor, grid: Grid) -> None:
        self.eye = eye
        self.grid = grid
        self.like = image
        self._crops: RememberedLooks[int, Detections] = RememberedLooks(self._open)

    def _open(self) -> Callable[[int], Detections]:
        detector = self.eye.detector
        sensor = self.eye.sensor
        view = self.eye.open(self.like)

        def look(cell: int) -> Detections:
            gaze = view.placement.points_to_canvas(self.grid.centres.to(self.like)[[cell]])
            candidates = detector.propose(sensor.look(view.state, gaze)).precise()
            count = min(detector.selection.limit, candidates.confidence.shape[1])
            best = candidates.confidence.topk(count).indices[..., None]
            classes = candidates.classes.take_along_dim(best, 1)
            scores = classes.double().logit(_LEAST).softmax(-1).to(classes)
            boxes_in_crops = candidates.boxes.take_along_dim(best, 1)
            boxes = view.placement.boxes_to_image(sensor.boxes_to_canvas(view.state, gaze, boxes_in_crops))
            return Detections(boxes, scores, scores.amax(-1) > detector.selection.threshold)

        return look

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        """Look, and weigh."""
        crops = Detections.stack([self._crops(number) for number in cell.tolist()])  # a row for each crop
        shown = crops.mask.unflatten(0, (len(cell), -1))  # (A, crops, N)
        self.cell = cell
        self.empty = ~shown.any(-1).all(-1)
        # The boxes of all crops of a look are in one row.
        boxes = crops.boxes.unflatten(0, shown.shape[:2]).flatten(1, 2)
        scores = crops.scores.unflatten(0, shown.shape[:2]).flatten(1, 2)
        detections = Detections(boxes, scores, shown.flatten(1))
        return EpisodeLook(observer.weigh(detections, fixation, self.grid), lambda: detections, {})


class _Inhibited(Greedy):
    """Chooses as the code of SemBA does: none of the 3 × 3 cells around those that were chosen before.

    With `escape` none around the present cell either, if a crop shows nothing. The start alone inhibits nothing.
    Shapes: noise `(B, shifts, X·Y)`.
    """

    def __init__(self, noise: Tensor, looks: _CodeLooks, *, escape: bool) -> None:
        super().__init__(drawn_from(noise))
        self.looks = looks
        self.escape = escape
        self.inhibited = torch.zeros(len(noise), noise.shape[-1], dtype=torch.bool)

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the centre of the best cell and the cell, and inhibit the cells around it."""
        if self.escape:
            self.inhibited[episodes] |= self._around(self.looks.cell) & self.looks.empty[:, None]
        fixation, cell = super().__call__(shift, episodes, values, self.inhibited[episodes], centres)
        self.inhibited[episodes] |= self._around(cell)
        return fixation, cell

    def _around(self, cell: Tensor) -> Tensor:
        """Mark the 3 × 3 cells around cells `(B,)`, `(B, X·Y)`."""
        columns = self.looks.grid.columns
        cells = torch.arange(len(self.looks.grid))
        columns_apart = (cells % columns - cell[:, None] % columns).abs()
        rows_apart = (cells // columns - cell[:, None] // columns).abs()
        return (columns_apart <= 1) & (rows_apart <= 1)


def _search_as_semba(config: _SembaConfig) -> None:
    """Search for every target of every photograph in each way, and write the table."""
    check(config.sensor.name == "multi-scale", "sensor.name", "multi-scale, as SemBA has it", config.sensor.name)
    run = Looking(config)
    results: list[Tensor] = []
    scenes: list[int] = []
    for index in track(range(len(run.scenes)), "searching", "scene"):
        outcomes = _search_scene(config, run, index)
        results += outcomes
        scenes += [index] * len(outcomes)
    if not results:
        raise DataError("data: no scene has a class that may be searched for; raise data.max_target_area")
    figures = torch.stack(results)  # (searches, rules, figures)

    def measure(cases: Tensor) -> Tensor:
        chosen = figures[cases]
        fixated = chosen[..., :-2]
        stopped = chosen[..., -2]
        right = chosen[..., -1]
        of_stops = torch.stack([stopped.mean(0), right.sum(0) / stopped.sum(0)], -1)
        return torch.cat([fixated.mean(0), of_stops], -1)

    bootstrap = Bootstrap.of(measure, scenes)
    head = [*(f"CP@{n}" for n in _SHIFTS if n <= config.protocol.shifts), "stopped", "right of those"]
    ways = [f"{step.name}, {rule}" for step, rule in product(_STEPS, _RULES)]
    rows = [["as in the code of SemBA, rule", *head]]
    rows += [[way, *bootstrap.cells(n, 1, unit=100)] for n, way in enumerate(ways)]
    differences = [["less the row of this rule before", *head]]
    for n in range(len(_RULES), len(ways)):
        before = bootstrap.less(n - len(_RULES))
        differences.append([ways[n], *before.cells(n, 1, sign="+", unit=100)])
    lines = [*table(rows), "", *table(differences)]
    text = "\n".join([f"{len(results)} searches in {len(set(scenes))} photographs", "", *lines, ""])
    write_text(config.out / "summary.md", text)
    print(text)


@torch.inference_mode()
def _search_scene(config: _SembaConfig, run: Looking, index: int) -> list[Tensor]:
    """Search one photograph for each of its targets that is not in the middle; figures `(steps · rules, 5)` of each."""
    grid = run.grid(index)
    annotation = run.scenes.annotation(index)
    middle = grid.cell_of(grid.extent[None] / 2)
    covered = grid.footprint(annotation.boxes)
    goals: dict[int, Tensor] = {}
    for target in run.scenes.targets(index):
        cells_of_target = covered[annotation.labels == target].any(0)
        if not bool(cells_of_target[middle]):  # no search starts on its target
            goals[target] = cells_of_target
    if not goals:
        return []
    targets = torch.tensor([*goals], dtype=torch.int64)
    goal = torch.stack([*goals.values()])
    noise = torch.stack([noise_for(config.protocol, len(grid), index, target) for target in goals])
    image = run.scenes[index].image[None]
    store = run.store if config.store else None
    remembered = RememberedLooks(
        lambda: photograph_looks(run.eye, lambda: image, grid), store, lambda: run.digest(index)
    )
    looks_here = CellLooks(remembered, grid, image)
    code_looks = {picture: _CodeLooks(eye, image, grid) for picture, eye in _eyes(config, run.eye).items()}
    results = []
    for step, rule in product(_STEPS, _RULES):
        looks_of_code = code_looks[step.picture]
        looks: Looks = looks_of_code if step.scores else looks_here
        choice = _Inhibited(noise, looks_of_code, escape=step.escape) if step.inhibition else Greedy(drawn_from(noise))
        # Scores of the code have no component for background: classes are components from 0 on.
        first = 0 if step.scores else 1
        observer = Semantic(len(run.scenes.classes) + first, prior=config.belief.prior, fusion=rule)
        results.append(_search(config, looks, observer, targets - 1 + first, goal, middle, choice))
    remembered.save()
    return list(torch.stack(results, 1))


def _eyes(config: _SembaConfig, eye: Eye) -> dict[_Picture, Eye]:
    """Make the eyes whose crops show the picture in each of the ways."""
    sensor: Any = eye.sensor
    bilinear = _BilinearFovea(sensor.side, sensor.scales)
    return {
        "shrunk": Eye(sensor, eye.detector, reference=eye.reference),
        "native": Eye(sensor, eye.detector, reference=config.native),
        "bilinear": Eye(bilinear, eye.detector, reference=config.native),
    }


def _search(
    config: _SembaConfig,
    looks: Looks,
    observer: Observer,
    targets: Tensor,
    goal: Tensor,
    middle: Tensor,
    choice: Greedy,
) -> Tensor:
    """Search for components `(T,)` on cells `(T, X·Y)` from the middle; figures `(T, 5)`."""
    shifts = config.protocol.shifts

    def sure(step: Step) -> Tensor:
        probability = step.belief.probability(targets[step.episodes])
        return probability.gather(-1, step.cell[:, None])[:, 0] >= config.stop

    fixated = torch.zeros(len(targets), shifts + 1, dtype=torch.bool)
    stopped = torch.zeros(len(targets), 2, dtype=torch.bool)
    steps = rollout(
        looks,
        observer,
        lambda episodes, cell: TargetPosterior(targets[episodes]),
        middle.expand(len(targets)),
        choice,
        most=shifts + 1,
        ends=sure,
    )
    for step in steps:
        on = goal[step.episodes, step.cell]
        fixated[step.episodes, step.shift :] |= on[:, None]
        ended = sure(step)
        stopped[step.episodes[ended], 0] = True
        stopped[step.episodes[ended], 1] = on[ended]
    return torch.cat([fixated[:, [n for n in _SHIFTS if n <= shifts]], stopped], -1).float()


main = command(_search_as_semba, _SembaConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
