"""The expected gain of a look from each pose and fixation, and acquisition functions of a head that use it."""

from collections.abc import Sequence
from itertools import chain

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.belief import Belief
from semfov.belief.observers.base import own
from semfov.errors import InputError
from semfov.gaze.acquisition.accuracy import corrected_cells
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.head.belief import SceneBelief
from semfov.head.scenes import World
from semfov.head.speeds import Speeds
from semfov.head.views import Views

FORESIGHT = 0.5  # weight of the gain in sharpness over the cells of a view (`SearchGain`)


UNSEEN_CHANCE = 0.03  # prior probability that a cell that was never seen holds the target of a search
UNSEEN = 1.0  # expected fraction of cells that an exploration classifies correctly when it first fixates them
OUT = -1e6  # value of actions that must not be chosen


def was_fixated(belief: SceneBelief, world: World) -> Tensor:
    """Find the cells that were fixated, or that lie beside a fixated cell that is at least as probable.

    Args:
        belief: about a target.
        world: the scene.

    Returns:
        `(S,)`, boolean.
    """
    chance = belief.probability(0)[0]  # (S,)
    fixated = torch.where(belief.examined[0], chance, 0.0).view(1, 1, world.scene.rows, world.scene.columns)
    # In a panorama the first and the last column are neighbours.
    with_neighbours = F.pad(fixated, (1, 1, 0, 0), mode="circular" if world.closed else "constant")
    padded = F.pad(with_neighbours, (0, 0, 1, 1))
    largest_around = F.max_pool2d(padded, kernel_size=3, stride=1).flatten()
    return largest_around >= chance


class LookGain(nn.Module):
    """Base of modules that compute the expected gains `(A,)` of looks from a belief and a pose."""

    def __init__(self, views: Views) -> None:
        super().__init__()
        self.views = views
        self._acuity = [views.acuity(shown.distances) for shown in views.shown[: views.lattice]]

    def closer(self, belief: SceneBelief, cells: Tensor) -> Tensor:
        """Compute the expected gain of looks at places with a narrower field of view.

        Args:
            belief: the belief over the scene.
            cells: `(n,)`, cells of the places in the scene.

        Returns:
            `(n,)`, in the unit of the gains.
        """
        raise InputError(f"gain: expected one for several fields of view, got {type(self).__name__} without `closer`")


class SearchGain(LookGain):
    r"""Probability that a look finds the target, plus a weighted gain in sharpness over the cells of the view.

    .. math:: G(h, f) = P(t \in f) + c \sum_x |x| \, P(t \in x) \, [a(d_{h,f}(x)) - a(d^*(x))]_+

    The first term is the probability that the fixated cell f holds the target. It is 0 where the cell was fixated
    before, and beside a fixated cell that is as probable, which shows the same object. The head thus turns on once the
    most probable place was fixated, also where the target is not certain enough to be found.

    The second term is the expected area of the target that is seen more sharply than before. |x| is the area of a cell,
    :math:`d^*` the distance of its closest fixation so far, and a the acuity of the fovea (`Views.acuity`), which is 0
    where a cell was never seen. One formula thus gives the value of a saccade and of a turn of the head.

    Args:
        views: the possible views and fixations.
        foresight: c, weight of the gain in sharpness.

    >>> from semfov import FovealObservationModel
    >>> from semfov.belief.observers import SemanticSearch
    >>> from semfov.head import Flat
    >>> from semfov.head.belief import SceneObserver
    >>> views = Views(Flat(torch.rand(3, 480, 640), (40, 30), degree=8))
    >>> model = FovealObservationModel.identity(["cup", "cat"], [0.2], miss_odds=torch.full((3, 2), 0.1))
    >>> belief = SceneObserver(SemanticSearch(model), views).start(1, views.grid, torch.zeros(1))
    >>> SearchGain(views)(belief, 0, [0]).shape  # 9 poses, 100 cells in each view
    torch.Size([900])
    """

    def __init__(self, views: Views, foresight: float = FORESIGHT) -> None:
        super().__init__(views)
        self.foresight = foresight

    def forward(self, belief: SceneBelief, here: int, poses: Sequence[int]) -> Tensor:
        """Compute the expected gain of each action.

        Args:
            belief: the belief over the scene.
            here: number of the present pose.
            poses: numbers of the poses whose looks are valued.

        Returns:
            `(A,)`, in probabilities of a find; the values of actions from other poses have no meaning.
        """
        views = self.views
        chance = belief.probability(0)[0]  # (S,), P(t ∈ x)
        sharpness = views.acuity(belief.closest[0])  # (S,), a(d*)
        weighted = chance * views.world.area
        new_chance = torch.where(was_fixated(belief, views.world), 0.0, chance)
        found = new_chance[views.gaze_cell]  # (A,)
        gains = torch.zeros_like(found)
        for pose in poses:
            cells = views.shown[pose].cells
            gain_in_sharpness = (self._acuity[pose] - sharpness[cells]).clamp(min=0)  # (cells, V)
            sharper = gain_in_sharpness @ weighted[cells]
            actions = slice(pose * views.cells, (pose + 1) * views.cells)
            gains[actions] = found[actions] + self.foresight * sharper
        return gains

    def closer(self, belief: SceneBelief, cells: Tensor) -> Tensor:
        """Compute the probability that the target is at the places, fixated before or not; → `(n,)`."""
        return belief.probability(0)[0, cells]


class ExploreGain(LookGain):
    r"""Expected number of additional cells of the scene that are classified correctly after a look, weighted by area.

    .. math:: G(h, f) = \sum_{x \text{ seen}} |x| \, E[\Delta \mid f](x) + u \sum_{x \text{ not}} |x| \, a(d_{h,f}(x))

    For cells that were seen before, the gain is that of `semfov.acquisition.ExpectedGain`. For the others it is u times
    the acuity of the fovea there (`Views.acuity`). After a turn of the head the eye lands on one of nine cells. All
    cells of a view are valued where the head stays.

    Args:
        views: the possible views and fixations.
        unseen: u, expected fraction of cells that are classified correctly when they are first fixated.

    >>> from semfov import FovealObservationModel
    >>> from semfov.belief.observers import SemanticMap
    >>> from semfov.head import Flat
    >>> from semfov.head.belief import SceneObserver
    >>> views = Views(Flat(torch.rand(3, 480, 640), (40, 30), degree=8))
    >>> model = FovealObservationModel.identity(["cup", "cat"], [0.2])
    >>> belief = SceneObserver(SemanticMap(model), views).start(1, views.grid, torch.zeros(1))
    >>> gains = ExploreGain(views)(belief, here=0, poses=[0, 1])
    >>> int((gains > OUT).sum())  # 100 cells of the present view, and 9 of the other one
    109
    """

    def __init__(self, views: Views, unseen: float = UNSEEN) -> None:
        super().__init__(views)
        self.unseen = unseen
        side = views.view_grid.columns
        # After a turn the eye lands near the corners, the sides or the middle of a view.
        margin = side // 5
        places = torch.tensor([margin, side // 2, side - 1 - margin])
        self._landings = (places[:, None] * side + places).flatten()  # (9,), cells

    def forward(self, belief: SceneBelief, here: int, poses: Sequence[int]) -> Tensor:
        """Compute the expected gain of each action.

        Args:
            belief: the belief over the scene.
            here: number of the present pose.
            poses: numbers of the poses whose looks are valued.

        Returns:
            `(A,)`, in cells of average area; the lowest value where the eye does not land.
        """
        views = self.views
        probabilities = belief.class_probabilities()
        is_seen = belief.owner[0] >= 0
        unseen_worth = torch.where(is_seen, 0.0, self.unseen * views.world.area)
        gains = torch.full((len(views.grid),), OUT)
        for pose in poses:
            cells = views.shown[pose].cells
            fixated = torch.arange(views.cells) if pose == here else self._landings
            gain = self._acuity[pose][fixated] @ unseen_worth[cells]
            is_seen_here = is_seen[cells]
            if bool(is_seen_here.any()):
                seen = cells[is_seen_here]
                distance = views.shown[pose].distances[fixated][:, is_seen_here]  # (fixated, seen)
                corrected = corrected_cells(probabilities[:, seen], belief.closest[:, seen], distance, views.fovea)[0]
                gain = gain + corrected @ views.world.area[seen]
            gains[pose * views.cells + fixated] = gain
        return gains

    def closer(self, belief: SceneBelief, cells: Tensor) -> Tensor:
        """Compute the probability that the most probable class of the places is wrong, times their area; → `(n,)`."""
        wrong = 1 - belief.class_probabilities()[0, cells].amax(-1)
        return wrong * self.views.world.area[cells]


class PerSecond(AcquisitionFunction):
    """Expected gain per second of a movement of the eye, or of eye and head.

    Turns of the head within the dead zone of its speeds are not made.

    Args:
        gain: expected gain of a look.
        speeds: of eye and head; None takes the gain alone, however long the movement takes.
        action: the present action (`Views`).
        poses: numbers of the poses that the head may turn to; None takes those whose views tile the scene.

    >>> from semfov import FovealObservationModel
    >>> from semfov.belief.observers import SemanticSearch
    >>> from semfov.head import Flat
    >>> from semfov.head.belief import SceneObserver
    >>> views = Views(Flat(torch.rand(3, 480, 640), (40, 30), degree=8))
    >>> model = FovealObservationModel.identity(["cup", "cat"], [0.2], miss_odds=torch.full((3, 2), 0.1))
    >>> belief = SceneObserver(SemanticSearch(model), views).start(1, views.grid, torch.zeros(1))
    >>> acquisition = PerSecond(SearchGain(views), Speeds(), action=0)
    >>> values = acquisition(belief, torch.zeros(1, 900, dtype=torch.bool))
    >>> int((values > OUT).sum())  # 4 of the 9 poses tile the scene
    400
    """

    def __init__(self, gain: LookGain, speeds: Speeds | None, action: int, poses: Sequence[int] | None = None) -> None:
        super().__init__()
        self.gain = gain
        self.speeds = speeds
        self.action = action
        self.poses = [*chain.from_iterable(gain.views.tiling)] if poses is None else [*poses]

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Compute the values of all actions.

        Args:
            belief: the belief over the scene.
            visited: not used: actions may be taken again.

        Returns:
            `(1, A)`, expected gains per second; `OUT` for actions that must not be chosen.
        """
        views = self.gain.views
        present_pose = self.action // views.cells
        values = self.gain(own(belief, SceneBelief, "belief"), present_pose, self.poses)
        allowed = torch.zeros(len(views), dtype=torch.bool)  # by pose
        allowed[self.poses] = True
        if self.speeds is not None:
            values = values / views.durations(self.action, self.speeds)
            allowed &= self.speeds.makes(views.turns(self.action))
        allowed_actions = allowed.repeat_interleave(views.cells)
        return torch.where(allowed_actions, values, OUT)[None]
