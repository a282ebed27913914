"""The belief about a scene that is seen through one window at a time."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from semfov.belief.belief import Belief, pick
from semfov.belief.grid import Grid
from semfov.belief.observers import SemanticMap, SemanticSearch
from semfov.belief.observers.base import Evidence, Observer, farther, own
from semfov.belief.observers.semantic_map import CellEvidence
from semfov.belief.observers.semantic_search import SearchEvidence
from semfov.detection.detections import Detections
from semfov.errors import InputError, check
from semfov.head.views import Views

_CERTAIN = 1e-6  # probabilities nearer to 0 or 1 fade as this one does


@dataclass(frozen=True)
class _SceneEvidence(Evidence):
    """The evidence of a look about the cells of a view; the cell `(1,)` of the view and that of the scene, `gaze`.

    `target` is the class 1..K that is searched for, 0 in an exploration.
    """

    pose: int
    inner: SearchEvidence | CellEvidence
    cell: Tensor
    gaze: Tensor
    target: int

    @classmethod
    def join(cls, looks: object) -> "_SceneEvidence":
        """Raise an error, because looks from several poses cannot be joined."""
        raise InputError("looks: expected a single look; looks of a head cannot be joined, as their poses may differ")


@dataclass(frozen=True, repr=False)
class SceneBelief(Belief):
    """Belief about the S cells of a scene; each has the belief of the view in which the gaze came closest to it.

    Attributes:
        values: of one target `(1, S, 2)`, its probability, and that if no fixated cell has it; or of all classes
            `(1, S, K+1)`.
        closest: `(1, S)`, distance of the closest fixation; infinite where none was.
        owner: `(1, S)`, number of the pose of that fixation; -1 where none was.
        examined: `(1, S)`, whether the cell was fixated.
        looks: `(1,)`, number of looks.
        views: by the number of a pose, the belief about the cells of its view.
    """

    values: Tensor
    closest: Tensor
    owner: Tensor
    examined: Tensor
    looks: Tensor
    views: Mapping[int, Belief]

    @property
    def about_all(self) -> bool:
        """Whether the belief is about all classes, rather than one target."""
        return self.values.shape[-1] > 2

    def probability(self, target: int | Tensor) -> Tensor:
        return pick(self.values, torch.as_tensor(target)) if self.about_all else self.values[..., 0]

    def chance(self, target: int | Tensor) -> Tensor:
        return self.probability(target) if self.about_all else self.values[..., 1]

    def class_probabilities(self) -> Tensor:
        return self.values if self.about_all else super().class_probabilities()


class SceneObserver(Observer):
    """Keeps the belief about a scene; each cell has the belief of the view in which the gaze came closest to it."""

    by_target = True

    def __init__(
        self, inner: SemanticSearch | SemanticMap, views: Views, *, unseen_chance: float | None = None
    ) -> None:
        super().__init__()
        is_chance = unseen_chance is None or 0 < unseen_chance < 1
        check(is_chance, "unseen_chance", "a probability between 0 and 1", unseen_chance)
        self.inner = inner
        self.views = views
        self.unseen_chance = unseen_chance

    def start(self, batch: int, grid: Grid, like: Tensor) -> SceneBelief:
        """Make the belief before the first look; `grid` is the strip of all views."""
        check(batch == 1, "batch", "1, as a head has one episode at a time", batch)
        cells = len(self.views.world.scene)
        components = 2 if self._searches else self.inner.components
        nothing = like.new_zeros(1, cells)
        return SceneBelief(
            values=like.new_zeros(1, cells, components),
            closest=nothing + torch.inf,
            owner=nothing.long() - 1,  # no pose
            examined=nothing.bool(),
            looks=like.new_zeros(1),
            views={},
        )

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> _SceneEvidence:
        """Weigh a look from a point `(1, 2)` of the strip; boxes are in pixels of the view."""
        height = self.views.world.size[1]
        pose = int((float(fixation[0, 1]) + 0.5) // height)
        point = fixation - fixation.new_tensor([0, pose * height])
        if self._searches and target is None:
            raise InputError("target: expected a class to search for, got None")
        inner = self.inner.weigh(detections, point, self.views.view_grid)
        cell = self.views.view_grid.cell_of(point)
        gaze = self.views.gaze_cell[self.views.grid.cell_of(fixation)]
        return _SceneEvidence(pose, inner, cell, gaze, target or 0)

    def update(self, belief: Belief, look: Evidence) -> SceneBelief:
        belief = own(belief, SceneBelief, "belief")
        look = own(look, _SceneEvidence, "look")
        pose = look.pose
        values = belief.values.clone() if bool(belief.looks) else self._unseen(look.target, belief.values)
        before = belief.views.get(pose)
        if before is None:
            before = self.inner.start(1, self.views.view_grid, values)
        view = self.inner.update(before, look.inner)
        probabilities = self.views.spread(self._probabilities(view, look.target), pose).mT  # (V, C)
        nearest, takes = self._nearest(belief, look)
        taken = self.views.shown[pose].cells[takes]  # of the scene
        closest = belief.closest.clone()
        owner = belief.owner.clone()
        values[0, taken] = probabilities[takes]
        closest[0, taken] = nearest[takes]
        owner[0, taken] = pose
        examined = belief.examined.scatter(-1, look.gaze[:, None], True)
        return SceneBelief(values, closest, owner, examined, belief.looks + 1, {**belief.views, pose: view})

    def _nearest(self, belief: SceneBelief, look: _SceneEvidence) -> tuple[Tensor, Tensor]:
        """Compute how close the gazes in the view of a look came to its cells, `(V,)`, and which of them it takes.

        A view takes the cells to which its gaze came closest, and renews those that it had.
        """
        shown = self.views.shown[look.pose]
        closest_so_far = belief.closest[0, shown.cells]
        is_owner = belief.owner[0, shown.cells] == look.pose
        # The distances of this gaze, and of earlier ones in the same view.
        distance = shown.distances[int(look.cell)]
        nearest = torch.minimum(distance, torch.where(is_owner, closest_so_far, torch.inf))
        return nearest, (nearest <= closest_so_far) | is_owner

    def fade(self, belief: Belief, look: Evidence, keep: float, visited: Tensor) -> SceneBelief:
        """Discount the evidence of the looks so far; all cells move towards the belief of an unseen cell.

        Args:
            belief: the belief after the looks so far.
            look: the next look.
            keep: share of the evidence to keep, in (0, 1].
            visited: `(1, A)` boolean, actions that still count as fixated.

        Returns:
            The faded belief.
        """
        belief = own(belief, SceneBelief, "belief")
        look = own(look, _SceneEvidence, "look")
        if keep == 1:
            return belief
        cells = self.views.cells
        views = {}
        for pose, view in belief.views.items():
            visited_in_view = visited[:, pose * cells : (pose + 1) * cells]
            views[pose] = self.inner.fade(view, look.inner, keep, visited_in_view)
        examined = torch.zeros_like(belief.examined)
        examined[0, self.views.gaze_cell[visited[0]]] = True
        unseen = self._unseen(look.target, belief.values)
        return replace(
            belief,
            values=_faded(belief.values, unseen, keep, about_all=belief.about_all),
            closest=belief.closest + farther(keep),
            examined=examined,
            looks=keep * belief.looks,
            views=views,
        )

    @property
    def _searches(self) -> bool:
        """Whether it is about one target, and not a map of all classes."""
        return isinstance(self.inner, SemanticSearch)

    def _probabilities(self, view: Belief, target: int) -> Tensor:
        """Take the belief about the cells of a view, `(C, cells)`."""
        if self._searches:
            return torch.cat([view.probability(target), view.chance(target)])
        return view.class_probabilities()[0].mT

    def _unseen(self, target: int, like: Tensor) -> Tensor:
        """Compute the values `(1, S, C)` of cells that were never seen."""
        if not self._searches:
            return self.inner.unseen(like).expand_as(like).clone()
        probability = self.inner.unseen(like)[target] if self.unseen_chance is None else self.unseen_chance
        return torch.full_like(like, float(probability))


def _faded(values: Tensor, unseen: Tensor, keep: float, *, about_all: bool) -> Tensor:
    """Move log odds, or the logarithms of the probabilities of all classes, towards those of an unseen cell.

    Args:
        values: `(..., C)`, probabilities.
        unseen: the same of a cell that was never seen.
        keep: share of the difference that is left.
        about_all: whether they are of all classes, and sum to 1.
    """
    if about_all:
        start = unseen.clamp(min=_CERTAIN).log()
        present = values.clamp(min=_CERTAIN).log()
        return (start + keep * (present - start)).softmax(-1)
    start = unseen.logit(_CERTAIN)
    present = values.logit(_CERTAIN)
    return (start + keep * (present - start)).sigmoid()
