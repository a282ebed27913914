"""What a look is expected to bring, from each pose of the head and each fixation of the eye; and who goes by it."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import chain

import torch
from torch import Tensor, nn

from semfov.belief.belief import Belief
from semfov.belief.map_evidence import MapEvidence
from semfov.belief.observers.base import own
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.head.belief import SceneBelief
from semfov.head.speeds import Speeds
from semfov.head.views import SIDE, Views

FORESIGHT = 0.5
"""Share of what a look shows from aside that counts towards a find."""


PRIOR = 0.03
"""Probability that a cell that was never seen holds the target of a search."""

UNSEEN = 1.0
"""Cells of an exploration that are expected to be named right where they are first fixated."""

OUT = -1e6
"""Value of actions that are not to be chosen."""


class Gain(nn.Module, ABC):
    """Base of what a look is expected to bring.

    Args:
        views: all that can be looked at.
    """

    def __init__(self, views: Views) -> None:
        super().__init__()
        self.views = views

    @abstractmethod
    def forward(self, belief: SceneBelief, here: int, poses: Sequence[int]) -> Tensor:
        """Gains `(A,)` of all actions from some poses; those of others have no meaning.

        Args:
            belief: after the last look.
            here: the pose of the head.
            poses: which are asked for.
        """


class SearchGain(Gain):
    r"""Probability that a look finds the target, and what it shows from aside.

    .. math:: G(h, f) = P(t \in f) + c \sum_x |x| \, P(t \in x) \, [a(d_{h,f}(x)) - a(d^*(x))]_+

    The first is the probability that the cell f, which the gaze would rest on, holds the target, where the gaze has not
    been. The second is the expected area of the target that is seen better than ever before: with |x| the area of a
    cell, :math:`d^*` the distance of the closest gaze so far, and a the acuity of the fovea (`Views.acuity`), which is
    0 for what was never seen. So one formula tells what it is worth to move the eye, and to turn the head.

    Args:
        views: all that can be looked at.
        foresight: c.
    """

    def __init__(self, views: Views, foresight: float = FORESIGHT) -> None:
        super().__init__(views)
        self.foresight = foresight
        self._acuity = [views.acuity(distance) for distance in views.distances]

    def forward(self, belief: SceneBelief, here: int, poses: Sequence[int]) -> Tensor:
        """Gains `(A,)`, in finds."""
        views = self.views
        chance = belief.probability(0)[0]
        known = views.acuity(belief.closest[0])
        wanted = chance * views.world.area
        here_found = torch.where(belief.examined[0], 0.0, chance)[views.gaze_cell]
        gains = torch.zeros_like(here_found)
        for pose in poses:
            cells = views.seen[pose].cells
            aside = (self._acuity[pose] - known[cells]).clamp(min=0) @ wanted[cells]
            rows = slice(pose * views.cells, (pose + 1) * views.cells)
            gains[rows] = here_found[rows] + self.foresight * aside
        return gains


class ExploreGain(Gain):
    r"""How many more cells of the scene a look is expected to name right, by their area.

    .. math:: G(h, f) = \sum_{x \text{ seen}} |x| \, E[\Delta \mid f](x) + u \sum_{x \text{ not}} |x| \, a(d_{h,f}(x))

    `MapEvidence.gain` has learned what a look brings to cells that were seen before. Of those that were not nothing is
    known but how often a look names a cell right: u times the acuity of the fovea there. After a turn of the head the
    eye lands on one of nine cells; every cell is valued where the head stays.

    Args:
        views: all that can be looked at.
        model: that the map is learned with.
        unseen: u.
    """

    def __init__(self, views: Views, model: MapEvidence, unseen: float = UNSEEN) -> None:
        super().__init__(views)
        self.model, self.unseen = model, unseen
        self._acuity = [views.acuity(distance) for distance in views.distances]
        third = torch.tensor([SIDE // 5, SIDE // 2, SIDE - 1 - SIDE // 5])
        self._landings = (third[:, None] * SIDE + third).flatten()

    def forward(self, belief: SceneBelief, here: int, poses: Sequence[int]) -> Tensor:
        """Gains `(A,)`, in cells of average area; below all others where the eye does not land."""
        views = self.views
        probabilities = belief.class_probabilities()
        known = belief.owner[0] >= 0
        worth = torch.where(known, 0.0, self.unseen * views.world.area)
        gains = torch.full((len(views.grid),), OUT)
        for pose in poses:
            cells = views.seen[pose].cells
            rows = torch.arange(views.cells) if pose == here else self._landings
            total = self._acuity[pose][rows] @ worth[cells]
            some = known[cells]
            if bool(some.any()):
                old = cells[some]
                distance = views.distances[pose][rows][:, some]
                each = self.model.gain(probabilities[:, old], belief.closest[:, old], belief.looks, distance[None])[0]
                total = total + each @ views.world.area[old]
            gains[pose * views.cells + rows] = total
        return gains


class PerPrice(AcquisitionFunction):
    """Expected gain per second: the eye moves, or the head, whichever pays more.

    Args:
        gain: of a look.
        speeds: of eye and head; None values gains alone, whatever they cost.
        action: where eye and head are.
        poses: to which the head may turn; None takes those whose views tile the scene.
    """

    def __init__(self, gain: Gain, speeds: Speeds | None, action: int, poses: Sequence[int] | None = None) -> None:
        super().__init__()
        self.gain, self.speeds, self.action = gain, speeds, action
        tiling = chain.from_iterable(chain.from_iterable(gain.views.tiling))
        self.poses = [*tiling] if poses is None else [*poses]

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(1, A)`."""
        views = self.gain.views
        values = self.gain(own(belief, SceneBelief, "belief"), self.action // views.cells, self.poses)
        if self.speeds is not None:
            values = values / views.prices(self.action, self.speeds)
        allowed = torch.zeros(len(views), dtype=torch.bool)
        allowed[self.poses] = True
        return torch.where(allowed.repeat_interleave(views.cells), values, OUT)[None]


class Scan(AcquisitionFunction):
    """A head that goes through poses in a given order, again and again, whatever is seen; the eye goes by the gain.

    Args:
        gain: of a look.
        order: numbers of poses; with one of them the eye moves alone.
        dwell: looks from each pose.
        action: where eye and head are.
    """

    def __init__(self, gain: Gain, order: Sequence[int], dwell: int, action: int) -> None:
        super().__init__()
        self.gain, self.order, self.dwell, self.action = gain, order, dwell, action

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(1, A)`; `OUT` from all poses but the next one."""
        known, cells = own(belief, SceneBelief, "belief"), self.gain.views.cells
        turn = int(known.looks) // self.dwell
        for _ in self.order:
            pose = self.order[turn % len(self.order)]
            rows = slice(pose * cells, (pose + 1) * cells)
            if not bool(visited[0, rows].all()):
                break
            turn += 1
        gains = self.gain(known, self.action // cells, [pose])
        values = torch.full_like(gains, OUT)
        values[rows] = gains[rows]
        return values[None]


class Anywhere(AcquisitionFunction):
    """Any pose and any fixation, at random.

    Args:
        views: all that can be looked at.
    """

    def __init__(self, views: Views) -> None:
        super().__init__()
        self.views = views

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """The same value for all `(1, A)`."""
        return torch.zeros(1, len(self.views.grid))
