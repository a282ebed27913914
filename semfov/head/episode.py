"""Episodes of an eye in a head: the loop of active perception over all that both can look at."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.observers.base import Observer
from semfov.detection.detections import Detections
from semfov.episode import Looks, Sight, Step, Stopwatch, rollout
from semfov.eye import Eye, View
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.choice import Greedy, drawn_by
from semfov.head.belief import SceneBelief, SceneObserver
from semfov.head.speeds import Speeds
from semfov.head.views import Views
from semfov.head.world import Places

Detect = Callable[[int], Detections]
"""What is seen by an action, a batch of one: boxes in pixels of the view."""


class HeadLooks(Looks):
    """Looks of an eye in a head.

    Args:
        views: all that can be looked at.
        detect: what is seen by an action.
        target: class that is searched for.
    """

    def __init__(self, views: Views, detect: Detect, target: int | None = None) -> None:
        self.views, self.detect, self.target = views, detect, target
        self.grid, self.like = views.grid, views.poses

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """Detect and weigh."""
        watch = Stopwatch()
        detections = self.detect(int(cell))
        watch.lap("detect")
        look = observer.weigh(detections, fixation, self.grid, self.target)
        watch.lap("weigh")
        return Sight(look, lambda: detections, watch.seconds)


def live(eye: Eye, views: Views) -> Detect:
    """Looks by an eye; the view from the pose of the last look stays open."""
    opened: tuple[int, View] | None = None

    def detect(action: int) -> Detections:
        nonlocal opened
        pose, cell = divmod(action, views.cells)
        if opened is None or opened[0] != pose:
            opened = pose, eye.open(views.world.view(views.poses[pose])[None])
        return eye.look(opened[1], views.view_grid.centres[cell][None])

    return detect


@dataclass(frozen=True)
class HeadStep:
    """One look.

    Attributes:
        action: pose and cell (`Views`).
        seconds: since the start, this look included.
        belief: after it.
        detections: boxes in pixels of the view, a batch of one.
    """

    action: int
    seconds: float
    belief: SceneBelief
    detections: Detections


def look_around(
    views: Views,
    detect: Detect,
    observer: SceneObserver,
    acquire: Callable[[int], AcquisitionFunction],
    start: int,
    *,
    target: int | None = None,
    speeds: Speeds | None = None,
    passes: int = 100,
    seconds: float = math.inf,
    seed: int | Sequence[int] = 0,
) -> Iterator[HeadStep]:
    """An episode, look by look; whoever takes the steps ends it.

    Args:
        views: all that can be looked at.
        detect: what is seen by an action.
        observer: keeps the belief about the scene.
        acquire: makes the acquisition function of who has done an action.
        start: first action.
        target: class that is searched for.
        speeds: of eye and head.
        passes: looks at most.
        seconds: a look that would end later is not taken.
        seed: of the generator that breaks ties.
    """
    speeds = Speeds() if speeds is None else speeds
    numbers = [seed] if isinstance(seed, int) else [*seed]
    generator = torch.Generator().manual_seed(hash_of(numbers))
    looks = HeadLooks(views, detect, target)
    spent, last = speeds.look, start

    def ends(step: Step) -> Tensor:
        return torch.tensor([spent + float(views.prices(last, speeds)[step.next_cell]) > seconds])

    steps = rollout(
        looks,
        observer,
        lambda _, cell: acquire(int(cell)),
        torch.tensor([start]),
        Greedy(drawn_by(generator, len(views.grid), looks.like)),
        most=passes,
        ends=ends,
    )
    for step in steps:
        action = int(step.cell)
        if step.shift:
            spent += float(views.prices(last, speeds)[action])
        last = action
        assert isinstance(step.belief, SceneBelief)
        yield HeadStep(action, spent, step.belief, step.detections)


def hash_of(numbers: Sequence[int]) -> int:
    """A seed of 63 bits for several numbers."""
    import hashlib

    return int.from_bytes(hashlib.sha256(repr([*numbers]).encode()).digest()[:8], "big") >> 1


def rests_on(views: Views, action: int, places: Places) -> Tensor:
    """Which objects the cell that an action fixates overlaps, `(M,)` boolean.

    A cell and an object overlap where one holds a point of the other, of a grid of 9 × 9 points all over each.

    Args:
        views: all that can be looked at.
        action: pose and cell.
        places: what the objects cover.
    """
    pose, cell = divmod(action, views.cells)
    edges = views.view_grid.edges[cell]
    share = torch.linspace(0, 1, 9)
    y, x = torch.meshgrid(share, share, indexing="ij")
    inside = edges[:2] + torch.stack([x, y], -1).flatten(0, 1) * (edges[2:] - edges[:2]) - 0.5
    held = places.contain(views.world.to_scene(inside, views.poses[pose])).any(-1)
    if bool(held.all()):
        return held
    samples = places.samples()
    points, _ = views.world.to_view(samples.flatten(0, 1), views.poses[pose])
    within = ((points + 0.5 >= edges[:2]) & (points + 0.5 <= edges[2:])).all(-1)
    return held | within.view(samples.shape[:2]).any(-1)
