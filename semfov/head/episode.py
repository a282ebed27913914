"""Episodes of an eye in a head: the loop of active perception over all poses and fixations."""

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.observers.base import Observer, own
from semfov.detection.detections import Detections
from semfov.episode import EpisodeLook, Looks
from semfov.episode.loop import attend
from semfov.episode.memory import Forgetting, Memory
from semfov.episode.stopwatch import Stopwatch
from semfov.eye import Eye, View
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.choice import Greedy, drawn_by
from semfov.head.belief import SceneBelief, SceneObserver
from semfov.head.closer import CloserLookOffers
from semfov.head.gain import OUT
from semfov.head.scenes import World
from semfov.head.views import Views

_ONE = torch.tensor([0])  # the only episode

Detect = Callable[[int], Detections]
"""Maps an action to its detections, a batch of one with boxes in pixels of the view."""


class _HeadLooks(Looks):
    """Looks of an eye in a head."""

    def __init__(self, views: Views, detect: Detect, target: int | None) -> None:
        self.views = views
        self.detect = detect
        self.target = target
        self.grid = views.grid
        self.like = views.poses
        self.passed = 0.0  # seconds since the look before

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> EpisodeLook:
        watch = Stopwatch()
        detections = self.detect(int(cell))
        watch.lap("detect")
        look = observer.weigh(detections, fixation, self.views.grid, self.target)
        watch.lap("weigh")
        return EpisodeLook(look, lambda: detections, watch.seconds, self.passed)


def live(eye: Eye, views: Views) -> Detect:
    """Make a function that looks with an eye; detections from another pose are moved to the requested view.

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
        # A head may stop beside the pose that it was sent to: it fixates the point, and the boxes are moved.
        real_point, _ = world.to_view(views.gaze[action][None], real_pose)
        detections = look(frame, real_point)
        return replace(detections, boxes=_moved_boxes(detections.boxes, world, real_pose, pose))

    return detect


def _moved_boxes(boxes: Tensor, world: World, from_pose: Tensor, to_pose: Tensor) -> Tensor:
    """Move boxes `(..., 4)` of the view from one pose to that from another: the smallest around their corners there."""
    x1, y1, x2, y2 = boxes.unbind(-1)
    clockwise = [x1, y1, x2, y1, x2, y2, x1, y2]
    corners = torch.stack(clockwise, -1).unflatten(-1, (4, 2))  # (..., 4, 2)
    in_scene = world.to_scene(corners.reshape(-1, 2) - 0.5, from_pose)
    in_view, _ = world.to_view(in_scene, to_pose)
    moved = in_view.view(corners.shape) + 0.5
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


class _NextLook(NamedTuple):
    """A look that was chosen, with the value that it was chosen for, and its seconds with the movement to it."""

    action: int
    gain: float
    seconds: float


def look_around(
    views: Views,
    detect: Detect,
    observer: SceneObserver,
    acquire: Callable[[int], AcquisitionFunction],
    start: int,
    *,
    target: int | None = None,
    closer: CloserLookOffers | None = None,
    passes: int = 100,
    duration: float = math.inf,
    min_gain: float = 0.0,
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
        closer: offers closer looks of a head that zooms; None for none.
        passes: largest number of looks.
        duration: seconds after which no look ends.
        min_gain: least gain of a look; 0 for any.
        seed: one number or several, for ties.

    Yields:
        The looks.
    """
    speeds = views.world.speeds
    generator = _generator(seed)
    looks = _HeadLooks(views, detect, target)
    forgetting = Forgetting(views.world.rate) if views.world.rate else None
    memory = Memory.empty(looks, observer, 1)
    clock = speeds.look  # seconds at the end of the present look; the first one begins at 0
    present = _NextLook(start, math.inf, 0.0)
    for number in range(passes):
        action = present.action
        clock += present.seconds
        looks.passed = present.seconds
        cell = torch.tensor([action])
        look, memory = attend(looks, observer, memory, _ONE, cell, views.grid.centres[cell], forgetting)
        belief = own(memory.belief, SceneBelief, "belief")
        values = acquire(action)(belief, memory.visited)
        if closer is not None:
            closer.see(action, look.detections())
            values, memory = _with_closer(values, closer.values(belief, action), memory)
        # Closer looks may have added actions to the grid, so that the choice is made anew.
        choice = Greedy(drawn_by(generator, len(views.grid), looks.like))
        _, chosen = choice(number, _ONE, values, memory.visited, views.grid.centres)
        following = int(chosen)
        seconds = float(views.durations(action, speeds)[following])
        gain = float(values[0, following])
        yield HeadStep(action, clock, belief, look.detections(), present.gain, seconds)
        is_too_late = clock + seconds > duration
        is_worthless = gain <= OUT or (min_gain > 0 and gain * seconds < min_gain)
        if is_too_late or is_worthless or bool(memory.visited.all()):
            return
        present = _NextLook(following, gain, seconds)


def _generator(seed: int | Sequence[int]) -> torch.Generator:
    """Make a generator whose seed depends on all of some numbers."""
    numbers = [seed] if isinstance(seed, int) else [*seed]
    digest = hashlib.sha256(repr(numbers).encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "big") >> 1)  # 63 bits, which it takes


def _with_closer(values: Tensor, closer: Tensor, memory: Memory) -> tuple[Tensor, Memory]:
    """Add the values `(A,)` of closer looks, some of whose actions are new, to those of the others, `(1, A)`."""
    new = len(closer) - values.shape[-1]
    joined = torch.maximum(F.pad(values, (0, new), value=OUT), closer)
    visited = F.pad(memory.visited, (0, new), value=False)
    return joined, replace(memory, visited=visited, age=F.pad(memory.age, (0, new), value=torch.inf))
