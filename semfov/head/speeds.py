"""What movements of eye and head cost: seconds."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.errors import check_number

_STILL = 1e-3  # degrees, which an angle of 0 can be by rounding


@dataclass(frozen=True)
class Speeds:
    r"""How long eye, head and detector take.

    Saccades last longer the larger they are (the main sequence: Bahill, Clark and Stark, 1975): for an amplitude A in
    degrees :math:`21 + 2.2 A` ms, the line of Carpenter (Movements of the Eyes, 1988). The head, as a motor with a
    bounded speed v and acceleration a, turns by an angle A in the least time,

    .. math:: t = 2 \sqrt{A / a} \ \text{ for } A \le v^2 / a, \quad \text{else } \frac{A}{v} + \frac{v}{a}

    Eye, head and zoom move at the same time, and a look follows when all have arrived.

    Attributes:
        look: seconds of a fixation with its pass of the detector.
        eye_start: seconds of the smallest saccade.
        eye: seconds for each degree of a saccade.
        head: v, degrees per second.
        acceleration: a, degrees per second squared.
        zoom: seconds for each doubling of the field of view.

    >>> speeds = Speeds()
    >>> round(float(speeds.saccade(torch.tensor(10.0))), 3), round(float(speeds.turn(torch.tensor(90.0))), 3)
    (0.043, 1.15)
    """

    look: float = 0.25
    eye_start: float = 0.021
    eye: float = 0.0022
    head: float = 100.0
    acceleration: float = 400.0
    zoom: float = 0.5

    def __post_init__(self) -> None:
        for name in ("look", "eye_start", "eye", "zoom"):
            check_number(getattr(self, name), name, 0, 1e6)
        for name in ("head", "acceleration"):
            check_number(getattr(self, name), name, 1e-6, 1e9)
        check_number(self.look, "look", 1e-6, 1e6)

    def saccade(self, angle: Tensor) -> Tensor:
        """Seconds of saccades by angles `(...)` in degrees; none where the eye stays."""
        return torch.where(angle > _STILL, self.eye_start + self.eye * angle, 0.0)

    def turn(self, angle: Tensor) -> Tensor:
        """Seconds in which the head turns by angles `(...)` in degrees."""
        angle = torch.where(angle > _STILL, angle, 0.0)
        fast = self.head**2 / self.acceleration
        short = 2 * (angle / self.acceleration).sqrt()
        return torch.where(angle <= fast, short, angle / self.head + self.head / self.acceleration)

    def price(self, eye: Tensor, head: Tensor, octaves: Tensor) -> Tensor:
        """Seconds of a gaze shift and the look after it: the slowest of its movements, and the look."""
        slowest = torch.maximum(self.saccade(eye), self.turn(head))
        return self.look + torch.maximum(slowest, self.zoom * octaves.abs())
