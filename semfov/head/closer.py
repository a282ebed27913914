"""Looks of a camera that zooms in: places that a narrower field of view would show better."""

from typing import NamedTuple

import torch
from torch import Tensor

from semfov.belief.grid import box_centres
from semfov.detection.detections import Detections
from semfov.head.belief import SceneBelief
from semfov.head.gain import OUT, LookGain
from semfov.head.speeds import Speeds
from semfov.head.views import Views
from semfov.sensor.glimpse import CONTEXT

_MOST = 4  # places that are offered for a look
_FAINTEST = 0.05  # score from which on a box marks a place


class _Place(NamedTuple):
    """A place `(D,)` of the scene that may hold an object, and the field of view that shows it closely."""

    point: Tensor
    field: float


class CloserLookOffers:
    """Offers looks with a narrower field of view at detected boxes, a few for each look.

    The narrowest field of view that is three times as wide as a box shows it, if no look at its cell of the scene had
    one as narrow.

    Args:
        gain: expected gain of looks.
        speeds: of eye and head; None takes the gain alone.
        target: class 1..K of a search; None for the objects of all classes.
    """

    def __init__(self, gain: LookGain, speeds: Speeds | None, target: int | None) -> None:
        self.gain = gain
        self.views: Views = gain.views
        self.speeds = speeds
        self.target = target
        self._places: dict[int, _Place] = {}  # by their cell of the scene
        self._shown: dict[int, float] = {}  # by the cell, the narrowest field of view of a look at its place
        self._cells: dict[int, int] = {}  # by the action that was offered after the last look, the cell of its place
        self._taken: set[int] = set()  # numbers of the poses of all looks

    def see(self, action: int, detections: Detections) -> None:
        """Keep the places of boxes in a look.

        Args:
            action: where it looked.
            detections: a batch of one, boxes in pixels of the view.
        """
        views = self.views
        number = action // views.cells
        pose = views.poses[number]
        field = views.field_of(pose)
        self._taken.add(number)
        if action in self._cells:
            self._shown[self._cells[action]] = field
        boxes, middles = self._boxes_in_view(detections)
        points = views.world.to_scene(middles, pose)
        cells = views.world.scene.cell_of(views.world.pixels_of(points)).tolist()
        # The sides of boxes as shares of those of the view.
        sides = boxes[:, 2:] - boxes[:, :2]
        shares = sides / boxes.new_tensor(views.world.size)
        extents = (shares.amax(-1) * field).tolist()  # in degrees, about
        for cell, point, extent in zip(cells, points, extents, strict=True):
            self._places[cell] = _Place(point, self._field_around(extent))

    def _boxes_in_view(self, detections: Detections) -> tuple[Tensor, Tensor]:
        """Select the boxes that may show what is looked for, and whose middle is in the view.

        Returns:
            Boxes `(M, 4)` and their middles `(M, 2)`, in pixels of the view.
        """
        class_scores = detections.scores[0]  # (L, K+1)
        scores = class_scores[:, 1:].amax(-1) if self.target is None else class_scores[:, self.target]
        may_show = detections.mask[0] & (scores >= _FAINTEST)
        boxes = detections.boxes[0, may_show]
        size = boxes.new_tensor(self.views.world.size)
        middles = box_centres(boxes)
        inside = ((middles >= -0.5) & (middles <= size - 0.5)).all(-1)
        return boxes[inside], middles[inside]

    def _field_around(self, extent: float) -> float:
        """Choose the narrowest field of view that shows an object of an extent in degrees with its surroundings."""
        wide_enough = [field for field in self.views.fields if field >= CONTEXT * extent]
        return min(wide_enough, default=self.views.fields[-1])

    def values(self, belief: SceneBelief, here: int) -> Tensor:
        """Compute the values of the offered looks with a narrower field of view, and add their poses to the views.

        Args:
            belief: the belief over the scene.
            here: the present action.

        Returns:
            `(A,)`, expected gains per second; `OUT` for all other actions.
        """
        views = self.views
        cells = self._best(belief)
        # Poses that were offered, and are not looked from, serve the next ones.
        offered_before = {action // views.cells for action in self._cells}
        free = sorted(offered_before - self._taken, reverse=True)
        actions = []
        for cell in cells:
            place = self._places[cell]
            actions.append(views.aim(place.point, place.field, free))
        self._cells = dict(zip(actions, cells, strict=True))
        values = torch.full((len(views.grid),), OUT)
        if actions:
            numbers = torch.tensor(actions)
            values[numbers] = self._gains(belief, here, numbers, torch.tensor(cells))
        return values

    def _gains(self, belief: SceneBelief, here: int, actions: Tensor, cells: Tensor) -> Tensor:
        """Compute the expected gains of closer looks, of a head with speeds per second.

        Args:
            belief: the belief over the scene.
            here: the present action.
            actions: `(n,)`, the looks.
            cells: `(n,)`, the cells of their places.

        Returns:
            `(n,)`; `OUT` for turns that the head does not make.
        """
        views = self.views
        gains = self.gain.closer(belief, cells)
        if self.speeds is None:
            return gains
        gains = gains / views.durations(here, self.speeds)[actions]
        turns = views.turns(here)[actions // views.cells]
        return torch.where(self.speeds.makes(turns), gains, OUT)

    def _best(self, belief: SceneBelief) -> list[int]:
        """Choose the places that promise most, of those that no look has shown as closely; → their cells."""
        widest = self.views.fields[-1]
        cells = [cell for cell, place in self._places.items() if place.field < self._shown.get(cell, widest)]
        numbers = torch.tensor(cells, dtype=torch.int64)
        promise = self.gain.closer(belief, numbers)
        return numbers[promise.argsort(descending=True, stable=True)[:_MOST]].tolist()
