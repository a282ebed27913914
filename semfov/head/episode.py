"""Episodes of an eye in a head: the loop of active perception over all poses and fixations."""

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
"""Maps an action to its detections, a batch of one with boxes in pixels of the view."""


class HeadLooks(Looks):
    """Looks of an eye in a head.

    Args:
        views: the possible views and fixations.
        detect: maps an action to its detections.
        target: class that is searched for.
    """

    def __init__(self, views: Views, detect: Detect, target: int | None = None) -> None:
        self.views, self.detect, self.target = views, detect, target
        self.grid, self.like = views.grid, views.poses

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """Detect objects, and weigh them as evidence."""
        watch = Stopwatch()
        detections = self.detect(int(cell))
        watch.lap("detect")
        look = observer.weigh(detections, fixation, self.grid, self.target)
        watch.lap("weigh")
        return Sight(look, lambda: detections, watch.seconds)


def live(eye: Eye, views: Views) -> Detect:
    """Detections of an eye, computed when they are asked for; the view of the last pose is kept for the next look.

    Args:
        eye: sensor and detector.
        views: the possible views and fixations.

    Returns:
        A function that maps an action to its detections.
    """
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
    """One step of an episode: a look, the time it ends, its detections, and the belief after it.

    Attributes:
        action: number of the pose and cell (`Views`).
        seconds: time since the start, this look included.
        belief: after the look.
        detections: a batch of one, with boxes in pixels of the view.
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
    """Run an episode and yield its looks one by one; the caller may stop at any time.

    Args:
        views: the possible views and fixations.
        detect: maps an action to its detections.
        observer: keeps the belief about the scene.
        acquire: makes the acquisition function that chooses the action after a given one.
        start: first action.
        target: class that is searched for.
        speeds: of eye and head.
        passes: largest number of looks.
        seconds: time limit; a look that would end later is not taken.
        seed: of the generator that breaks ties.

    Yields:
        Each look, with the belief after it.
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
    """Combine several numbers into one seed of 63 bits."""
    import hashlib

    return int.from_bytes(hashlib.sha256(repr([*numbers]).encode()).digest()[:8], "big") >> 1


def rests_on(views: Views, action: int, places: Places) -> Tensor:
    """Which objects overlap the cell that an action fixates.

    A cell and an object overlap if one contains a point of the other. 9 × 9 points spread over each are tested.

    Args:
        views: the possible views and fixations.
        action: number of the pose and cell.
        places: regions that the objects cover.

    Returns:
        `(M,)`, boolean.
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
