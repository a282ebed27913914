"""Episodes of an eye in a head: the loop of active perception over all poses and fixations."""

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.belief.observers.base import Observer
from semfov.detection.detections import Detections
from semfov.episode import EpisodeLook, Looks, rollout
from semfov.episode.stopwatch import Stopwatch
from semfov.eye import Eye, View
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.choice import Greedy, drawn_by
from semfov.head.belief import SceneBelief, SceneObserver
from semfov.head.gain import OUT
from semfov.head.views import Views

Detect = Callable[[int], Detections]
"""Maps an action to its detections, a batch of one with boxes in pixels of the view."""


class _HeadLooks(Looks):
    """Looks of an eye in a head."""

    def __init__(self, views: Views, detect: Detect, target: int | None = None) -> None:
        self.views, self.detect, self.target = views, detect, target
        self.grid, self.like = views.grid, views.poses

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        watch = Stopwatch()
        detections = self.detect(int(cell))
        watch.lap("detect")
        look = observer.weigh(detections, fixation, self.grid, self.target)
        watch.lap("weigh")
        return EpisodeLook(look, lambda: detections, watch.seconds)


def live(eye: Eye, views: Views) -> Detect:
    """Detections of an eye on request; those in a frame from another pose are moved to the view that was asked for."""
    world = views.world
    opened: tuple[int, View] | None = None

    def detect(action: int) -> Detections:
        nonlocal opened
        number, cell = divmod(action, views.cells)
        pose = views.poses[number]
        if opened is not None and opened[0] == number and world.still:
            return eye.look(opened[1], views.view_grid.centres[cell][None]).to(pose.device)
        image, at = world.view(pose)
        opened = number, eye.open(image[None].to(eye.sensor.like.device))
        if at is pose:
            return eye.look(opened[1], views.view_grid.centres[cell][None]).to(pose.device)
        detections = eye.look(opened[1], world.to_view(views.gaze[action][None], at)[0]).to(pose.device)
        corners = detections.boxes[..., [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 2) - 0.5
        moved = world.to_view(world.to_scene(corners, at), pose)[0].view(*detections.boxes.shape[:-1], 4, 2) + 0.5
        return replace(detections, boxes=torch.cat([moved.amin(-2), moved.amax(-2)], -1))

    return detect


class HeadStep(NamedTuple):
    """One step of an episode: a look, the time it ends, its detections, and the belief after it."""

    action: int
    seconds: float
    belief: SceneBelief
    detections: Detections
    gain: float = math.inf
    ahead: float = 0.0


def look_around(
    views: Views,
    detect: Detect,
    observer: SceneObserver,
    acquire: Callable[[int], AcquisitionFunction],
    start: int,
    *,
    target: int | None = None,
    passes: int = 100,
    duration: float = math.inf,
    worth: float = 0.0,
    seed: int | Sequence[int] = 0,
) -> Iterator[HeadStep]:
    """Run an episode and yield its looks one by one; the caller may stop at any time."""
    speeds = views.world.speeds
    numbers = [seed] if isinstance(seed, int) else [*seed]
    digest = hashlib.sha256(repr(numbers).encode()).digest()
    generator = torch.Generator().manual_seed(int.from_bytes(digest[:8], "big") >> 1)
    looks = _HeadLooks(views, detect, target)
    spent, ahead, gain = speeds.look, 0.0, math.inf
    steps = rollout(
        looks,
        observer,
        lambda _, cell: acquire(int(cell)),
        torch.tensor([start]),
        Greedy(drawn_by(generator, len(views.grid), looks.like)),
        most=passes,
        ends=lambda _: torch.tensor([spent + ahead > duration or gain <= OUT or (worth > 0 and gain * ahead < worth)]),
    )
    for step in steps:
        action = int(step.cell)
        spent, chosen = spent + ahead, gain
        ahead, gain = float(views.durations(action, speeds)[step.next_cell]), float(step.values[0, step.next_cell])
        assert isinstance(step.belief, SceneBelief)
        yield HeadStep(action, spent, step.belief, step.detections, chosen, ahead)
