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
from semfov.head.scenes import World
from semfov.head.views import Views

Detect = Callable[[int], Detections]
"""Maps an action to its detections, a batch of one with boxes in pixels of the view."""


class _HeadLooks(Looks):
    """Looks of an eye in a head."""

    def __init__(self, views: Views, detect: Detect, target: int | None = None) -> None:
        self.views = views
        self.detect = detect
        self.target = target
        self.grid = views.grid
        self.like = views.poses

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        watch = Stopwatch()
        detections = self.detect(int(cell))
        watch.lap("detect")
        look = observer.weigh(detections, fixation, self.grid, self.target)
        watch.lap("weigh")
        return EpisodeLook(look, lambda: detections, watch.seconds)


def live(eye: Eye, views: Views) -> Detect:
    """Detect with an eye on request; detections in a frame from another pose are moved to the view that was asked for.

    Args:
        eye: the eye.
        views: poses and fixations.

    Returns:
        A function that looks from an action and detects. Another fixation in a still view needs no new frame.
    """
    world = views.world
    opened: tuple[int, View] | None = None  # number of the pose of the last frame, and the frame

    def look(frame: View, point: Tensor) -> Detections:
        return eye.look(frame, point).to(views.poses.device)

    def detect(action: int) -> Detections:
        nonlocal opened
        number, cell = divmod(action, views.cells)
        pose = views.poses[number]
        point = views.view_grid.centres[cell][None]
        if opened is not None and opened[0] == number and world.still:
            return look(opened[1], point)
        image, real_pose = world.view(pose)
        frame = eye.open(image[None].to(eye.sensor.like.device))
        opened = number, frame
        if real_pose is pose:
            return look(frame, point)
        detections = look(frame, world.to_view(views.gaze[action][None], real_pose)[0])
        return replace(detections, boxes=_moved_boxes(detections.boxes, world, real_pose, pose))

    return detect


def _moved_boxes(boxes: Tensor, world: World, from_pose: Tensor, to_pose: Tensor) -> Tensor:
    """Move boxes `(..., 4)` of the view from one pose to that from another: the smallest around their corners there."""
    corners = boxes[..., [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 2) - 0.5
    moved = world.to_view(world.to_scene(corners, from_pose), to_pose)[0].view(*boxes.shape[:-1], 4, 2) + 0.5
    return torch.cat([moved.amin(-2), moved.amax(-2)], -1)


class HeadStep(NamedTuple):
    """One step of an episode.

    Attributes:
        action: where it looked.
        seconds: time at which the look ends.
        belief: the belief after it.
        detections: its detections, boxes in pixels of the view.
        gain: value that the look was chosen for.
        ahead: seconds that the next look takes, with the movement to it.
    """

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
    """Run an episode look by look; the caller may stop at any time.

    Args:
        views: poses and fixations.
        detect: detects from an action.
        observer: updates the belief.
        acquire: gives the acquisition function after a look from an action.
        start: first action.
        target: class of a search; None explores.
        passes: largest number of looks.
        duration: seconds after which no look ends.
        worth: least gain of a look; 0 for any.
        seed: one number or several, for ties.

    Yields:
        The looks.
    """
    speeds = views.world.speeds
    numbers = [seed] if isinstance(seed, int) else [*seed]
    digest = hashlib.sha256(repr(numbers).encode()).digest()
    generator = torch.Generator().manual_seed(int.from_bytes(digest[:8], "big") >> 1)
    looks = _HeadLooks(views, detect, target)
    spent = speeds.look  # seconds at the end of the present look
    ahead = 0.0  # seconds that the next one takes
    gain = math.inf  # value that it is chosen for

    def ends(_: object) -> Tensor:
        """Tell whether the next look takes too long, is not allowed, or is not worth its pass; gains are per second."""
        return torch.tensor([spent + ahead > duration or gain <= OUT or (worth > 0 and gain * ahead < worth)])

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
        spent += ahead
        chosen_for = gain
        ahead = float(views.durations(action, speeds)[step.next_cell])
        gain = float(step.values[0, step.next_cell])
        assert isinstance(step.belief, SceneBelief)
        yield HeadStep(action, spent, step.belief, step.detections, chosen_for, ahead)
