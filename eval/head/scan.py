"""A baseline of the study of heads: poses in a given order, again and again."""

from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.observers.base import own
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.head.belief import SceneBelief
from semfov.head.gain import OUT, LookGain


class Scan(AcquisitionFunction):
    """A head that goes through poses in an order, with `dwell` looks from each; the eye follows the gain."""

    def __init__(self, gain: LookGain, order: Sequence[int], dwell: int, action: int) -> None:
        super().__init__()
        self.gain = gain
        self.order = order
        self.dwell = dwell
        self.action = action

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(1, A)`; `OUT` for all poses but the next one."""
        belief = own(belief, SceneBelief, "belief")
        cells = self.gain.views.cells
        turn = int(belief.looks) // self.dwell
        for _ in self.order:
            pose = self.order[turn % len(self.order)]
            rows = slice(pose * cells, (pose + 1) * cells)
            if not bool(visited[0, rows].all()):
                break
            turn += 1
        gains = self.gain(belief, self.action // cells, [pose])
        values = torch.full_like(gains, OUT)
        values[rows] = gains[rows]
        return values[None]
