"""Closer looks of a head that zooms: places that a narrower field of view would show better."""

from typing import NamedTuple

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.head.belief import SceneBelief
from semfov.head.gain import OUT, LookGain
from semfov.head.speeds import Speeds
from semfov.head.views import Views

_CONTEXT = 3.0  # side of a closer view, in longer sides of the box that it shows
_MOST = 4  # places that are offered for a look
_FAINTEST = 0.05  # score from which on a box marks a place


class _Place(NamedTuple):
    """A place `(D,)` of the scene that may hold an object, and the field of view that shows it closely."""

    point: Tensor
    field: float


class CloserLooks:
    """Offers closer looks at the boxes of the looks so far, a few for each look.

    The narrowest field of view that is three times as wide as a box shows it, if no look at its cell of the scene had
    one as narrow.

    Args:
        gain: expected gain of looks.
        speeds: of eye and head; None takes the gain alone.
        target: class 1..K of a search; None for the objects of all classes.
    """

    def __init__(self, gain: LookGain, speeds: Speeds | None, target: int | None = None) -> None:
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
        pose = views.poses[action // views.cells]
        field = views.field_of(pose)
        self._taken.add(action // views.cells)
        if action in self._cells:
            self._shown[self._cells[action]] = field
        scores = detections.scores[0, :, 1:].amax(-1) if self.target is None else detections.scores[0, :, self.target]
        boxes = detections.boxes[0, detections.mask[0] & (scores >= _FAINTEST)]
        size = boxes.new_tensor(views.world.size)
        middles = (boxes[:, :2] + boxes[:, 2:]) / 2 - 0.5
        inside = ((middles >= -0.5) & (middles <= size - 0.5)).all(-1)
        points = views.world.to_scene(middles[inside], pose)
        cells = views.world.scene.cell_of(views.world.pixels_of(points)).tolist()
        # The sides of boxes as shares of those of the view.
        shares = (boxes[inside, 2:] - boxes[inside, :2]) / size
        extents = (shares.amax(-1) * field).tolist()
        for cell, point, extent in zip(cells, points, extents, strict=True):
            fitting = [each for each in views.fields if each >= _CONTEXT * extent]
            self._places[cell] = _Place(point, min(fitting, default=views.fields[-1]))

    def values(self, belief: SceneBelief, here: int) -> Tensor:
        """Value the closer looks that are offered after a look; their poses are added to the views.

        Args:
            belief: the belief over the scene.
            here: the present action.

        Returns:
            `(A,)`, expected gains per second; `OUT` for all other actions.
        """
        views = self.views
        cells = self._best(belief)
        # Poses that were offered, and are not looked from, serve the next ones.
        free = sorted({action // views.cells for action in self._cells} - self._taken, reverse=True)
        offered = [views.aim(self._places[cell].point, self._places[cell].field, free) for cell in cells]
        self._cells = dict(zip(offered, cells, strict=True))
        values = torch.full((len(views.grid),), OUT)
        if not offered:
            return values
        actions = torch.tensor(offered)
        gains = self.gain.closer(belief, torch.tensor(cells))
        if self.speeds is not None:
            gains = gains / views.durations(here, self.speeds)[actions]
            turns = views.world.turn(views.poses[here // views.cells], views.poses[actions // views.cells])
            gains = torch.where(self.speeds.makes(turns), gains, OUT)
        values[actions] = gains
        return values

    def _best(self, belief: SceneBelief) -> list[int]:
        """Choose the places that promise most, of those that no look has shown as closely; → their cells."""
        widest = self.views.fields[-1]
        cells = [cell for cell, place in self._places.items() if place.field < self._shown.get(cell, widest)]
        numbers = torch.tensor(cells, dtype=torch.int64)
        promise = self.gain.closer(belief, numbers)
        return numbers[promise.argsort(descending=True, stable=True)[:_MOST]].tolist()
